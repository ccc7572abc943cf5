"""Writes frames and events of a line: at once into the history's tail, and from there, some seconds at a time, into
its database.

A reader finds each frame exactly once, wherever it lies. Methods may raise apsw.Error, OSError, store.NotOurs or
DiskFull; what `store` was given is then not stored, and what waits in the tail waits on.
"""

import os
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path

import apsw
import numpy as np
from numpy.typing import NDArray

from gateway.core.messages import Event
from gateway.core.steady_clock import JUMP_S
from gateway.storage.sqlite_file import LOG_BYTES
from gateway.supervisor.dating import note_agreed, note_seen, redate
from gateway.supervisor.retention import Allowance, Retention, expire
from gateway.supervisor.store import (
    Run,
    find_run,
    insert_blob,
    insert_events,
    insert_run,
    mark_packed,
    open_store,
    packed_record,
)
from gateway.supervisor.tail import DamagedTail, Tail, TailRecord, read_tail, table_of, tail_path

BLOB_S = 20.0  #: of frames in a blob: before the kernel writes the tail to the disk, and small columns share a page
MAX_BLOB_FRAMES = 20_000
MAX_TAIL_BYTES = 32 * 2**20  #: of frames and events in the tail, where they cannot be packed
MOST_LOG_BYTES = 4 * LOG_BYTES  #: beyond it somebody has kept a read open: it is copied back and cut


class DiskFull(Exception):
    """Less than the reserve is free."""


class Writer:
    def __init__(self, path: Path, run: Run, reserve_bytes: int) -> None:
        self.path = path
        self._run = run
        self._reserve_bytes = reserve_bytes
        self._connection: apsw.Connection | None = None
        self._inode: int | None = None
        self._run_id = 0
        self._tail: Tail | None = None
        self._gathered: list[TailRecord] = []  # what lies in the tail
        self._gathered_bytes = 0
        self._last_record = 0
        self._agreed_ahead_s: float | None = None  # by which all of this boot is dated
        self._allowance = Allowance()

    def store(self, frames: Sequence[bytes], events: Sequence[Event], wall_ahead_s: float) -> None:
        """Into the tail: from now on no kill takes it."""
        self._ready()
        if not frames and not events:
            return
        if self._gathered_bytes > MAX_TAIL_BYTES:
            self.pack()
        record = TailRecord(self._last_record + 1, wall_ahead_s, table_of(frames, self._run.spans), [*events])
        size_bytes = self._begun_tail().append(record)
        self._last_record = record.number
        if self._agreed_ahead_s is not None and abs(wall_ahead_s - self._agreed_ahead_s) > JUMP_S:
            self._agreed_ahead_s = None
        self._gathered.append(record)
        self._gathered_bytes += size_bytes

    def gathered_s(self) -> float:
        """From the first to the last frame in the tail."""
        parts = [record.frames for record in self._gathered if len(record.frames)]
        return float(parts[-1]["time_s"][-1] - parts[0]["time_s"][0]) if parts else 0.0

    def pack(self) -> None:
        """Move what lies in the tail into the database, in one transaction."""
        self._pack_into(self._ready())

    def date(self, ahead_s: float) -> None:
        """The wall clock has been seen to agree: what this boot has stored is dated by it, some of it each time."""
        connection = self._ready()
        if self._agreed_ahead_s == ahead_s:
            return
        more = True
        with connection:
            note_agreed(connection, self._run.boot, ahead_s)
            more = redate(connection, self._run.boot, ahead_s)
        if not more:
            self._agreed_ahead_s = ahead_s

    def expire(self, retention: Retention, now_s: float) -> None:
        """Delete some of what is too old or too much; `now_s` is monotonic."""
        expire(self._ready(), retention, self._allowance, self._run.boot, now_s)

    def disconnect(self) -> None:
        """Close the file, whatever state it is in; the next `store` opens it again. The tail stays."""
        connection, self._connection = self._connection, None
        if connection is not None:
            connection.close()

    def _last_s(self) -> float | None:
        """Of the newest frame in the tail, monotonic."""
        parts = [record.frames for record in self._gathered if len(record.frames)]
        return float(parts[-1]["time_s"][-1]) if parts else None

    def close(self) -> None:
        """For good. What could not be packed stays in the tail, and is found by whoever writes next."""
        if self._tail is not None:
            self._tail.close()
        self.disconnect()

    def _pack_into(self, connection: apsw.Connection) -> None:
        if not self._gathered:
            return
        with connection:
            _insert(connection, self._run_id, self._gathered)
            if (last_s := self._last_s()) is not None:
                note_seen(connection, self._run.boot, last_s)
        self._gathered, self._gathered_bytes = [], 0
        tail, self._tail = self._tail, None
        if tail is not None:
            tail.remove()
        self._cut_log(connection)

    def _cut_log(self, connection: apsw.Connection) -> None:
        """A log that a reader has let grow is copied back, as far as readers allow, and cut."""
        with suppress(FileNotFoundError, apsw.BusyError):
            if self.path.with_name(self.path.name + "-wal").stat().st_size > MOST_LOG_BYTES:
                connection.execute("PRAGMA wal_checkpoint(TRUNCATE)").fetchall()

    def _begun_tail(self) -> Tail:
        if self._tail is None:
            self._tail = Tail(tail_path(self.path), self._run_id, self._run)
        return self._tail

    def _ready(self) -> apsw.Connection:
        if self._connection is not None and not self._still_there():
            # Somebody moved, replaced or deleted the file. It gets what is its own, which SQLite leaves out when it
            # closes a file that has moved, but must not swallow what comes.
            self._pack_into(self._connection)
            self._connection.execute("PRAGMA wal_checkpoint(TRUNCATE)")
            self.disconnect()
        connection = self._connection or self._connect()
        free = os.statvfs(self.path.parent)
        if free.f_bavail * free.f_frsize < self._reserve_bytes:
            raise DiskFull(f"less than {self._reserve_bytes / 2**20:.0f} MB are free on the disk of {self.path.parent}")
        return connection

    def _connect(self) -> apsw.Connection:
        connection = open_store(self.path)
        try:
            inode = self.path.stat().st_ino
            if inode != self._inode:
                self._begin_in(connection)
                self._inode, self._agreed_ahead_s = inode, None
        except BaseException:
            connection.close()
            raise
        self._connection = connection
        return connection

    def _begin_in(self, connection: apsw.Connection) -> None:
        """In a file that this writer has not written yet: a run, and what lies in a tail beside it.

        The tail is that of a process that was killed; or this one's own, where the file before was damaged or is gone.
        """
        if self._tail is None:
            _pack_left(connection, tail_path(self.path))
        with connection:
            self._run_id = insert_run(connection, self._run)
            if self._gathered:
                _insert(connection, self._run_id, self._gathered)
        self._gathered, self._gathered_bytes = [], 0
        tail, self._tail = self._tail, None
        if tail is not None:
            tail.remove()

    def _still_there(self) -> bool:
        try:
            return self.path.stat().st_ino == self._inode
        except FileNotFoundError:
            return False


