"""Reading a history, from any process, while it is being written.

No read stays open for longer than it takes to fetch one blob: whoever walks through a history as slowly as somebody
turns pages must not keep SQLite from beginning its log anew. A blob never changes, so that what was listed in one
moment can be fetched one by one; what has become too old meanwhile is gone.
"""

import json
from collections.abc import Generator, Iterable, Sequence
from contextlib import closing
from dataclasses import replace
from difflib import get_close_matches
from pathlib import Path
from typing import Any, NamedTuple, cast

import apsw
import numpy as np
from numpy.typing import NDArray

from gateway.storage.sqlite_file import open_to_read, snapshot, told
from gateway.supervisor.blobs import DamagedBlob, unpack_column, unpack_times
from gateway.supervisor.dating import agreed_ahead
from gateway.supervisor.store import KIND, PER_SPAN, STORED_FIELDS, packed_record
from gateway.supervisor.tail import DamagedTail, TailRead, TailRecord, read_tail, tail_path

FIELDS = ("time_s", "wall_s", *STORED_FIELDS)
_BETWEEN_WALL = "end_s + blob.wall_ahead_s >= ? AND start_s + blob.wall_ahead_s <= ?"


class HistoryError(Exception):
    """The file cannot be read as asked; the text says why and what to do."""


