"""The history file of a line: its tables in SQLite, how they are opened, migrated and written. One thread at a time.

Monotonic time restarts with the machine, so every row belongs to a run of the gateway, and a run to a boot; every
blob also carries what the wall clock was ahead of monotonic time when it was written, so that history can be dated
and a wall clock that jumped changes no earlier row.

WAL with synchronous = NORMAL: what was committed survives SIGKILL of this process; a power cut may take the last
seconds, never the consistency of the file.
"""

import json
import os
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import apsw
import numpy as np
from numpy.typing import NDArray

from gateway.core.messages import Event
from gateway.core.telemetry import BYTE_FIELDS, FLOAT_FIELDS
from gateway.supervisor.blobs import pack_column, pack_times

SCHEMA = 1
APPLICATION_ID = 0x52325247  # "R2RG": no other program's SQLite file is mistaken for a history
CHECKED_WHOLE_BYTES = 256 * 2**20  #: `check_whole` reads files up to this size, about a second

#: What is kept of a frame, with the type it is kept in.
STORED_FIELDS: dict[str, str] = {
    "sequence": "<u4",
    "lateness_s": "<f4",
    "cycle_s": "<f4",
    "missed": "<u4",
    "unwind_speed_m_per_s": "<f4",
    "speed_setpoint_m_per_s": "<f4",
    "state": "u1",
    "saturated": "u1",
    "held": "<u2",
    "doubts": "u1",
    **dict.fromkeys(FLOAT_FIELDS, "<f4"),
    **dict.fromkeys(BYTE_FIELDS, "i1"),
}
PER_SPAN = frozenset((*FLOAT_FIELDS, *BYTE_FIELDS))

_SCHEMA_1 = f"""
CREATE TABLE run (
    id INTEGER PRIMARY KEY,
    boot TEXT NOT NULL,             -- monotonic times compare within one boot only
    started_s REAL NOT NULL,        -- monotonic
    wall_ahead_s REAL NOT NULL,     -- Unix time minus monotonic time
    site TEXT NOT NULL,
    line TEXT NOT NULL,
    spans INTEGER NOT NULL
);
CREATE TABLE blob (
    id INTEGER PRIMARY KEY,
    run INTEGER NOT NULL REFERENCES run,
    start_s REAL NOT NULL,          -- monotonic, first and last sample
    end_s REAL NOT NULL,
    frames INTEGER NOT NULL,
    wall_ahead_s REAL NOT NULL
);
CREATE INDEX blob_by_time ON blob (start_s);
CREATE TABLE field (                -- one packed column of a blob; see blobs.py
    blob INTEGER NOT NULL REFERENCES blob,
    name TEXT NOT NULL,
    data BLOB NOT NULL,
    PRIMARY KEY (blob, name)
) WITHOUT ROWID;
CREATE TABLE event (
    id INTEGER PRIMARY KEY,
    run INTEGER NOT NULL REFERENCES run,
    time_s REAL NOT NULL,           -- monotonic
    wall_s REAL NOT NULL,           -- Unix time
    kind TEXT NOT NULL,
    text TEXT NOT NULL,
    data TEXT NOT NULL              -- JSON
);
CREATE INDEX event_by_time ON event (wall_s);
PRAGMA application_id = {APPLICATION_ID};
"""

#: From version k (the key) to version k + 1. Every version that was ever released stays here.
MIGRATIONS: dict[int, str] = {0: _SCHEMA_1}


class NotOurs(Exception):
    """The file is sound, but not one that this program may write. It is left alone."""


@dataclass(frozen=True)
class Run:
    """One life of the gateway process."""

    boot: str
    started_s: float
    wall_ahead_s: float
    site: str
    line: str
    spans: int


def boot_id() -> str:
    return Path("/proc/sys/kernel/random/boot_id").read_text("ascii").strip()


def open_store(path: Path) -> apsw.Connection:
    """Open or begin a history. Raises NotOurs, OSError, and apsw.CorruptError or NotADBError for a damaged file."""
    path.parent.mkdir(parents=True, exist_ok=True)
    connection = apsw.Connection(os.fspath(path))
    try:
        connection.set_busy_timeout(500)
        connection.execute("PRAGMA auto_vacuum = INCREMENTAL")  # of a new file; needed before its first table
        connection.execute("PRAGMA journal_mode = WAL")
        connection.execute("PRAGMA synchronous = NORMAL")
        _migrate(connection)
    except BaseException:
        connection.close()
        raise
    return connection


def check_whole(connection: apsw.Connection, path: Path) -> None:
    """Find damage before it is written upon. Raises apsw.CorruptError."""
    if path.stat().st_size > CHECKED_WHOLE_BYTES:
        return
    found = connection.execute("PRAGMA quick_check(1)").get
    if found != "ok":
        raise apsw.CorruptError(str(found))


def _migrate(connection: apsw.Connection) -> None:
    version = connection.pragma("user_version")
    owner = connection.pragma("application_id")
    if version and owner != APPLICATION_ID:
        raise NotOurs(f"it belongs to another program (application id {owner:#x})")
    if version > SCHEMA:
        raise NotOurs(f"it has schema {version}, this program writes {SCHEMA}: update r2rgate, or move the file away")
    for step in range(version, SCHEMA):
        with connection:
            connection.execute(MIGRATIONS[step])
            connection.execute(f"PRAGMA user_version = {step + 1}")


def insert_run(connection: apsw.Connection, run: Run) -> int:
    connection.execute(
        "INSERT INTO run (boot, started_s, wall_ahead_s, site, line, spans) VALUES (?, ?, ?, ?, ?, ?)",
        (run.boot, run.started_s, run.wall_ahead_s, run.site, run.line, run.spans),
    )
    return connection.last_insert_rowid()


def insert_blob(connection: apsw.Connection, run_id: int, frames: NDArray[np.void], wall_ahead_s: float) -> int:
    """`frames` as of `telemetry.frame_dtype`, at least one. Returns the blob's id."""
    time_s = frames["time_s"]
    connection.execute(
        "INSERT INTO blob (run, start_s, end_s, frames, wall_ahead_s) VALUES (?, ?, ?, ?, ?)",
        (run_id, float(time_s.min()), float(time_s.max()), len(frames), wall_ahead_s),
    )
    blob_id = connection.last_insert_rowid()
    columns = [(blob_id, name, pack_column(frames[name])) for name in STORED_FIELDS]
    connection.executemany(
        "INSERT INTO field (blob, name, data) VALUES (?, ?, ?)", [(blob_id, "time_s", pack_times(time_s)), *columns]
    )
    return blob_id


def delete_blobs(connection: apsw.Connection, blob_ids: Sequence[int]) -> None:
    for table, key in (("field", "blob"), ("blob", "id")):
        connection.executemany(f"DELETE FROM {table} WHERE {key} = ?", [(blob_id,) for blob_id in blob_ids])


def insert_events(connection: apsw.Connection, run_id: int, events: Sequence[Event], wall_ahead_s: float) -> None:
    connection.executemany(
        "INSERT INTO event (run, time_s, wall_s, kind, text, data) VALUES (?, ?, ?, ?, ?, ?)",
        [
            (run_id, event.time_s, event.time_s + wall_ahead_s, event.kind, event.text, json.dumps(event.data))
            for event in events
        ],
    )
