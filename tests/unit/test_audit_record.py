"""Records: one byte representation, read back as what it was, and every change to it is seen."""

import hashlib
import json

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from gateway.core.audit_export import blob_line, line_text, parse_line, wrong_in
from gateway.core.audit_record import (
    BEFORE_FIRST,
    MOST_BYTES,
    AuditRecord,
    NotRecordable,
    Who,
    canonical,
    head_of,
    parse_record,
    record_of,
)

TEXTS = st.text(st.characters(exclude_categories=["Cs"]), max_size=20)  # no lone surrogates: they are no text
VALUES = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats(allow_nan=False, allow_infinity=False) | TEXTS,
    lambda inner: st.lists(inner, max_size=4) | st.dictionaries(TEXTS, inner, max_size=4),
    max_leaves=12,
)
DIGESTS = st.binary(min_size=32, max_size=32).map(bytes.hex)
FINITE = st.floats(allow_nan=False, allow_infinity=False)
LABELS = st.from_regex(r"[a-z][a-z0-9-]{0,39}", fullmatch=True)
WHO = st.builds(
    Who, name=TEXTS.filter(bool), uid=st.none() | st.integers(0, 2**40), pid=st.none(), certificate=st.none() | DIGESTS
)
RECORDS = st.builds(
    AuditRecord, sequence=st.integers(1, 2**60), wall_s=FINITE, monotonic_s=FINITE, boot=TEXTS, kind=LABELS, who=WHO,
    what=st.dictionaries(TEXTS, VALUES, max_size=4), blobs=st.dictionaries(LABELS, DIGESTS, max_size=3),
    previous=DIGESTS,
)  # fmt: skip


def fields(**changes: object) -> dict[str, object]:
    return {
        "sequence": 1, "wall_s": 1.5, "monotonic_s": 2.5, "boot": "b", "kind": "proposed", "who": Who(name="a"),
        "what": {}, "blobs": {}, "previous": BEFORE_FIRST,
    } | changes  # fmt: skip


@pytest.mark.slow
@given(RECORDS)
def test_a_record_is_read_back_as_what_it_was(record: AuditRecord) -> None:
    content = canonical(record)
    found = parse_record(content)
    assert found == record and canonical(found) == content
    # An independent reader: plain JSON, plain hash.
    assert json.loads(content)["what"] == record.what
    assert head_of(content) == hashlib.sha256(content).hexdigest()


@settings(max_examples=50)
@given(RECORDS, st.data())
def test_no_changed_byte_is_read_as_the_record(record: AuditRecord, data: st.DataObject) -> None:
    content = bytearray(canonical(record))
    at = data.draw(st.integers(0, len(content) - 1))
    content[at] ^= 1 << data.draw(st.integers(0, 7))
    try:
        assert parse_record(bytes(content)) != record
    except NotRecordable:
        pass


@pytest.mark.parametrize(
    ("changes", "why"),
    [
        ({"what": {"x": float("nan")}}, "finite"),
        ({"what": {"x": float("inf")}}, "finite"),
        ({"what": {1: 2}}, "what"),
        ({"what": {"x": {1, 2}}}, "what"),
        ({"what": {"x": "x" * MOST_BYTES}}, "blobs"),
        ({"kind": "Proposed"}, "kind"),
        ({"sequence": 0}, "sequence"),
        ({"who": {"name": ""}}, "who"),
        ({"blobs": {"verdict": "abc"}}, "blobs"),
        ({"colour": 1}, "colour"),
    ],
)
def test_what_cannot_be_a_record_is_refused_with_the_reason(changes: dict[str, object], why: str) -> None:
    with pytest.raises(NotRecordable, match=why):
        record_of(fields(**changes))


@pytest.mark.parametrize("spoil", [lambda text: text.replace(b":", b": ", 1), lambda text: text + b"\n"])
def test_only_the_canonical_form_is_read(spoil: object) -> None:
    content = canonical(record_of(fields()))
    parse_record(content)
    with pytest.raises(NotRecordable, match="canonical"):
        parse_record(spoil(content))
    with pytest.raises(NotRecordable, match="twice"):
        parse_record(content.replace(b'"kind"', b'"kind":"x","kind"'))


@given(st.binary(max_size=50))
def test_a_blob_is_exported_as_what_it_was(payload: bytes) -> None:
    line = parse_line(line_text(blob_line(payload)).encode())
    assert line.payload() == payload
    assert list(wrong_in([line_text(line).encode()])) == []
