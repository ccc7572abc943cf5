"""A record of the audit: who did or decided what, when, chained by hashes. Pure.

The head of a record is the SHA-256 of its canonical bytes, which contain the head of the record before: whoever knows
one head knows everything up to it. What is large (controllers, models, verdicts) lies beside the records, once, and is
named by the SHA-256 of its bytes.
"""

import hashlib
import json
from typing import Annotated, Any, Literal

from pydantic import Field, JsonValue, ValidationError

from gateway.core.json_problems import NotJson, document_of
from gateway.core.line import Strict

BEFORE_FIRST = "0" * 64  #: the head that the first record has before it
MOST_BYTES = 65_536  #: of a record's canonical form; what is larger belongs into blobs

Digest = Annotated[str, Field(pattern=r"^[0-9a-f]{64}$")]
Label = Annotated[str, Field(pattern=r"^[a-z][a-z0-9-]{0,39}$")]


class NotRecordable(ValueError):
    """It cannot be a record; the text says why."""


class Who(Strict):
    """Who did it, as far as it is known: of a local peer what the kernel says, of a remote one its certificate."""

    name: Annotated[str, Field(min_length=1, max_length=200)]
    uid: Annotated[int, Field(ge=0)] | None = None
    pid: Annotated[int, Field(ge=0)] | None = None
    certificate: Digest | None = None  #: SHA-256 of its DER bytes


class AuditRecord(Strict):
    """One record. Schema in docs/schemas/audit-record.schema.json."""

    format: Literal[1] = 1
    sequence: Annotated[int, Field(ge=1)]  #: from 1, without gaps
    wall_s: float  #: Unix time
    monotonic_s: float  #: of the boot
    boot: Annotated[str, Field(max_length=64)]  #: monotonic times compare within one boot only
    kind: Label
    who: Who
    what: dict[str, JsonValue]
    blobs: dict[Label, Digest] = {}  #: what lies beside it, by the part that it plays
    previous: Digest  #: head of the record before


def canonical(record: AuditRecord) -> bytes:
    """The one byte representation of a record. Raises NotRecordable for what JSON cannot say."""
    return canonical_json(record.model_dump())


def canonical_json(value: Any) -> bytes:
    """JSON with sorted keys, no spaces, ASCII only. Raises NotRecordable."""
    try:
        return json.dumps(value, sort_keys=True, separators=(",", ":"), allow_nan=False).encode()
    except (ValueError, TypeError, RecursionError) as error:
        raise NotRecordable(f"it cannot be written as JSON: {error}") from error


def head_of(payload: bytes) -> str:
    """SHA-256 in hexadecimal: of canonical bytes the head of the record, of anything else its name as a blob."""
    return hashlib.sha256(payload).hexdigest()


def record_of(fields: dict[str, Any]) -> AuditRecord:
    """Raises NotRecordable with every reason."""
    try:
        record = AuditRecord.model_validate(fields)
    except ValidationError as error:
        reasons = (f"{'.'.join(map(str, one['loc'])) or 'record'}: {one['msg']}" for one in error.errors())
        raise NotRecordable("; ".join(reasons)) from error
    size = len(canonical(record))
    if size > MOST_BYTES:
        raise NotRecordable(f"it has {size} bytes; allowed: {MOST_BYTES}, what is larger goes into blobs")
    return record


def parse_record(payload: bytes) -> AuditRecord:
    """The record in canonical bytes, and in those only. Raises NotRecordable."""
    try:
        record = record_of(document_of(payload))
    except NotJson as error:
        raise NotRecordable(str(error)) from error
    if canonical(record) != payload:
        raise NotRecordable("its bytes are not in canonical form")
    return record
