"""A versioned SQLite file of this program: opened, recognised as ours, checked, migrated; what SQLite says, in words.

There is no other way to open one. Whose file it is is asked before anything is written to it: what belongs to somebody
else is left as it is, to the byte. How it is written is part of what the file is (`Journal`).
"""

import errno
import os
import re
import struct
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from enum import Enum
from pathlib import Path
from typing import Any

import apsw

from gateway.files import what_is_there

BUSY_MS = 5000
CHECKED_WHOLE_BYTES = 256 * 2**20  #: files up to this size are checked whole when they are opened, about a second
_HEADER = struct.Struct(">16s44xI4xI")  # of an SQLite file: what it is, user_version, application_id
_MAGIC = b"SQLite format 3\0"
LOG_BYTES = 4 * 2**20  #: a write-ahead log is cut to it whenever it begins anew; SQLite copies it back from this size


class Journal(Enum):
    """What makes a change whole, as pragmas."""

    #: A rollback journal: what was said to be stored survives a kill and a power cut, a reader needs no file beside it,
    #: and a damaged page takes along nothing but itself. For what is stored some times a day, so that the time of a
    #: commit (1.7 ms at the median, measured; with a write-ahead log 0.5 ms) does not matter. Of its pages 64 kB stay
    #: in memory: with SQLite's own 2 MB a process grows by what it has stored, for months.
    ROLLBACK = "PRAGMA synchronous = EXTRA; PRAGMA foreign_keys = ON; PRAGMA cache_size = -64"
    #: A write-ahead log: readers and the writer never wait for one another, what was committed survives a kill; a power
    #: cut may take the last minute, never the consistency of the file. For what is stored all the time.
    WRITE_AHEAD = f"PRAGMA journal_mode = WAL; PRAGMA synchronous = NORMAL; PRAGMA journal_size_limit = {LOG_BYTES}"
    #: For a file that nobody sees before it is whole, and that is made anew rather than repaired.
    NONE = "PRAGMA journal_mode = OFF; PRAGMA synchronous = OFF"


@dataclass(frozen=True)
class FileKind:
    """What a file is, and what is said of it. `absent` has a {path}."""

    name: str  #: "model repository"
    application_id: int  #: so that no other program's SQLite file is mistaken for this
    migrations: Mapping[int, str]  #: from version k (the key) to k + 1; every version ever released stays
    error: type[Exception]  #: raised with a text that says why and what to do
    absent: str  #: what to do where there is none yet
    damaged: str  #: what to do with a damaged one
    undone: str = "nothing was stored"
    anothers: type[Exception] | None = None  #: raised for the file of another program; None: `error`
    journal: Journal = Journal.ROLLBACK
    additions: str = ""  #: IF NOT EXISTS: tables and indexes that older programs of the same schema need not know
    gives_back: bool = False  #: free pages can be given back to the disk; of a file that is begun
    busy_ms: int | None = None  #: how long a lock of somebody else is waited for; None: `BUSY_MS`

    @property
    def schema(self) -> int:
        return len(self.migrations)

    @property
    def waits_ms(self) -> int:
        return BUSY_MS if self.busy_ms is None else self.busy_ms


def open_there(path: Path, kind: FileKind) -> apsw.Connection:
    """Open a file that is there; one of an older schema is brought up to date. Raises `kind.error`."""
    _require_there(path, kind)
    with told(path, kind):
        return connect(path, kind, apsw.SQLITE_OPEN_READWRITE)  # SQLite reads only where it may not write


def begin(path: Path, kind: FileKind) -> apsw.Connection:
    """Open a file, or begin one. Raises `kind.error`."""
    try:
        path.parent.mkdir(mode=0o700, parents=True, exist_ok=True)
    except OSError as error:
        raise kind.error(f"a folder for {path} cannot be made: {error.strerror}; name another") from error
    with told(path, kind):
        return connect(path, kind)


