"""A versioned SQLite file of this program: opened, recognised as ours, checked, migrated; what SQLite says, in words.

A rollback journal and `synchronous = EXTRA`: what was said to be stored survives a kill and a power cut, a reader needs
no file beside it, and a damaged page takes along nothing but itself. For what is stored some times a day, so that the
time of a commit (1.7 ms at the median, measured; with a write-ahead log 0.5 ms) does not matter.
"""

import os
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import apsw

BUSY_MS = 5000
CHECKED_WHOLE_BYTES = 256 * 2**20  #: files up to this size are checked whole when they are opened, about a second


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

    @property
    def schema(self) -> int:
        return len(self.migrations)


def open_there(path: Path, kind: FileKind) -> apsw.Connection:
    """Open a file that is there; one of an older schema is brought up to date. Raises `kind.error`."""
    with told(path, kind):
        if not path.is_file() or not path.stat().st_size:
            raise kind.error(kind.absent.format(path=path))
    return _opened(path, kind, apsw.SQLITE_OPEN_READWRITE)  # SQLite reads only where it may not write


def begin(path: Path, kind: FileKind) -> apsw.Connection:
    """Open a file, or begin one. Raises `kind.error`."""
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise kind.error(f"a folder for {path} cannot be made: {error.strerror}; name another") from error
    return _opened(path, kind, apsw.SQLITE_OPEN_READWRITE | apsw.SQLITE_OPEN_CREATE)


def _opened(path: Path, kind: FileKind, flags: int) -> apsw.Connection:
    with told(path, kind):
        connection = apsw.Connection(os.fspath(path), flags=flags)
        try:
            connection.set_busy_timeout(BUSY_MS)
            _require_ours(connection, path, kind)
            if path.stat().st_size <= CHECKED_WHOLE_BYTES:
                found = connection.execute("PRAGMA quick_check(1)").get
                if found != "ok":
                    raise apsw.CorruptError(str(found))
            connection.execute("PRAGMA synchronous = EXTRA")
            connection.execute("PRAGMA foreign_keys = ON")
            _migrate(connection, kind)
        except BaseException:
            connection.close()
            raise
    return connection


def _require_ours(connection: apsw.Connection, path: Path, kind: FileKind) -> None:
    """Before anything is written to it."""
    version = connection.pragma("user_version")
    owner = connection.pragma("application_id")
    tables = connection.execute("SELECT count(*) FROM sqlite_schema").get
    if owner != kind.application_id and (version or owner or tables):
        raise kind.error(
            f"{path} is no {kind.name}: it belongs to another program (application id {owner:#x}). It was left "
            "as it is; name another folder"
        )
    if version > kind.schema:
        raise kind.error(
            f"{path} has schema {version}, this program knows {kind.schema}: update r2rgate, or use another file"
        )


def _migrate(connection: apsw.Connection, kind: FileKind) -> None:
    """To today's schema, in one transaction."""
    if connection.pragma("user_version") == kind.schema:
        return
    with transaction(connection):
        version = int(connection.pragma("user_version"))  # again: another process may have been first
        for step in range(version, kind.schema):
            connection.execute(kind.migrations[step])
        connection.execute(f"PRAGMA user_version = {kind.schema}")


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
            path=path, error=error, name=kind.name, damaged=kind.damaged, undone=kind.undone, busy_s=BUSY_MS // 1000
        )
        raise kind.error(text) from error
    except OSError as error:
        raise kind.error(f"{path} cannot be read: {error.strerror}") from error
