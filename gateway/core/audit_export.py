"""The audit as lines of JSON: each record with its head, and before it what it refers to and no earlier one has.

An export holds everything: whoever has it can verify the chain without this program's database.
"""

import base64
import binascii
import json
from collections.abc import Iterable, Iterator
from typing import Annotated, Literal

from pydantic import Field, TypeAdapter, ValidationError

from gateway.core.audit_record import BEFORE_FIRST, AuditRecord, Digest, NotRecordable, canonical, head_of
from gateway.core.json_problems import NotJson, document_of
from gateway.core.line import Strict


class RecordLine(Strict):
    """A record. Its head is the SHA-256 of its canonical JSON: keys sorted, no spaces, ASCII."""

    type: Literal["record"] = "record"
    head: Digest
    record: AuditRecord


class BlobLine(Strict):
    """What records refer to by the SHA-256 of its bytes: text as such, anything else in base 64."""

    type: Literal["blob"] = "blob"
    id: Digest
    encoding: Literal["utf-8", "base64"]
    content: str

    def payload(self) -> bytes:
        """Raises ValueError."""
        if self.encoding == "utf-8":
            return self.content.encode()
        try:
            return base64.b64decode(self.content, validate=True)
        except binascii.Error as error:
            raise ValueError(f"blob {self.id}: it is no base 64: {error}") from error


AuditLine = Annotated[RecordLine | BlobLine, Field(discriminator="type")]
ADAPTER: TypeAdapter[RecordLine | BlobLine] = TypeAdapter(AuditLine)


def blob_line(payload: bytes) -> BlobLine:
    try:
        return BlobLine(id=head_of(payload), encoding="utf-8", content=payload.decode())
    except UnicodeDecodeError:
        return BlobLine(id=head_of(payload), encoding="base64", content=base64.b64encode(payload).decode())


def line_text(line: RecordLine | BlobLine) -> str:
    """One line, without its end."""
    return json.dumps(line.model_dump(), sort_keys=True, separators=(",", ":"), allow_nan=False)


def parse_line(payload: bytes) -> RecordLine | BlobLine:
    """Raises NotRecordable."""
    try:
        return ADAPTER.validate_python(document_of(payload))
    except NotJson as error:
        raise NotRecordable(str(error)) from error
    except ValidationError as error:
        reasons = (f"{'.'.join(map(str, one['loc']))}: {one['msg']}" for one in error.errors())
        raise NotRecordable("; ".join(reasons)) from error


def wrong_in(lines: Iterable[bytes]) -> Iterator[str]:
    """What is wrong with an export, line by line: each head, the chain, the hash of each blob; empty: nothing."""
    head, sequence, known = BEFORE_FIRST, 0, set[str]()
    for number, payload in enumerate(lines, 1):
        try:
            line = parse_line(payload)
            if isinstance(line, BlobLine):
                if head_of(line.payload()) != line.id:
                    yield f"line {number}: blob {line.id} is not what was stored"
                known.add(line.id)
                continue
            found = head_of(canonical(line.record))
        except ValueError as error:
            yield f"line {number}: {error}"
            continue
        if found != line.head:
            yield f"line {number}: the head of record {line.record.sequence} is not the hash of its content"
        if (line.record.sequence, line.record.previous) != (sequence + 1, head):
            yield f"line {number}: record {line.record.sequence} does not follow record {sequence}"
        for part, id_ in line.record.blobs.items():
            if id_ not in known:
                yield f"line {number}: the {part} of record {line.record.sequence} is missing: blob {id_}"
        head, sequence = line.head, line.record.sequence
