"""The file of the System Model Repository: its tables in SQLite, and every version of them."""

from pathlib import Path

import apsw

from gateway.storage.sqlite_file import FileKind, begin, open_there

APPLICATION_ID = 0x52324D44  # "R2MD"

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


KIND = FileKind(
    "model repository",
    APPLICATION_ID,
    MIGRATIONS,
    ModelsError,
    absent="there are no models at {path}: r2rgate models import FILE takes one",
    damaged="It was left as it is; move it away, and import the models that you have as files",
)
SCHEMA = KIND.schema


def open_models(path: Path) -> apsw.Connection:
    """Open a file that is there; one of an older schema is brought up to date. Raises ModelsError."""
    return open_there(path, KIND)


def begin_models(path: Path) -> apsw.Connection:
    """Open a file, or begin one. Raises ModelsError."""
    return begin(path, KIND)
