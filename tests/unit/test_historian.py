"""The historian when all is well: what was given comes back, dated, whole, and while it is being written."""

import json
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from gateway.core.messages import Event
from gateway.core.telemetry import frame_dtype, unpack
from gateway.supervisor import historian as historian_module
from gateway.supervisor import store
from gateway.supervisor.historian import FILE_NAME, Historian
from gateway.supervisor.history import FIELDS, History, HistoryError
from gateway.supervisor.store import STORED_FIELDS, Run, open_store
from gateway.supervisor.writer import Writer
from tests.unit.supervisor_support import frame_of

WALL_AHEAD_S = 1_700_000_000.0


def eventually(condition: Callable[[], bool], timeout_s: float = 10.0) -> None:
    end_s = time.monotonic() + timeout_s
    while not condition():
        assert time.monotonic() < end_s, "it never came true"
        time.sleep(0.005)


@contextmanager
def running(folder: Path, **arguments: Any) -> Iterator[Historian]:
    historian = Historian(folder, "site", "line", 6, **arguments)
    historian.start()
    try:
        yield historian
    finally:
        assert historian.close()


def writer_of(path: Path, boot: str = "boot", wall_ahead_s: float = WALL_AHEAD_S, spans: int = 6) -> Writer:
    return Writer(path, Run(boot, 0.0, wall_ahead_s, "site", "line", spans), 0)


def test_every_field_of_every_frame_comes_back_exactly(tmp_path: Path) -> None:
    sent = [frame_of(k, 5.0 + k * 0.01, tension_n=np.array([np.nan, *range(5)])) for k in range(250)]
    with running(tmp_path) as historian:
        for payload in sent:
            historian.frame(payload)
    truth = np.frombuffer(b"".join(sent), frame_dtype(6))
    with History(tmp_path / FILE_NAME) as history:
        found = history.read(0.0, 100.0, FIELDS)
        assert set(found) == set(FIELDS)
        for name in STORED_FIELDS:
            assert found[name].dtype == truth[name].dtype
            assert found[name].tobytes() == truth[name].tobytes(), name
        assert found["time_s"].tobytes() == truth["time_s"].tobytes()
        assert history.damaged == []


def test_numpy_sees_a_frame_as_unpack_does() -> None:
    payload = frame_of(7, 1.25, missed=3, held=2, saturated=True)
    frame, row = unpack(payload), np.frombuffer(payload, frame_dtype(6))[0]
    for name in STORED_FIELDS:
        assert np.array_equal(row[name], np.asarray(getattr(frame, name)).astype(row[name].dtype)), name
    assert row["time_s"] == frame.time_s


def test_an_interval_is_cut_at_its_ends_inclusive(tmp_path: Path) -> None:
    writer = writer_of(tmp_path / "h")
    for start in (0, 100, 200):
        writer.store([frame_of(k, float(k)) for k in range(start, start + 100)], [], WALL_AHEAD_S)
    writer.disconnect()
    with History(tmp_path / "h") as history:
        assert history.read(99.0, 201.0, ["sequence"])["sequence"].tolist() == list(range(99, 202))
        found = history.read_wall(WALL_AHEAD_S + 150.0, WALL_AHEAD_S + 151.5, ["wall_s"])
        assert found["wall_s"].tolist() == [WALL_AHEAD_S + 150.0, WALL_AHEAD_S + 151.0]
        assert history.read(500.0, 600.0, ["tension_n"])["tension_n"].shape[0] == 0


def test_gathering_keeps_each_frame_once_and_takes_less_room(tmp_path: Path) -> None:
    writer = writer_of(tmp_path / "h")
    for start in range(0, 2000, 50):
        writer.store([frame_of(k, k * 0.01) for k in range(start, start + 50)], [], WALL_AHEAD_S)
        if writer.gathered_s() >= 9.5:
            writer.pack()
    writer.disconnect()
    connection = open_store(tmp_path / "h")
    lengths = [frames for (frames,) in connection.execute("SELECT frames FROM blob ORDER BY start_s")]
    orphans = connection.execute("SELECT count(*) FROM field WHERE blob NOT IN (SELECT id FROM blob)").get
    connection.close()
    assert lengths == [1000, 1000]
    assert orphans == 0
    with History(tmp_path / "h") as history:
        assert history.read(0.0, 100.0, ["sequence"])["sequence"].tolist() == list(range(2000))


