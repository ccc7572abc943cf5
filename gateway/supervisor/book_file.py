"""What the audit of a folder says of proposals: the book that a gate begins with."""

from pathlib import Path
from typing import Any

from pydantic import TypeAdapter

from gateway.core.audit_record import AuditRecord
from gateway.supervisor.audit_file import AuditFile, AuditUnavailable
from gateway.supervisor.audit_writer import NOT_DONE
from gateway.supervisor.lifecycle import Book, Impossible, book_of

_SEQUENCES: TypeAdapter[set[int]] = TypeAdapter(set[int])


class CannotBegin(Exception):
    """The gate stays shut: its records cannot be read, or do not fit together. The text says why."""


def book_in(folder: Path) -> Book:
    """What the audit of a folder says; what a record calls not done was not. Raises CannotBegin."""
    try:
        return book_of((record.kind, _what(record)) for record in done_in(folder))
    except AuditUnavailable as error:
        raise CannotBegin(str(error)) from error
    except (Impossible, ValueError, KeyError) as error:
        raise CannotBegin(f"the records of the audit do not fit together: {error}; `r2rgate audit verify`") from error


def done_in(folder: Path) -> list[AuditRecord]:
    """A folder's records but those that were not done. Raises AuditUnavailable, ValueError and KeyError."""
    with AuditFile(folder) as file:
        records = [row.record() for row in file.rows()]
    not_done: set[int] = set()
    for record in records:
        if record.kind == NOT_DONE:
            not_done |= _SEQUENCES.validate_python(record.what["sequences"])
    return [record for record in records if record.sequence not in not_done]


def _what(record: AuditRecord) -> dict[str, Any]:
    """With its time, which earlier versions left to the record; whether the wall clock agreed then, nobody knows."""
    clock = {"boot": record.boot, "monotonic_s": record.monotonic_s, "agreed": False}
    return {"at_s": record.wall_s, "clock": clock, **record.what}
