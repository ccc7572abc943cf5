"""What is new lies in the tail beside the history until it is packed: read whole, and found after a kill."""

from pathlib import Path

import apsw
import numpy as np
import pytest

from gateway.core.messages import Event
from gateway.core.telemetry import frame_dtype
from gateway.supervisor.history import History
from gateway.supervisor.store import MIGRATIONS, Run
from gateway.supervisor.tail import Tail, TailRecord, read_tail, table_of, tail_path
from gateway.supervisor.writer import MOST_LOG_BYTES, Writer
from tests.unit.supervisor_support import frame_of
from tests.unit.test_historian import WALL_AHEAD_S, writer_of


def frames(first: int, count: int) -> list[bytes]:
    return [frame_of(k, k * 0.01) for k in range(first, first + count)]


def sequences(path: Path, boot: str | None = None) -> list[int]:
    with History(path) as history:
        found = history.read(0.0, 1e9, ["sequence"], boot)["sequence"].tolist()
        assert history.damaged == []
    return found


def killed(writer: Writer) -> None:
    """What a SIGKILL leaves: the tail as it is, the database closed by the kernel."""
    writer.close()


def test_frames_and_events_that_are_not_packed_are_read(tmp_path: Path) -> None:
    path = tmp_path / "h"
    writer = writer_of(path)
    writer.store(frames(0, 10), [Event(time_s=0.05, kind="k", text="packed")], WALL_AHEAD_S)
    writer.pack()
    writer.store(frames(10, 10), [Event(time_s=0.15, kind="k", text="new", data={"a": [1, None]})], WALL_AHEAD_S)
    assert sequences(path) == list(range(20))
    with History(path) as history:
        events = history.events(WALL_AHEAD_S, WALL_AHEAD_S + 1.0)
        assert [(event.text, event.wall_s) for event in events] == [
            ("packed", WALL_AHEAD_S + 0.05), ("new", WALL_AHEAD_S + 0.15),
        ]  # fmt: skip
        assert events[1].data == {"a": [1, None]}
        assert history.read_wall(WALL_AHEAD_S + 0.095, WALL_AHEAD_S + 0.115, ["sequence"])["sequence"].tolist() == [
            10,
            11,
        ]
    writer.close()


def test_what_a_killed_writer_left_goes_into_the_history_once(tmp_path: Path) -> None:
    path = tmp_path / "h"
    writer = writer_of(path, "first")
    writer.store(frames(0, 5), [], WALL_AHEAD_S)
    writer.pack()
    writer.store(frames(5, 5), [Event(time_s=0.05, kind="k", text="of the first")], WALL_AHEAD_S)
    killed(writer)
    assert sequences(path) == list(range(10))
    for boot in ("second", "third"):
        writer = writer_of(path, boot)
        writer.store(frames(0, 1), [], WALL_AHEAD_S)
        killed(writer)
        assert sequences(path, "first") == list(range(10))
    with History(path) as history:
        assert [event.text for event in history.events(0.0, 1e12)] == ["of the first"]
        assert history.boots() == ["first", "second", "third"]


def test_a_kill_between_the_commit_and_the_end_of_the_tail_doubles_nothing(tmp_path: Path) -> None:
    path = tmp_path / "h"
    writer = writer_of(path)
    writer.store(frames(0, 5), [Event(time_s=0.0, kind="k", text="once")], WALL_AHEAD_S)
    left = tail_path(path).read_bytes()
    writer.pack()
    writer.close()
    tail_path(path).write_bytes(left)
    for _ in range(2):  # before and after the next writer
        assert sequences(path, "boot") == list(range(5))
        with History(path) as history:
            assert [event.text for event in history.events(0.0, 1e12)] == ["once"]
        writer = writer_of(path, "next")
        writer.store([], [], WALL_AHEAD_S)
        writer.close()


@pytest.mark.parametrize("cut", [1, 7, 60])
def test_a_record_that_was_cut_short_is_not_there_and_those_before_are(tmp_path: Path, cut: int) -> None:
    tail = Tail(tail_path(tmp_path / "h"), 1, Run("boot", 0.0, 0.0, "site", "line", 6))
    for number in (1, 2, 3):
        tail.append(TailRecord(number, 0.0, table_of(frames(number, 4), 6), []))
    tail.close()
    content = tail_path(tmp_path / "h").read_bytes()
    tail_path(tmp_path / "h").write_bytes(content[:-cut])
    found = read_tail(tail_path(tmp_path / "h"))
    assert found is not None
    assert [record.number for record in found.records] == [1, 2]


def test_a_kill_while_a_tail_is_begun_leaves_nothing_to_be_kept(tmp_path: Path) -> None:
    tail = Tail(tail_path(tmp_path / "h"), 1, Run("boot", 0.0, 0.0, "site", "line", 6))
    tail.close()
    content = tail_path(tmp_path / "h").read_bytes()
    for length in range(len(content)):
        tail_path(tmp_path / "h").write_bytes(content[:length])
        assert read_tail(tail_path(tmp_path / "h")) is None


def test_a_tail_that_cannot_be_read_is_kept_aside(tmp_path: Path) -> None:
    tail_path(tmp_path / "h").write_bytes(b"something else")
    writer = writer_of(tmp_path / "h")
    writer.store(frames(0, 1), [], WALL_AHEAD_S)
    writer.close()
    assert (tmp_path / "h-tail-damaged").read_bytes() == b"something else"
    assert sequences(tmp_path / "h") == [0]