def open_to_read(path: Path, kind: FileKind, busy_ms: int | None = None) -> apsw.Connection:
    """Open a file that is there, never to write to it: an older schema stays. Raises `kind.error`.

    It is not checked whole: for whoever asks often.
    """
    _require_there(path, kind)
    with told(path, kind):
        _require_not_anothers(path, kind)
        connection = apsw.Connection(os.fspath(path), flags=apsw.SQLITE_OPEN_READWRITE)
        try:
            connection.set_busy_timeout(kind.waits_ms if busy_ms is None else busy_ms)
            connection.execute("PRAGMA query_only = ON")
            _require_ours(connection, path, kind)
        except BaseException:
            connection.close()
            raise
    return connection


def connect(
    path: Path, kind: FileKind, flags: int = apsw.SQLITE_OPEN_READWRITE | apsw.SQLITE_OPEN_CREATE
) -> apsw.Connection:
    """As `begin`, for whoever tells damage from a full disk: raises apsw.Error and OSError as they are."""
    _require_file(path, kind)
    _require_not_anothers(path, kind)
    connection = apsw.Connection(os.fspath(path), flags=flags)
    try:
        connection.set_busy_timeout(kind.waits_ms)
        _require_ours(connection, path, kind)
        check_whole(connection, path)
        if kind.gives_back:
            connection.execute("PRAGMA auto_vacuum = INCREMENTAL")  # before the first table, or without effect
        connection.execute(kind.journal.value).fetchall()
        _migrate(connection, kind)
    except BaseException:
        connection.close()
        raise
    return connection


def check_whole(connection: apsw.Connection, path: Path) -> None:
    """Find damage before it is written upon, in a file that is not too large for it. Raises apsw.CorruptError."""
    if path.stat().st_size > CHECKED_WHOLE_BYTES:
        return
    found = connection.execute("PRAGMA quick_check(1)").get
    if found != "ok":
        raise apsw.CorruptError(str(found))


def _require_there(path: Path, kind: FileKind) -> None:
    with told(path, kind):
        _require_file(path, kind)
        if not path.is_file() or not path.stat().st_size:
            raise kind.error(kind.absent.format(path=path))


def _require_file(path: Path, kind: FileKind) -> None:
    """Nothing else lies under its name: SQLite would say no more than that it cannot be opened, or read from a pipe."""
    if wrong := what_is_there(path):
        raise kind.error(f"{path} is no {kind.name}: it {wrong}. It was left as it is; move it away")


def _require_not_anothers(path: Path, kind: FileKind) -> None:
    """Refuse what says so in its first bytes without a connection to it, which may bring its journal to an end."""
    if not path.is_file():
        return
    head = _beginning(path)
    if len(head) < _HEADER.size:
        return
    magic, version, owner = _HEADER.unpack(head)
    if magic == _MAGIC and owner != kind.application_id and (version or owner):
        raise _anothers(path, kind, owner)


def _beginning(path: Path) -> bytes:
    """Read by SQLite's own file: a descriptor of ours would take this process's locks along when it is closed.

    They are POSIX locks, which go with the first descriptor of the file that a process closes, whoever took them
    (sqlite.org/howtocorrupt.html, 2.2): another process would then undo what a thread of this one is writing.
    """
    if not os.access(path, os.R_OK):
        raise PermissionError(errno.EACCES, os.strerror(errno.EACCES), os.fspath(path))
    file = apsw.VFSFile(
        "",
        os.path.realpath(path),
        [  # it follows no link by itself
            apsw.SQLITE_OPEN_READONLY | apsw.SQLITE_OPEN_MAIN_DB,
            0,
        ],
    )
    try:
        return file.xRead(_HEADER.size, 0)
    finally:
        file.xClose()


