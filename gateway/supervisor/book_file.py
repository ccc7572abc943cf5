"""What the audit of a folder says of proposals: the book that a gate begins with, and what it has forgotten.

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
from gateway.supervisor.lifecycle import (
    IN_THE_BOOK,
    LINE_CHANGED,
    PROPOSED,
    UNDECIDED,
    Book,
    Entry,
    Impossible,
    book_of,
    entry_of,
    superseded_by_change,
)

MOST_STEPS = 1000  #: records about proposals, that are read for one answer

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
        not_done, last, there = _not_done(file), file.last(), file.kinds()
        # By what is left out: a key of the index that is damaged is no kind that is, and its record is read.
        kinds = set(only) or {kind for kind in there if kind not in OFTEN or kind in IN_THE_BOOK}
        found = 0
        for row in file.rows_of(sorted(kinds), last):
            found += 1
            if (record := row.record()).kind not in kinds:
                raise NotRecordable(f"record {row.sequence} is not of the kind that the index says")
            if row.sequence not in not_done:
                yield record
        if not only and (found := found + sum(file.count_of(one, last) for one in there if one not in kinds)) != last:
            raise NotRecordable(f"the index of records has {found} of {last}")


def newest_in(folder: Path, most: int, skip: int) -> list[Entry]:
    """Proposals as they stand, the newest first, but for the first `skip`. Raises AuditUnavailable and ValueError."""
    with AuditFile(folder) as file:
        not_done = _not_done(file)
        rows = file.newest_of(PROPOSED, not_done, most, skip)
        found = (_entries_about(file, str(row.record().what["proposal"]), not_done) for row in rows)
        return [entry for entries in found for entry in entries]


def entries_in(folder: Path, beginning: str) -> list[Entry]:
    """The proposals whose hash begins so, as they stand; of more than some few, some. Raises as `newest_in`."""
    with AuditFile(folder) as file:
        return _entries_about(file, beginning, _not_done(file))


def _entries_about(file: AuditFile, beginning: str, not_done: set[int]) -> list[Entry]:
    steps: dict[str, list[AuditRecord]] = {}
    for row in file.about(beginning, MOST_STEPS):
        if row.sequence not in not_done and (record := row.record()).kind in IN_THE_BOOK:
            steps.setdefault(str(record.what.get("proposal")), []).append(record)
    found = [(entry_of((one.kind, _what(one)) for one in records), records[-1]) for records in steps.values()]
    return [_ended(file, entry, last) for entry, last in found if entry is not None]


def _ended(file: AuditFile, entry: Entry, last: AuditRecord) -> Entry:
    """Said to have changed, a line supersedes whatever waited then, without a record of each."""
    if entry.stage in UNDECIDED:
        for row in file.rows_of([LINE_CHANGED]):
            if row.sequence > last.sequence:
                return superseded_by_change(entry, _what(row.record()))
    return entry


def _not_done(file: AuditFile) -> set[int]:
    noted = (row.record().what["sequences"] for row in file.rows_of([NOT_DONE]))
    return {number for one in noted for number in _SEQUENCES.validate_python(one)}


def _what(record: AuditRecord) -> dict[str, Any]:
    """With its time, which earlier versions left to the record; whether the wall clock agreed then, nobody knows."""
    clock = {"boot": record.boot, "monotonic_s": record.monotonic_s, "agreed": False}
    return {"at_s": record.wall_s, "clock": clock, **record.what}