def _pack_left(connection: apsw.Connection, path: Path) -> None:
    """What a process that was killed has left; a tail that cannot be read is kept aside."""
    if not os.path.lexists(path):
        return
    try:
        found = read_tail(path)
    except DamagedTail:
        path.replace(path.with_name(path.name + "-damaged"))
        return
    if found is not None:
        with connection:
            run_id = find_run(connection, found.run_id, found.run)
            done = packed_record(connection, run_id)
            _insert(connection, run_id, [record for record in found.records if record.number > done])
    path.unlink()


def _insert(connection: apsw.Connection, run_id: int, records: Sequence[TailRecord]) -> None:
    """As blobs and events, within a transaction."""
    for frames, wall_ahead_s in _blobs(records):
        insert_blob(connection, run_id, frames, wall_ahead_s)
    for record in records:
        insert_events(connection, run_id, record.events, record.wall_ahead_s)
    if records:
        mark_packed(connection, run_id, records[-1].number)


def _blobs(records: Sequence[TailRecord]) -> list[tuple[NDArray[np.void], float]]:
    """Frames as they are gathered, each with what the wall clock was ahead; a new one where that has jumped."""
    found: list[tuple[list[NDArray[np.void]], float]] = []
    for record in records:
        if not len(record.frames):
            continue
        if not found or abs(found[-1][1] - record.wall_ahead_s) > JUMP_S:
            found.append(([], record.wall_ahead_s))
        found[-1][0].append(record.frames)
    whole = [(np.concatenate(parts), ahead_s) for parts, ahead_s in found]
    return [
        (frames[start : start + MAX_BLOB_FRAMES], ahead_s)
        for frames, ahead_s in whole
        for start in range(0, len(frames), MAX_BLOB_FRAMES)
    ]
