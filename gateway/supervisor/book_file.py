"""What the audit of a folder says of proposals: the book that a gate begins with.

Only what the book goes by is read, and one record at a time: what else people and agents had written down, of which
there may be a hundred times more, costs neither time nor memory.
"""

from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any

from pydantic import TypeAdapter

from gateway.core.audit_record import AuditRecord, NotRecordable
from gateway.supervisor.audit import OFTEN
from gateway.supervisor.audit_file import AuditFile, AuditUnavailable
from gateway.supervisor.audit_writer import NOT_DONE
from gateway.supervisor.lifecycle import IN_THE_BOOK, Book, Impossible, book_of

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


def done_in(folder: Path, only: Iterable[str] = ()) -> Iterator[AuditRecord]:
    """A folder's records but those that were not done: of the kinds `only`, or of all that a book may go by.

    Raises AuditUnavailable, ValueError and KeyError, the last two also where anything that is there is no record.
    """
    with AuditFile(folder) as file:
        noted = (row.record().what["sequences"] for row in file.rows_of([NOT_DONE]))
        not_done = {number for one in noted for number in _SEQUENCES.validate_python(one)}
        # By what is left out: a key of the index that is damaged is no kind that is, and its record is read.
        kinds = set(only) or {kind for kind in file.kinds() if kind not in OFTEN or kind in IN_THE_BOOK}
        for row in file.rows_of(sorted(kinds)):
            if (record := row.record()).kind not in kinds:
                raise NotRecordable(f"record {row.sequence} is not of the kind that the index says")
            if row.sequence not in not_done:
                yield record


def _what(record: AuditRecord) -> dict[str, Any]:
    """With its time, which earlier versions left to the record; whether the wall clock agreed then, nobody knows."""
    clock = {"boot": record.boot, "monotonic_s": record.monotonic_s, "agreed": False}
    return {"at_s": record.wall_s, "clock": clock, **record.what}