_KIND = replace(KIND, error=HistoryError, absent="there is no history at {path}")
BUSY_MS = 2000


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
        self._path = path
        self._connection = open_to_read(path, _KIND, BUSY_MS)
        self.damaged: list[str] = []  #: blobs that could not be unpacked and are missing in what was read

    def __enter__(self) -> "History":
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        self._connection.close()

    def boots(self) -> list[str]:
        """Boots of the machine in which something was stored, the newest last."""
        with told(self._path, _KIND):
            rows = self._connection.execute("SELECT boot FROM run GROUP BY boot ORDER BY max(id)").fetchall()
        return [str(boot) for (boot,) in rows]

    def read(
        self, start_s: float, end_s: float, fields: Sequence[str], boot: str | None = None
    ) -> dict[str, NDArray[Any]]:
        """Samples with start_s <= time_s <= end_s (monotonic) of one boot, the newest by default.

        Returns each field, and always `time_s`, by name: shape (samples,), or (samples, n) for what belongs to a
        span or roller. `wall_s` is Unix time. Units are those of the names.
        """
        boot = boot or next(reversed(self.boots()), "")
        where = "run.boot = ? AND end_s >= ? AND start_s <= ?"
        return _joined(self._walk(where, (boot,), "time_s", start_s, end_s, fields, boot), fields)

    def read_wall(self, start_s: float, end_s: float, fields: Sequence[str]) -> dict[str, NDArray[Any]]:
        """As `read`, over all boots, between two instants of Unix time."""
        return _joined(self.walk_wall(start_s, end_s, fields), fields)

    def walk_wall(
        self, start_s: float, end_s: float, fields: Sequence[str]
    ) -> Generator[dict[str, NDArray[Any]], None, None]:
        """As `read_wall`, in parts of some seconds, the oldest first: never more than one of them in memory."""
        return self._walk(_BETWEEN_WALL, (), "wall_s", start_s, end_s, fields)

    def agreed_ahead(self) -> dict[str, float]:
        """By boot, what its wall clock was ahead of its monotonic one, where it was seen to agree with it."""
        with told(self._path, _KIND):
            return agreed_ahead(self._connection)

    def events(self, start_s: float, end_s: float, kinds: Sequence[str] = ()) -> list[StoredEvent]:
        """Events between two instants of Unix time, in order; of these kinds, or of all."""
        tail = self._tail()
        with told(self._path, _KIND), snapshot(self._connection):
            rows = self._connection.execute(
                "SELECT boot, time_s, wall_s, kind, text, data FROM event JOIN run ON run.id = event.run"
                " WHERE wall_s BETWEEN ? AND ? AND (? OR kind IN (SELECT value FROM json_each(?)))"
                " ORDER BY wall_s, event.id",
                (start_s, end_s, not kinds, json.dumps(kinds)),
            ).fetchall()
            new = self._unpacked(tail)
        found = [
            StoredEvent(boot, time_s, wall_s, kind, text, json.loads(data))
            for boot, time_s, wall_s, kind, text, data in cast("list[tuple[str, float, float, str, str, str]]", rows)
        ]
        if tail is not None:
            dated = [(one, one.time_s + record.wall_ahead_s) for record in new for one in record.events]
            found += [
                StoredEvent(tail.run.boot, one.time_s, wall_s, one.kind, one.text, one.data)
                for one, wall_s in dated
                if start_s <= wall_s <= end_s and (not kinds or one.kind in kinds)
            ]
        return sorted(found, key=lambda event: event.wall_s)

    def _walk(
        self,
        where: str,
        values: tuple[Any, ...],
        by: str,
        start_s: float,
        end_s: float,
        fields: Sequence[str],
        boot: str | None = None,
    ) -> Generator[dict[str, NDArray[Any]], None, None]:
        """The first part is empty, with the shapes of what follows. What lies in the tail comes last."""
        _check_fields(fields)
        wanted = dict.fromkeys(("time_s", *fields))
        tail = self._tail()  # before the database: what is packed in between is in both, and told apart
        if tail is not None and boot not in (None, tail.run.boot):
            tail = None
        with told(self._path, _KIND), snapshot(self._connection):
            blobs = self._blobs(where, (*values, start_s, end_s))
            columns_of_tail = [_columns(record, wanted) for record in self._unpacked(tail)]
        parts = [
            part for columns in columns_of_tail if len((part := _inside(columns, by, start_s, end_s, wanted))["time_s"])
        ]
        spans = {blob.spans for blob in blobs} | ({tail.run.spans} if tail is not None and parts else set[int]())
        if len(spans) > 1:
            raise HistoryError("the line's number of spans changed in this interval: read it in two parts")
        yield _nothing(wanted, next(iter(spans), 0))
        for blob in blobs:
            with told(self._path, _KIND):
                columns = self._unpack(blob, [*wanted, by])
            if columns:
                yield _inside(columns, by, start_s, end_s, wanted)
        yield from parts

    def _tail(self) -> TailRead | None:
        try:
            return read_tail(tail_path(self._path))
        except DamagedTail as error:
            self.damaged.append(str(error))
            return None
        except OSError as error:
            raise HistoryError(f"the history's tail cannot be read: {error.strerror}") from error

    def _unpacked(self, tail: TailRead | None) -> list[TailRecord]:
        """Of a tail what does not lie in the database yet."""
        if tail is None:
            return []
        done = packed_record(self._connection, tail.run_id)
        return [record for record in tail.records if record.number > done]

    def _blobs(self, where: str, values: tuple[Any, ...]) -> list[_Blob]:
        sql = (
            "SELECT blob.id, frames, blob.wall_ahead_s, spans FROM blob JOIN run ON run.id = blob.run"
            f" WHERE {where} ORDER BY run.id, start_s"
        )
        rows = self._connection.execute(sql, values).fetchall()
        return [_Blob(*row) for row in cast("list[tuple[int, int, float, int]]", rows)]

    def _unpack(self, blob: _Blob, names: Sequence[str]) -> dict[str, NDArray[Any]]:
        """The columns of a blob; none of one that has become too old meanwhile, or is damaged, which is noted."""
        try:
            wanted = dict.fromkeys(("time_s", *(name for name in names if name != "wall_s")))
            packed = self._packed(blob, list(wanted))
            if not packed:
                return {}
            time_s = unpack_times(packed["time_s"], blob.frames)
            columns: dict[str, NDArray[Any]] = {"time_s": time_s, "wall_s": time_s + blob.wall_ahead_s}
            for name in wanted:
                if name not in columns:
                    width = blob.spans if name in PER_SPAN else 1
                    column = unpack_column(packed[name], STORED_FIELDS[name], blob.frames, width)
                    columns[name] = column if name in PER_SPAN else column.reshape(-1)
        except (DamagedBlob, apsw.CorruptError) as error:
            self.damaged.append(f"blob {blob.id}, {blob.frames} frames: {error}")
            return {}
        return columns

    def _packed(self, blob: _Blob, names: Sequence[str]) -> dict[str, bytes]:
        """In one read; empty where the blob is no longer there."""
        marks = ", ".join("?" * len(names))
        rows = self._connection.execute(
            f"SELECT name, data FROM field WHERE blob = ? AND name IN ({marks})", (blob.id, *names)
        ).fetchall()
        if not rows and not self._connection.execute("SELECT count(*) FROM blob WHERE id = ?", (blob.id,)).get:
            return {}
        found = {str(name): data for name, data in rows if isinstance(data, bytes)}
        if missing := [name for name in names if name not in found]:
            raise DamagedBlob(f"{missing[0]} is missing")
        return found


def _joined(walk: Generator[dict[str, NDArray[Any]], None, None], fields: Sequence[str]) -> dict[str, NDArray[Any]]:
    with closing(walk):
        parts = list(walk)
    return {name: np.concatenate([part[name] for part in parts]) for name in dict.fromkeys(("time_s", *fields))}


def _inside(
    columns: dict[str, NDArray[Any]], by: str, start_s: float, end_s: float, wanted: Iterable[str]
) -> dict[str, NDArray[Any]]:
    inside = (columns[by] >= start_s) & (columns[by] <= end_s)
    return {name: columns[name][inside] for name in wanted}


def _columns(record: TailRecord, wanted: Iterable[str]) -> dict[str, NDArray[Any]]:
    """As those of a blob."""
    time_s = record.frames["time_s"].copy()
    columns: dict[str, NDArray[Any]] = {"time_s": time_s, "wall_s": time_s + record.wall_ahead_s}
    return columns | {name: record.frames[name].astype(STORED_FIELDS[name]) for name in wanted if name not in columns}


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
