"""What becomes too old or too much goes, the oldest first; what is kept is whole."""

from pathlib import Path

import pytest

from gateway.core.messages import Event
from gateway.supervisor.history import History
from gateway.supervisor.retention import BLOBS_AT_ONCE, DAY_S, Retention, expire, used_bytes
from gateway.supervisor.store import Run, open_store
from gateway.supervisor.writer import Writer
from tests.unit.supervisor_support import frame_of

WALL_AHEAD_S = 1_700_000_000.0
FOREVER = Retention(telemetry_s=1e12, events_s=1e12, most_bytes=10**15)


def written(path: Path, blobs: int, every_s: float, frames: int = 20) -> None:
    """`blobs` blobs and as many events, the last of them at `blobs * every_s`."""
    writer = Writer(path, Run("boot", 0.0, WALL_AHEAD_S, "site", "line", 6), 0)
    for k in range(blobs):
        begin_s = (k + 1) * every_s
        rows = [frame_of(k * frames + j, begin_s - (frames - 1 - j) * 0.01) for j in range(frames)]
        writer.store(rows, [Event(time_s=begin_s, kind="state", text=f"event {k}")], WALL_AHEAD_S)
        writer.pack()
    writer.disconnect()


def kept(path: Path) -> tuple[int, list[str]]:
    with History(path) as history:
        return len(history.read(0.0, 1e9, ("time_s",))["time_s"]), [event.text for event in history.events(0.0, 1e12)]


def test_telemetry_goes_after_its_days_and_events_after_theirs(tmp_path: Path) -> None:
    path = tmp_path / "history.sqlite"
    written(path, 10, DAY_S)
    connection = open_store(path)
    now_s = WALL_AHEAD_S + 10 * DAY_S
    assert expire(connection, Retention(3.5 * DAY_S, 6.5 * DAY_S, 10**15), now_s) == 6
    connection.close()
    frames, events = kept(path)
    assert (frames, events) == (4 * 20, [f"event {k}" for k in range(3, 10)])


def test_a_history_that_is_too_large_loses_its_oldest_and_gives_space_back(tmp_path: Path) -> None:
    path = tmp_path / "history.sqlite"
    written(path, 200, 10.0, frames=100)
    connection = open_store(path)
    connection.execute("PRAGMA wal_checkpoint(TRUNCATE)")
    before, limit = path.stat().st_size, used_bytes(connection) // 2
    turns = 0
    while expire(connection, Retention(1e12, 1e12, limit), WALL_AHEAD_S + 2000.0):
        turns += 1
    assert 0 < turns <= 200 / BLOBS_AT_ONCE + 1 and used_bytes(connection) <= limit
    connection.execute("PRAGMA wal_checkpoint(TRUNCATE)")
    connection.close()
    assert path.stat().st_size < 0.6 * before
    with History(path) as history:
        times = history.read(0.0, 1e9, ("time_s",))["time_s"]
    assert times[-1] == pytest.approx(2000.0) and len(times) % 100 == 0 and len(times) >= 6000


def test_what_is_neither_old_nor_much_stays(tmp_path: Path) -> None:
    path = tmp_path / "history.sqlite"
    written(path, 5, DAY_S)
    connection = open_store(path)
    assert expire(connection, FOREVER, WALL_AHEAD_S + 5 * DAY_S) == 0
    connection.close()
    assert kept(path)[0] == 100
