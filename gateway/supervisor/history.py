"""Reading a history, from any process, while it is being written."""

import json
import os
from collections.abc import Generator, Sequence
from contextlib import closing
from difflib import get_close_matches
from pathlib import Path
from typing import Any, NamedTuple

import apsw
import numpy as np
from numpy.typing import NDArray

from gateway.supervisor.blobs import DamagedBlob, unpack_column, unpack_times
from gateway.supervisor.store import PER_SPAN, SCHEMA, STORED_FIELDS

FIELDS = ("time_s", "wall_s", *STORED_FIELDS)
_BETWEEN_WALL = "end_s + blob.wall_ahead_s >= ? AND start_s + blob.wall_ahead_s <= ?"


class HistoryError(Exception):
    """The file cannot be read as asked; the text says why and what to do."""


class StoredEvent(NamedTuple):
    boot: str
    time_s: float  #: monotonic
    wall_s: float  #: Unix time
    kind: str
    text: str
    data: dict[str, Any]


class _Blob(NamedTuple):
    id: int
    frames: int
    wall_ahead_s: float
    spans: int


class History:
    """`close` it, or use it as a context manager. Raises HistoryError."""

    def __init__(self, path: Path) -> None:
        if not path.is_file():
            raise HistoryError(f"there is no history at {path}")
        try:
            self._connection = apsw.Connection(os.fspath(path), flags=apsw.SQLITE_OPEN_READWRITE)
            self._connection.set_busy_timeout(2000)
            self._connection.execute("PRAGMA query_only = ON")
            version = self._connection.pragma("user_version")
        except apsw.Error as error:
            raise HistoryError(f"{path} cannot be read: {error}") from error
        if version != SCHEMA:
            self._connection.close()
            raise HistoryError(f"{path} has schema {version}, this program reads {SCHEMA}")
        self.damaged: list[str] = []  #: blobs that could not be unpacked and are missing in what was read

    def __enter__(self) -> "History":
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        self._connection.close()

    def boots(self) -> list[str]:
        """Boots of the machine in which something was stored, the newest last."""
        rows = self._connection.execute("SELECT boot FROM run GROUP BY boot ORDER BY max(id)")
        return [boot for (boot,) in rows]

    def read(
        self, start_s: float, end_s: float, fields: Sequence[str], boot: str | None = None
    ) -> dict[str, NDArray[Any]]:
        """Samples with start_s <= time_s <= end_s (monotonic) of one boot, the newest by default.

        Returns each field, and always `time_s`, by name: shape (samples,), or (samples, n) for what belongs to a
        span or roller. `wall_s` is Unix time. Units are those of the names.
        """
        boot = boot or next(reversed(self.boots()), "")
        return self._read("run.boot = ? AND end_s >= ? AND start_s <= ?", (boot,), "time_s", start_s, end_s, fields)

    def read_wall(self, start_s: float, end_s: float, fields: Sequence[str]) -> dict[str, NDArray[Any]]:
        """As `read`, over all boots, between two instants of Unix time."""
        return self._read(_BETWEEN_WALL, (), "wall_s", start_s, end_s, fields)

    def walk_wall(
        self, start_s: float, end_s: float, fields: Sequence[str]
    ) -> Generator[dict[str, NDArray[Any]], None, None]:
        """As `read_wall`, in parts of some seconds, the oldest first: never more than one of them in memory."""
        return self._walk(_BETWEEN_WALL, (), "wall_s", start_s, end_s, fields)

    def events(self, start_s: float, end_s: float) -> list[StoredEvent]:
        """Events between two instants of Unix time, in order."""
        rows = self._connection.execute(
            "SELECT boot, time_s, wall_s, kind, text, data FROM event JOIN run ON run.id = event.run"
            " WHERE wall_s BETWEEN ? AND ? ORDER BY wall_s, event.id",
            (start_s, end_s),
        )
        return [
            StoredEvent(boot, time_s, wall_s, kind, text, json.loads(data))
            for boot, time_s, wall_s, kind, text, data in rows
        ]

    def _read(
        self, where: str, values: tuple[Any, ...], by: str, start_s: float, end_s: float, fields: Sequence[str]
    ) -> dict[str, NDArray[Any]]:
        with closing(self._walk(where, values, by, start_s, end_s, fields)) as walk:
            parts = list(walk)
        return {name: np.concatenate([part[name] for part in parts]) for name in dict.fromkeys(("time_s", *fields))}

    def _walk(
        self, where: str, values: tuple[Any, ...], by: str, start_s: float, end_s: float, fields: Sequence[str]
    ) -> Generator[dict[str, NDArray[Any]], None, None]:
        """The first part is empty, with the shapes of what follows."""
        _check_fields(fields)
        wanted = dict.fromkeys(("time_s", *fields))
        self._connection.execute("BEGIN")  # one snapshot, whatever the writer gathers meanwhile
        try:
            blobs = self._blobs(where, (*values, start_s, end_s))
            yield _nothing(wanted, blobs[0].spans if blobs else 0)
            for blob in blobs:
                columns = self._unpack(blob, [*wanted, by])
                if columns:
                    inside = (columns[by] >= start_s) & (columns[by] <= end_s)
                    yield {name: columns[name][inside] for name in wanted}
        except apsw.Error as error:
            raise HistoryError(f"the history cannot be read: {error}") from error
        finally:
            self._connection.execute("ROLLBACK")

    def _blobs(self, where: str, values: tuple[Any, ...]) -> list[_Blob]:
        sql = (
            "SELECT blob.id, frames, blob.wall_ahead_s, spans FROM blob JOIN run ON run.id = blob.run"
            f" WHERE {where} ORDER BY run.id, start_s"
        )
        blobs = [_Blob(*row) for row in self._connection.execute(sql, values)]
        if len({blob.spans for blob in blobs}) > 1:
            raise HistoryError("the line's number of spans changed in this interval: read it in two parts")
        return blobs

    def _unpack(self, blob: _Blob, names: Sequence[str]) -> dict[str, NDArray[Any]]:
        """The columns of a blob; none of a damaged one, which is noted."""
        try:
            time_s = unpack_times(self._packed(blob, "time_s"), blob.frames)
            columns: dict[str, NDArray[Any]] = {"time_s": time_s, "wall_s": time_s + blob.wall_ahead_s}
            for name in names:
                if name not in columns:
                    width = blob.spans if name in PER_SPAN else 1
                    column = unpack_column(self._packed(blob, name), STORED_FIELDS[name], blob.frames, width)
                    columns[name] = column if name in PER_SPAN else column.reshape(-1)
        except (DamagedBlob, apsw.CorruptError) as error:
            self.damaged.append(f"blob {blob.id}, {blob.frames} frames: {error}")
            return {}
        return columns

    def _packed(self, blob: _Blob, name: str) -> bytes:
        found = self._connection.execute("SELECT data FROM field WHERE blob = ? AND name = ?", (blob.id, name)).get
        if not isinstance(found, bytes):
            raise DamagedBlob(f"{name} is missing")
        return found


def _check_fields(fields: Sequence[str]) -> None:
    for name in fields:
        if name not in FIELDS:
            near = get_close_matches(name, FIELDS, 1, 0.0)[0]
            raise HistoryError(f"there is no field {name!r}; nearest is {near!r}, all are: {', '.join(FIELDS)}")


def _nothing(names: Sequence[str] | dict[str, None], spans: int) -> dict[str, NDArray[Any]]:
    empty: dict[str, NDArray[Any]] = {}
    for name in names:
        shape = (0, spans) if name in PER_SPAN else (0,)
        empty[name] = np.empty(shape, STORED_FIELDS.get(name, "<f8"))
    return empty
