"""The file of the System Model Repository: its tables in SQLite, how it is opened, migrated and written.

A rollback journal and `synchronous = EXTRA`: what was said to be stored survives a kill and a power cut, and a reader
needs no file beside it. Models are stored a few times a day, so that the time of a commit does not matter.
"""

import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import apsw

SCHEMA = 2
APPLICATION_ID = 0x52324D44  # "R2MD": neither a history nor another program's SQLite file is mistaken for this
BUSY_MS = 5000

_SCHEMA_1 = f"""
CREATE TABLE model (
    id TEXT PRIMARY KEY NOT NULL,   -- SHA-256 of the content, in hexadecimal
    site TEXT NOT NULL,
    line TEXT NOT NULL,
    version INTEGER NOT NULL,       -- of its line, from 1
    stored_s REAL NOT NULL,         -- Unix time
    content BLOB NOT NULL,          -- canonical JSON; see gateway/core/line_model.py
    UNIQUE (site, line, version)
);
PRAGMA application_id = {APPLICATION_ID};
"""

_SCHEMA_2 = """
CREATE TABLE mark (
    id INTEGER PRIMARY KEY,         -- the last of a model is its state
    model TEXT NOT NULL REFERENCES model,
    state TEXT NOT NULL CHECK (state IN ('accepted', 'superseded', 'rejected')),
    time_s REAL NOT NULL,           -- Unix time
    reason TEXT NOT NULL
);
CREATE INDEX mark_by_model ON mark (model);
CREATE TRIGGER model_stays BEFORE UPDATE ON model BEGIN SELECT RAISE(ABORT, 'a stored model never changes'); END;
CREATE TRIGGER model_is_kept BEFORE DELETE ON model BEGIN SELECT RAISE(ABORT, 'a stored model is kept'); END;
CREATE TRIGGER mark_stays BEFORE UPDATE ON mark BEGIN SELECT RAISE(ABORT, 'a mark never changes'); END;
CREATE TRIGGER mark_is_kept BEFORE DELETE ON mark BEGIN SELECT RAISE(ABORT, 'a mark is kept'); END;
"""

#: From version k (the key) to version k + 1. Every version that was ever released stays here.
MIGRATIONS: dict[int, str] = {0: _SCHEMA_1, 1: _SCHEMA_2}


class ModelsError(Exception):
    """The repository cannot do what was asked; the text says why and what to do."""


def open_models(path: Path) -> apsw.Connection:
    """Open a file that is there; one of an older schema is brought up to date. Raises ModelsError."""
    with told(path):
        if not path.is_file() or not path.stat().st_size:
            raise ModelsError(f"there are no models at {path}: r2rgate models import FILE takes one")
    return _opened(path, apsw.SQLITE_OPEN_READWRITE)  # SQLite reads only where it may not write


def begin_models(path: Path) -> apsw.Connection:
    """Open a file, or begin one. Raises ModelsError."""
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise ModelsError(f"a folder for {path} cannot be made: {error.strerror}; name another") from error
    return _opened(path, apsw.SQLITE_OPEN_READWRITE | apsw.SQLITE_OPEN_CREATE)


def _opened(path: Path, flags: int) -> apsw.Connection:
    with told(path):
        connection = apsw.Connection(os.fspath(path), flags=flags)
        try:
            connection.set_busy_timeout(BUSY_MS)
            _require_ours(connection, path)
            found = connection.execute("PRAGMA quick_check(1)").get
            if found != "ok":
                raise apsw.CorruptError(str(found))
            connection.execute("PRAGMA synchronous = EXTRA")
            connection.execute("PRAGMA foreign_keys = ON")
            _migrate(connection)
        except BaseException:
            connection.close()
            raise
    return connection


def _require_ours(connection: apsw.Connection, path: Path) -> None:
    """Before anything is written to it."""
    version = connection.pragma("user_version")
    owner = connection.pragma("application_id")
    tables = connection.execute("SELECT count(*) FROM sqlite_schema").get
    if owner != APPLICATION_ID and (version or owner or tables):
        raise ModelsError(
            f"{path} is no model repository: it belongs to another program (application id {owner:#x}). It was left "
            "as it is; name another folder"
        )
    if version > SCHEMA:
        raise ModelsError(
            f"{path} has schema {version}, this program knows {SCHEMA}: update r2rgate, or use another file"
        )


def _migrate(connection: apsw.Connection) -> None:
    """To today's schema, in one transaction."""
    if connection.pragma("user_version") == SCHEMA:
        return
    with transaction(connection):
        version = int(connection.pragma("user_version"))  # again: another process may have been first
        for step in range(version, SCHEMA):
            connection.execute(MIGRATIONS[step])
        connection.execute(f"PRAGMA user_version = {SCHEMA}")


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


_LEFT = "It was left as it is; move it away, and import the models that you have as files"
_READ_ONLY = "{path} cannot be written: the file or its folder is read-only, or no folder. Name one that you may write"

#: What SQLite says, and the words for it; the first that fits.
_WORDS: dict[type[apsw.Error], str] = {
    apsw.FullError: "the disk of {path} is full: nothing was stored. Free some space and try again",
    apsw.IOError: "the disk of {path} does not take or give what it should ({error}): nothing was stored. Look whether "
    "it is full or broken",
    apsw.BusyError: f"another program has held {{path}} for {BUSY_MS // 1000} s: nothing was done. Try again when it "
    "has ended",
    apsw.NotADBError: "{path} is no model repository: it is no SQLite file, or its beginning is damaged. " + _LEFT,
    apsw.CorruptError: "{path} is damaged ({error}). " + _LEFT,
    apsw.ReadOnlyError: _READ_ONLY,
    apsw.CantOpenError: _READ_ONLY,
    apsw.PermissionsError: _READ_ONLY,
    apsw.Error: "{path}: {error}: nothing was stored",
}


@contextmanager
def told(path: Path) -> Iterator[None]:
    """What SQLite says of the file, as ModelsError in words that say what to do."""
    try:
        yield
    except apsw.Error as error:
        words = next(words for kind, words in _WORDS.items() if isinstance(error, kind))
        raise ModelsError(words.format(path=path, error=error)) from error
    except OSError as error:
        raise ModelsError(f"{path} cannot be read: {error.strerror}") from error
