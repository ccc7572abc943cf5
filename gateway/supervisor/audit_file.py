"""The database of the audit: its tables, and reading them from any process while another writes.

Reading says what is there, sound or not; `audit_verify` judges. Each read is short, because a writer waits for it.
"""

import json
from collections.abc import Iterable, Iterator
from heapq import merge
from operator import itemgetter
from pathlib import Path
from typing import NamedTuple

import apsw

from gateway.core.audit_record import AuditRecord, NotRecordable, head_of, parse_record
from gateway.storage.sqlite_file import FileKind, open_to_read, told

FILE_NAME = "audit.sqlite"
APPLICATION_ID = 0x52324155  # "R2AU"
AT_ONCE = 200  #: records read in one go

_SCHEMA_1 = f"""
CREATE TABLE record (
    sequence INTEGER PRIMARY KEY,
    content BLOB NOT NULL,          -- canonical JSON; see gateway/core/audit_record.py
    head TEXT NOT NULL              -- SHA-256 of the content, in hexadecimal
);
CREATE TABLE blob (
    id TEXT PRIMARY KEY NOT NULL,   -- SHA-256 of the content, in hexadecimal
    content BLOB NOT NULL
);
CREATE TRIGGER record_stays BEFORE UPDATE ON record BEGIN SELECT RAISE(ABORT, 'a record never changes'); END;
CREATE TRIGGER record_is_kept BEFORE DELETE ON record BEGIN SELECT RAISE(ABORT, 'a record is kept'); END;
CREATE TRIGGER blob_stays BEFORE UPDATE ON blob BEGIN SELECT RAISE(ABORT, 'a blob never changes'); END;
CREATE TRIGGER blob_is_kept BEFORE DELETE ON blob BEGIN SELECT RAISE(ABORT, 'a blob is kept'); END;
PRAGMA application_id = {APPLICATION_ID};
"""

#: Of a record; null where it is none, or names no proposal.
_KIND_OF, _PROPOSAL_OF = (
    f"CASE WHEN json_valid(CAST(content AS TEXT)) THEN json_extract(CAST(content AS TEXT), '{path}') END"
    for path in ("$.kind", "$.what.proposal")
)

#: From version k (the key) to version k + 1. Every version that was ever released stays here.
MIGRATIONS: dict[int, str] = {0: _SCHEMA_1}

WHAT_TO_DO = (
    "No change to the line's control is made until this is settled. r2rgate audit verify says what is wrong; restore "
    "the audit's files from a copy, or have an engineer begin anew: r2rgate audit begin-anew --because TEXT keeps the "
    "old files aside"
)


class AuditUnavailable(Exception):
    """The audit takes no record, or cannot be read; the text says why and what to do. No change may be made."""


KIND = FileKind(
    "audit",
    APPLICATION_ID,
    MIGRATIONS,
    AuditUnavailable,
    absent="there is no audit at {path}; a gateway begins one when it starts",
    damaged=f"It was left as it is. {WHAT_TO_DO}",
    undone="nothing was recorded, so that nothing may be changed",
    additions=f"""
        CREATE INDEX IF NOT EXISTS record_kind ON record ({_KIND_OF});
        CREATE INDEX IF NOT EXISTS record_proposal ON record ({_PROPOSAL_OF});
    """,
)


class Row(NamedTuple):
    """A record as it lies there."""

    sequence: int
    content: bytes
    head: str

    def record(self) -> AuditRecord:
        """Raises NotRecordable where it is not what was stored."""
        record = parse_record(self.content)
        if record.sequence != self.sequence:
            raise NotRecordable(f"it says that it is record {record.sequence}")
        if head_of(self.content) != self.head:
            raise NotRecordable("its head is not the hash of its content")
        return record