def test_history_is_read_whole_while_it_is_written_and_gathered(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(historian_module, "FLUSH_S", 0.002)
    monkeypatch.setattr(historian_module, "BLOB_S", 0.05)
    with running(tmp_path) as historian:
        sent = 0
        historian.frame(frame_of(0, 0.0))
        eventually(lambda: historian.health().frames_stored == 1)
        with History(tmp_path / FILE_NAME) as history:
            for _ in range(100):
                sent += 1
                historian.frame(frame_of(sent, sent * 0.01))
                stored = historian.health().frames_stored
                found = history.read(0.0, 100.0, ["sequence"])["sequence"].tolist()
                assert found == list(range(len(found)))
                assert len(found) >= stored
                assert history.damaged == []


def test_what_is_new_is_stored_within_two_seconds(tmp_path: Path) -> None:
    with running(tmp_path) as historian:
        began_s = time.monotonic()
        historian.frame(frame_of(0, 1.0))
        eventually(lambda: historian.health().frames_stored == 1, 2.0)
        with History(tmp_path / FILE_NAME) as history:
            assert history.read(0.0, 2.0, ["state"])["state"].tolist() == [2]
        assert time.monotonic() - began_s < 2.0


def test_events_come_back_in_order_with_both_times(tmp_path: Path) -> None:
    with running(tmp_path, clock=lambda: 50.0, wall_clock=lambda: 1_000_050.0) as historian:
        for k in range(5):
            historian.event(Event(time_s=float(k), kind="state", text=f"event {k}", data={"torque_nm": [1.5, k]}))
    with History(tmp_path / FILE_NAME) as history:
        found = history.events(1_000_001.0, 1_000_003.0)
    assert [event.text for event in found] == ["event 1", "event 2", "event 3"]
    assert found[0].time_s == 1.0
    assert found[0].wall_s == 1_000_001.0
    assert found[2].data == {"torque_nm": [1.5, 3]}


def test_monotonic_times_of_two_boots_are_told_apart_and_dated(tmp_path: Path) -> None:
    for boot, ahead_s, sequence in (("first", 1000.0, 1), ("second", 5000.0, 2)):
        writer = writer_of(tmp_path / "h", boot, ahead_s)
        writer.store([frame_of(sequence, 10.0)], [], ahead_s)
        writer.disconnect()
    with History(tmp_path / "h") as history:
        assert history.boots() == ["first", "second"]
        assert history.read(0.0, 20.0, ["sequence"])["sequence"].tolist() == [2]
        assert history.read(0.0, 20.0, ["sequence"], boot="first")["sequence"].tolist() == [1]
        both = history.read_wall(0.0, 9000.0, ["sequence", "wall_s"])
        assert both["sequence"].tolist() == [1, 2]
        assert both["wall_s"].tolist() == [1010.0, 5010.0]


def test_a_wall_clock_that_jumps_redates_nothing_that_was_stored(tmp_path: Path) -> None:
    writer = writer_of(tmp_path / "h")
    writer.store([frame_of(1, 10.0)], [], 1000.0)
    writer.store([frame_of(2, 11.0)], [], 9000.0)
    writer.disconnect()
    with History(tmp_path / "h") as history:
        assert history.read(0.0, 20.0, ["wall_s"])["wall_s"].tolist() == [1010.0, 9011.0]


def test_unknown_fields_missing_files_and_changed_lines_are_refused_with_help(tmp_path: Path) -> None:
    with pytest.raises(HistoryError, match="no history at"):
        History(tmp_path / "none")
    for spans, time_s in ((6, 1.0), (7, 2.0)):
        writer = writer_of(tmp_path / "h", spans=spans)
        writer.store([frame_of(1, time_s, spans)], [], WALL_AHEAD_S)
        writer.disconnect()
    with History(tmp_path / "h") as history:
        with pytest.raises(HistoryError, match="'tension'; nearest is 'tension_n'"):
            history.read(0.0, 1.0, ["tension"])
        with pytest.raises(HistoryError, match="number of spans changed"):
            history.read(0.0, 3.0, ["tension_n"])
        assert history.read(1.5, 3.0, ["tension_n"])["tension_n"].shape == (1, 7)


def test_a_newer_schema_and_a_foreign_file_are_left_alone(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(historian_module, "FLUSH_S", 0.01)
    for name, statement in (("newer", "PRAGMA user_version = 99"), ("foreign", "PRAGMA application_id = 7")):
        folder = tmp_path / name
        open_store_of(folder).close()
        connection = store.apsw.Connection(str(folder / FILE_NAME))
        connection.execute(statement)
        connection.close()
        with running(folder) as historian:
            historian.frame(frame_of(0, 1.0))
            eventually(lambda historian=historian: "not storing" in historian.health().text)
            assert ("schema 99" if name == "newer" else "another program") in historian.health().text
        assert [path.name for path in folder.iterdir() if path.suffix == ".sqlite"] == [FILE_NAME]


def open_store_of(folder: Path) -> store.apsw.Connection:
    folder.mkdir()
    return open_store(folder / FILE_NAME)


def test_an_old_history_is_migrated_step_by_step(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    writer = writer_of(tmp_path / "h")
    writer.store([frame_of(1, 1.0)], [Event(time_s=1.0, kind="k", text="kept")], WALL_AHEAD_S)
    writer.pack()
    writer.disconnect()
    monkeypatch.setitem(store.MIGRATIONS, 1, "ALTER TABLE event ADD COLUMN severity INTEGER DEFAULT 0")
    monkeypatch.setitem(store.MIGRATIONS, 2, "CREATE TABLE extra (id INTEGER PRIMARY KEY)")
    connection = open_store(tmp_path / "h")
    assert connection.pragma("user_version") == 3
    assert list(connection.execute("SELECT text, severity FROM event")) == [("kept", 0)]
    assert connection.execute("SELECT count(*) FROM extra").get == 0
    connection.close()


def test_a_migration_that_fails_changes_nothing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    open_store(tmp_path / "h").close()
    monkeypatch.setitem(store.MIGRATIONS, 1, "CREATE TABLE extra (id INTEGER); SELECT no_such_column FROM extra")
    with pytest.raises(store.apsw.SQLError):
        open_store(tmp_path / "h")
    monkeypatch.delitem(store.MIGRATIONS, 1)
    connection = open_store(tmp_path / "h")
    assert connection.pragma("user_version") == 1
    assert connection.execute("SELECT count(*) FROM sqlite_schema WHERE name = 'extra'").get == 0
    connection.close()


def test_event_data_is_json_in_the_file(tmp_path: Path) -> None:
    writer = writer_of(tmp_path / "h")
    writer.store([], [Event(time_s=1.0, kind="k", text="Ä", data={"a": [1, None, "ß"]})], 0.0)
    writer.pack()
    writer.disconnect()
    connection = open_store(tmp_path / "h")
    ((text, data),) = connection.execute("SELECT text, data FROM event")
    connection.close()
    assert text == "Ä"
    assert json.loads(data) == {"a": [1, None, "ß"]}