def _require_ours(connection: apsw.Connection, path: Path, kind: FileKind) -> None:
    """Before anything is written to it. A version and an owner may lie in a log that was not copied back yet."""
    version = connection.pragma("user_version")
    owner = connection.pragma("application_id")
    tables = connection.execute("SELECT count(*) FROM sqlite_schema").get
    if owner != kind.application_id and (version or owner or tables):
        raise _anothers(path, kind, owner)
    if version > kind.schema:
        raise kind.error(
            f"{path} has schema {version}, this program knows {kind.schema}: update r2rgate, or use another file"
        )


def _anothers(path: Path, kind: FileKind, owner: int) -> Exception:
    return (kind.anothers or kind.error)(
        f"{path} is no {kind.name}: it belongs to another program (application id {owner:#x}). It was left as it is; "
        "name another folder"
    )


def _migrate(connection: apsw.Connection, kind: FileKind) -> None:
    """To today's schema, in one transaction."""
    if connection.pragma("user_version") == kind.schema and _has_additions(connection, kind):
        return  # without a lock: somebody may be reading
    with transaction(connection):
        version = int(connection.pragma("user_version"))  # again: another process may have been first
        for step in range(version, kind.schema):
            connection.execute(kind.migrations[step])
        if version != kind.schema:
            connection.execute(f"PRAGMA user_version = {kind.schema}")
        connection.execute(kind.additions)


def _has_additions(connection: apsw.Connection, kind: FileKind) -> bool:
    there = {name for (name,) in connection.execute("SELECT name FROM sqlite_schema")}
    return there.issuperset(re.findall(r"IF NOT EXISTS (\w+)", kind.additions))


@contextmanager
def transaction(connection: apsw.Connection) -> Iterator[None]:
    """All of it or nothing, with the write lock from the beginning."""
    connection.execute("BEGIN IMMEDIATE")
    try:
        yield
        connection.execute("COMMIT")
    except BaseException:
        if connection.in_transaction:
            connection.execute("ROLLBACK")
        raise


@contextmanager
def snapshot(connection: apsw.Connection) -> Iterator[None]:
    """Several reads of one state. Short: a writer waits for it."""
    connection.execute("BEGIN")
    try:
        yield
    finally:
        connection.execute("ROLLBACK")


def rows_of(connection: apsw.Connection, query: str, values: Sequence[str | int | None] = ()) -> list[Any]:
    """All rows at once, so that the file is held no longer than it takes."""
    return connection.execute(query, values).fetchall()


_READ_ONLY = "{path} cannot be written: the file or its folder is read-only, or no folder. Name one that you may write"

#: What SQLite says, and the words for it; the first that fits.
_WORDS: dict[type[apsw.Error], str] = {
    apsw.FullError: "the disk of {path} is full: {undone}. Free some space and try again",
    apsw.IOError: "the disk of {path} does not take or give what it should ({error}): {undone}. Look whether it is "
    "full or broken",
    apsw.BusyError: "another program has held {path} for {busy_s} s: nothing was done. Try again when it has ended",
    apsw.NotADBError: "{path} is no {name}: it is no SQLite file, or its beginning is damaged. {damaged}",
    apsw.CorruptError: "{path} is damaged ({error}). {damaged}",
    apsw.ReadOnlyError: _READ_ONLY,
    apsw.CantOpenError: _READ_ONLY,
    apsw.PermissionsError: _READ_ONLY,
    apsw.Error: "{path}: {error}: {undone}",
}


@contextmanager
def told(path: Path, kind: FileKind) -> Iterator[None]:
    """What SQLite says of the file, as `kind.error` in words that say what to do."""
    try:
        yield
    except (apsw.Error, UnicodeDecodeError) as error:  # the latter: text that is none any more
        kinds = (words for type_, words in _WORDS.items() if isinstance(error, type_))
        words = next(kinds, _WORDS[apsw.CorruptError])
        text = words.format(
            path=path,
            error=error,
            name=kind.name,
            damaged=kind.damaged,
            undone=kind.undone,
            busy_s=f"{kind.waits_ms / 1000:g}",
        )
        raise kind.error(text) from error
    except OSError as error:
        raise kind.error(f"{error.filename or path} cannot be read: {error.strerror}") from error