class AuditFile:
    """The database, opened for reading; `close` it, or use it as a context manager. Raises AuditUnavailable.

    It is not checked whole: each row and each blob shows by its hash whether it is what was stored.
    """

    def __init__(self, folder: Path, connection: apsw.Connection | None = None) -> None:
        self.path = folder / FILE_NAME
        self.connection = connection or open_to_read(self.path, KIND)

    def __enter__(self) -> "AuditFile":
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        self.connection.close()

    def last(self) -> int:
        """The number of the last record; 0: there is none."""
        with told(self.path, KIND):
            found = self.connection.execute("SELECT max(sequence) FROM record").get
        return found or 0

    def rows(self, first: int = 1) -> Iterator[Row]:
        """From `first` on, in order."""
        after = first - 1
        while True:
            with told(self.path, KIND):
                part = self.connection.execute(
                    "SELECT sequence, content, CAST(head AS BLOB) FROM record WHERE sequence > ?"
                    " ORDER BY sequence LIMIT ?",
                    (after, AT_ONCE),
                ).fetchall()
            rows = [_row(*one) for one in part]
            yield from rows
            # A damaged database may say anything, also the same again.
            if len(rows) < AT_ONCE or rows[-1].sequence <= after:
                return
            after = rows[-1].sequence

    def kinds(self) -> list[str]:
        """Of all records that are there, each once, as the index has them."""
        found, kind = list[str](), ""
        with told(self.path, KIND):
            while True:
                query = f"SELECT {_KIND_OF} FROM record WHERE {_KIND_OF} > ? ORDER BY {_KIND_OF} LIMIT 1"
                if not isinstance(kind := self.connection.execute(query, (kind,)).get, str):
                    return found
                found.append(kind)

    def rows_of(self, kinds: Iterable[str], last: int | None = None) -> Iterator[Row]:
        """Those of some kinds, in order, and with them whatever is no record. Others are not read.

        Up to `last`, or of what is there now. By the index, which whoever writes here makes; without it, it takes its
        time. Where the index is damaged, some may be absent: see `count_of`. Raises NotRecordable where some are twice.
        """
        last = self.last() if last is None else last
        return merge(*(self._rows_of(kind, last) for kind in (None, *kinds)), key=itemgetter(0))

    def count_of(self, kind: str, last: int) -> int:
        """How many of a kind the index has, up to `last`."""
        query = f"SELECT count(*) FROM record WHERE {_KIND_OF} = ? AND sequence <= ?"
        with told(self.path, KIND):
            return int(self.connection.execute(query, (kind, last)).get)

    def _rows_of(self, kind: str | None, last: int) -> Iterator[Row]:
        after = 0
        while True:
            with told(self.path, KIND):
                part = self.connection.execute(
                    f"SELECT sequence, content, CAST(head AS BLOB) FROM record WHERE {_KIND_OF} IS ? AND sequence > ?"
                    " AND sequence <= ? ORDER BY sequence LIMIT ?",
                    (kind, after, last, AT_ONCE),
                ).fetchall()
            for one in part:
                row = _row(*one)
                if row.sequence <= after:
                    raise NotRecordable(f"the index of records is damaged: record {row.sequence} is not in its place")
                yield row
                after = row.sequence
            if len(part) < AT_ONCE:
                return

    def newest_of(self, kind: str, but: Iterable[int], most: int, skip: int) -> list[Row]:
        """Of one kind, the newest first, but for the first `skip`; those of the numbers `but` count for none."""
        query = (
            f"SELECT sequence, content, CAST(head AS BLOB) FROM record WHERE {_KIND_OF} = ?"
            " AND sequence NOT IN (SELECT value FROM json_each(?)) ORDER BY sequence DESC LIMIT ? OFFSET ?"
        )
        with told(self.path, KIND):
            found = self.connection.execute(query, (kind, json.dumps(list(but)), most, skip)).fetchall()
        return [_row(*one) for one in found]

    def about(self, beginning: str, most: int) -> list[Row]:
        """Those about proposals whose hash begins so, in order; the first `most`."""
        query = (
            f"SELECT sequence, content, CAST(head AS BLOB) FROM record WHERE {_PROPOSAL_OF} >= ?"
            f" AND {_PROPOSAL_OF} < ? ORDER BY +sequence LIMIT ?"  # by the index, then in order
        )
        with told(self.path, KIND):
            found = self.connection.execute(query, (beginning, f"{beginning}~", most)).fetchall()
        return [_row(*one) for one in found]

    def blob(self, id_: str) -> bytes | None:
        """What is called so; None: there is none, or it is not what was stored."""
        with told(self.path, KIND):
            found = self.connection.execute("SELECT content FROM blob WHERE id = ?", (id_,)).get
        return found if isinstance(found, bytes) and head_of(found) == id_ else None

    def blob_ids(self) -> list[str]:
        with told(self.path, KIND):
            return [_text(id_) for (id_,) in self.connection.execute("SELECT CAST(id AS BLOB) FROM blob").fetchall()]


def _row(sequence: object, content: object, head: object) -> Row:
    """Whatever types a damaged database gives."""
    return Row(
        sequence if isinstance(sequence, int) else 0,
        content if isinstance(content, bytes) else b"",
        _text(head),
    )


def _text(given: object) -> str:
    return given.decode("ascii", "replace") if isinstance(given, bytes) else ""
