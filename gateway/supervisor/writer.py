"""Writes frames and events into the history file: first as small blobs, at once, then gathered into large ones.

A reader needs to know nothing of this: blobs of any length lie side by side, and each frame is in exactly one.
Every method may raise apsw.Error, OSError, store.NotOurs or DiskFull; what it was given is then not stored.
"""

import os
from collections.abc import Sequence
from pathlib import Path

import apsw
import numpy as np
from numpy.typing import NDArray

from gateway.core.messages import Event
from gateway.core.telemetry import frame_dtype
from gateway.supervisor.retention import Retention, expire
from gateway.supervisor.store import (
    Run,
    check_whole,
    delete_blobs,
    insert_blob,
    insert_events,
    insert_run,
    open_store,
)

BLOB_S = 10.0
MAX_BLOB_FRAMES = 20_000


class DiskFull(Exception):
    """Less than the reserve is free."""


class Writer:
    def __init__(self, path: Path, run: Run, reserve_bytes: int) -> None:
        self.path = path
        self._run = run
        self._reserve_bytes = reserve_bytes
        self._dtype = frame_dtype(run.spans)
        self._connection: apsw.Connection | None = None
        self._inode: int | None = None
        self._run_id = 0
        self._gathered: list[bytes] = []  # stored, in the blobs `_small`
        self._small: list[int] = []

    def store(self, frames: Sequence[bytes], events: Sequence[Event], wall_ahead_s: float) -> None:
        """Commit what is new, in one transaction."""
        connection = self._ready()
        if not frames and not events:
            return
        blobs: list[int] = []
        with connection:
            for start in range(0, len(frames), MAX_BLOB_FRAMES):
                part = self._table(frames[start : start + MAX_BLOB_FRAMES])
                blobs.append(insert_blob(connection, self._run_id, part, wall_ahead_s))
            insert_events(connection, self._run_id, events, wall_ahead_s)
        self._gathered += frames
        self._small += blobs

    def gathered_s(self) -> float:
        """From the first to the last frame that lies in small blobs."""
        if not self._gathered:
            return 0.0
        first, last = self._table((self._gathered[0], self._gathered[-1]))["time_s"]
        return float(last - first)

    def pack(self, wall_ahead_s: float) -> None:
        """Replace the small blobs by one, in one transaction."""
        if len(self._small) > 1 and len(self._gathered) <= MAX_BLOB_FRAMES:
            connection = self._ready()
            with connection:
                delete_blobs(connection, self._small)
                insert_blob(connection, self._run_id, self._table(self._gathered), wall_ahead_s)
        self._forget()

    def expire(self, retention: Retention, wall_s: float) -> None:
        """Delete some of what is too old or too much."""
        expire(self._ready(), retention, wall_s)

    def disconnect(self) -> None:
        """Close the file, whatever state it is in; the next `store` opens it again."""
        connection, self._connection = self._connection, None
        self._forget()
        if connection is not None:
            connection.close()

    def _ready(self) -> apsw.Connection:
        if self._connection is not None and not self._still_there():
            # Somebody moved, replaced or deleted the file. It gets what is its own, which SQLite leaves out when it
            # closes a file that has moved, but must not swallow what comes.
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
                check_whole(connection, self.path)
                with connection:
                    self._run_id = insert_run(connection, self._run)
                self._inode = inode
        except BaseException:
            connection.close()
            raise
        self._connection = connection
        return connection

    def _still_there(self) -> bool:
        try:
            return self.path.stat().st_ino == self._inode
        except FileNotFoundError:
            return False

    def _forget(self) -> None:
        self._gathered, self._small = [], []

    def _table(self, frames: Sequence[bytes]) -> NDArray[np.void]:
        return np.frombuffer(b"".join(frames), self._dtype)