def test_a_history_of_the_first_schema_is_read_as_it_is_and_written_on(tmp_path: Path) -> None:
    """As programs before the tail have left it: small blobs, no further tables."""
    path = tmp_path / "h"
    writer = writer_of(path)
    for first in (0, 5):
        writer.store(frames(first, 5), [Event(time_s=first * 0.01, kind="k", text=str(first))], WALL_AHEAD_S)
        writer.pack()
    writer.close()
    connection = apsw.Connection(str(path))
    known = {
        name for (name,) in apsw.Connection(":memory:").execute(f"{MIGRATIONS[0]}; SELECT name FROM sqlite_schema")
    }
    for (name,) in connection.execute("SELECT name FROM sqlite_schema WHERE type = 'table'").fetchall():
        if name not in known:
            connection.execute(f"DROP TABLE {name}")
    assert connection.pragma("user_version") == 1
    connection.close()
    before = path.read_bytes()
    assert sequences(path) == list(range(10))
    assert path.read_bytes() == before
    writer = writer_of(path, "later")
    writer.store(frames(0, 3), [], WALL_AHEAD_S)
    writer.pack()
    writer.close()
    assert sequences(path, "boot") == list(range(10))
    assert sequences(path, "later") == [0, 1, 2]
    connection = apsw.Connection(str(path))
    assert connection.pragma("user_version") == 1  # older programs read and write it as before
    connection.close()


def wal_of(path: Path) -> int:
    return path.with_name(path.name + "-wal").stat().st_size


def noisy(writer: Writer, first: int, seconds: int) -> int:
    """Frames of 60 spans that hardly pack, five seconds in a blob; returns the next number."""
    rng = np.random.default_rng(first)
    for _ in range(seconds // 5):
        rows = np.zeros(500, frame_dtype(60))
        rows["sequence"], rows["time_s"] = np.arange(first, first + 500), 0.01 * np.arange(first, first + 500)
        for name in ("tension_n", "speed_m_per_s", "torque_nm"):
            rows[name] = rng.normal(20.0, 1.0, (500, 60))
        writer.store([row.tobytes() for row in rows], [], WALL_AHEAD_S)
        writer.pack()
        first += 500
    return first


def test_a_reader_that_waits_in_the_middle_keeps_no_log_from_beginning_anew(tmp_path: Path) -> None:
    path = tmp_path / "h"
    writer = writer_of(path, spans=60)
    first = noisy(writer, 0, 20)
    with History(path) as history:
        walk = history.walk_wall(0.0, 1e12, ["sequence"])
        next(walk)
        next(walk)
        largest = 0
        for _ in range(10):
            first = noisy(writer, first, 10)
            largest = max(largest, wal_of(path))
        rest = [part["sequence"] for part in walk]
    assert sum(map(len, rest)) == 2000 - 500  # what was there when it began
    assert largest < MOST_LOG_BYTES / 2
    writer.close()


@pytest.mark.slow
def test_the_log_shrinks_again_after_another_program_held_a_read_open(tmp_path: Path) -> None:
    path = tmp_path / "h"
    writer = writer_of(path, spans=60)
    first = noisy(writer, 0, 20)
    other = apsw.Connection(str(path))
    other.execute("BEGIN; SELECT count(*) FROM blob").fetchall()
    while wal_of(path) < MOST_LOG_BYTES:
        first = noisy(writer, first, 50)
    other.execute("COMMIT")
    other.close()
    noisy(writer, first, 10)
    assert wal_of(path) <= MOST_LOG_BYTES / 4
    assert len(sequences(path)) == first + 1000
    writer.close()


def test_events_of_a_kind_are_found_in_the_database_and_in_the_tail(tmp_path: Path) -> None:
    writer = writer_of(tmp_path / "h")
    for first in (0.0, 10.0):
        events = [Event(time_s=first + k, kind=kind, text=kind) for k, kind in enumerate(("alarm", "state", "end"))]
        writer.store([], events, 0.0)
        if not first:
            writer.pack()
    with History(tmp_path / "h") as history:
        assert [event.time_s for event in history.events(0.0, 100.0, ("state", "end"))] == [1.0, 2.0, 11.0, 12.0]
        assert history.events(0.0, 100.0, ("none",)) == []
        assert len(history.events(0.0, 100.0)) == 6
    writer.close()


@pytest.mark.slow
def test_while_another_program_holds_the_database_the_tail_takes_so_much_and_no_more(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "h"
    writer = writer_of(path)
    writer.store(frames(0, 10), [], WALL_AHEAD_S)
    monkeypatch.setattr("gateway.supervisor.writer.MAX_TAIL_BYTES", 25 * len(frames(0, 1)[0]))
    other = apsw.Connection(str(path))
    other.execute("BEGIN IMMEDIATE")
    for first in (10, 20):
        writer.store(frames(first, 10), [], WALL_AHEAD_S)
    for refused in (writer.pack, lambda: writer.store(frames(30, 10), [], WALL_AHEAD_S)):
        with pytest.raises(apsw.BusyError):
            refused()
    assert sequences(path) == list(range(30))
    other.execute("ROLLBACK")
    other.close()
    writer.store(frames(30, 10), [], WALL_AHEAD_S)
    writer.close()
    assert sequences(path) == list(range(40))
