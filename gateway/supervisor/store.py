"""The history file of a line: its tables in SQLite, and how they are written. One thread at a time.

Monotonic time restarts with the machine, so every row belongs to a run of the gateway, and a run to a boot; every
blob also carries what the wall clock was ahead of monotonic time when it was written, so that history can be dated.
A wall clock that jumps changes no earlier row; one that was seen to agree afterwards dates the whole boot
(`dating.py`).

What is new lies in a file beside it first (`tail.py`), and comes here some seconds at a time.
"""

import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import apsw
import numpy as np
from numpy.typing import NDArray

from gateway.core.messages import Event
from gateway.core.telemetry import BYTE_FIELDS, FLOAT_FIELDS
from gateway.storage.sqlite_file import FileKind, Journal, connect
from gateway.supervisor import dating
from gateway.supervisor.blobs import pack_column, pack_times

APPLICATION_ID = 0x52325247  # "R2RG": no other program's SQLite file is mistaken for a history
BUSY_MS = 500

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

#: Later than schema 1, and nothing that an older program needs to know: it reads and writes the file as before.
_ADDITIONS = f"""
CREATE TABLE IF NOT EXISTS packed (
    run INTEGER PRIMARY KEY REFERENCES run,
    record INTEGER NOT NULL         -- of the run's tail, up to this one, everything lies in blobs and events
);
{dating.TABLE}"""

#: From version k (the key) to version k + 1. Every version that was ever released stays here.
MIGRATIONS: dict[int, str] = {0: _SCHEMA_1}


class NotOurs(Exception):
    """The file is sound, but not one that this program may write. It is left alone."""


KIND = FileKind(
    "history",
    APPLICATION_ID,
    MIGRATIONS,
    NotOurs,
    absent="there is no history at {path}",
    damaged="The gateway keeps it aside when it starts, and begins a new one",
    journal=Journal.WRITE_AHEAD,
    additions=_ADDITIONS,
    gives_back=True,
    busy_ms=BUSY_MS,
)
SCHEMA = KIND.schema


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
    path.parent.mkdir(mode=0o700, parents=True, exist_ok=True)
    return connect(path, KIND)


def find_run(connection: apsw.Connection, run_id: int, run: Run) -> int:
    """The number of a run in this file: `run_id`, where it is that one here, too; else it is begun."""
    found = connection.execute(
        "SELECT 1 FROM run WHERE id = ? AND boot = ? AND started_s = ?", (run_id, run.boot, run.started_s)
    ).get
    return run_id if found else insert_run(connection, run)


def insert_run(connection: apsw.Connection, run: Run) -> int:
    connection.execute(
        "INSERT INTO run (boot, started_s, wall_ahead_s, site, line, spans) VALUES (?, ?, ?, ?, ?, ?)",
        (run.boot, run.started_s, run.wall_ahead_s, run.site, run.line, run.spans),
    )
    run_id = connection.last_insert_rowid()
    dating.note_seen(connection, run.boot, run.started_s)
    return run_id


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


def mark_packed(connection: apsw.Connection, run_id: int, record: int) -> None:
    """Of this run's tail everything up to `record` lies in blobs and events."""
    connection.execute(
        "INSERT INTO packed (run, record) VALUES (?1, ?2) ON CONFLICT (run) DO UPDATE SET record = ?2",
        (run_id, record),
    )


def packed_record(connection: apsw.Connection, run_id: int) -> int:
    """The last record of this run's tail that lies in blobs and events; 0: none, also in a file of an older program."""
    if not connection.execute("SELECT count(*) FROM sqlite_schema WHERE name = 'packed'").get:
        return 0
    return connection.execute("SELECT record FROM packed WHERE run = ?", (run_id,)).get or 0


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
