"""What becomes too old or too much goes, the oldest first; what is kept is whole."""

from pathlib import Path

import pytest

from gateway.core.messages import Event
from gateway.supervisor.dating import note_agreed, note_seen
from gateway.supervisor.history import History
from gateway.supervisor.retention import (
    BLOBS_AT_ONCE,
    DAY_S,
    EVENTS_AT_ONCE,
    TURN_S,
    Allowance,
    Retention,
    expire,
    used_bytes,
)
from gateway.supervisor.store import Run, open_store
from gateway.supervisor.writer import Writer
from tests.unit.supervisor_support import frame_of

WALL_AHEAD_S = 1_700_000_000.0
FOREVER = Retention(telemetry_s=1e12, events_s=1e12, most_bytes=10**15)


def written(path: Path, blobs: int, every_s: float, frames: int = 20, boot: str = "boot") -> None:
    """`blobs` blobs and as many events, the last of them at `blobs * every_s`."""
    writer = Writer(path, Run(boot, 0.0, WALL_AHEAD_S, "site", "line", 6), 0)
    for k in range(blobs):
        begin_s = (k + 1) * every_s
        rows = [frame_of(k * frames + j, begin_s - (frames - 1 - j) * 0.01) for j in range(frames)]
        writer.store(rows, [Event(time_s=begin_s, kind="state", text=f"event {k}")], WALL_AHEAD_S)
        writer.pack()
    writer.disconnect()


def expired(path: Path, retention: Retention, boot: str, now_s: float, turns: int = 1, every_s: float = TURN_S) -> int:
    """Blobs that went in so many turns from `now_s`, monotonic, on."""
    connection, allowance = open_store(path), Allowance()
    gone = sum(expire(connection, retention, allowance, boot, now_s + k * every_s) for k in range(turns))
    connection.close()
    return gone


def kept(path: Path, boot: str | None = None) -> tuple[int, list[str]]:
    with History(path) as history:
        return len(history.read(0.0, 1e9, ("time_s",), boot)["time_s"]), [
            event.text for event in history.events(0.0, 1e12)
        ]


def test_telemetry_goes_after_its_days_and_events_after_theirs(tmp_path: Path) -> None:
    path = tmp_path / "history.sqlite"
    written(path, 10, DAY_S)
    assert expired(path, Retention(3.5 * DAY_S, 6.5 * DAY_S, 10**15), "boot", 10 * DAY_S, turns=6) == 6
    frames, events = kept(path)
    assert (frames, events) == (4 * 20, [f"event {k}" for k in range(3, 10)])


@pytest.mark.slow
def test_a_history_that_is_too_large_loses_its_oldest_and_gives_space_back(tmp_path: Path) -> None:
    path = tmp_path / "history.sqlite"
    written(path, 200, 10.0, frames=100)
    connection = open_store(path)
    connection.execute("PRAGMA wal_checkpoint(TRUNCATE)")
    before, limit = path.stat().st_size, used_bytes(connection) // 2
    turns = 0
    while expire(connection, Retention(1e12, 1e12, limit), Allowance(), "boot", 2000.0):
        turns += 1
    assert 0 < turns <= 200 / BLOBS_AT_ONCE + 1 and used_bytes(connection) <= limit
    connection.execute("PRAGMA wal_checkpoint(TRUNCATE)")
    connection.close()
    assert path.stat().st_size < 0.6 * before
    with History(path) as history:
        times = history.read(0.0, 1e9, ("time_s",))["time_s"]
    assert times[-1] == pytest.approx(2000.0) and len(times) % 100 == 0 and len(times) >= 6000


def fill(path: Path, turns: int, events: int, letters: int, keep: Retention) -> History:
    """A history of a line whose loop tells `events` a turn, kept within bounds all the while."""
    writer = Writer(path, Run("boot", 0.0, WALL_AHEAD_S, "site", "line", 6), 0)
    for turn in range(turns):
        frames = [frame_of(100 * turn + k, turn + 0.01 * k) for k in range(100)]
        told = [Event(time_s=float(turn), kind="alarm", text=f"{turn} {'x' * letters}") for _ in range(events)]
        writer.store(frames, told, WALL_AHEAD_S)
        writer.pack()
        writer.expire(keep, float(turn))
    writer.disconnect()
    return History(path)


@pytest.mark.slow
@pytest.mark.parametrize(("events", "letters"), [(100, 3000), (2000, 60)])
def test_events_that_are_told_without_end_drive_out_themselves_and_no_telemetry(
    tmp_path: Path, events: int, letters: int
) -> None:
    keep = Retention(telemetry_s=1e12, events_s=1e12, most_bytes=5_000_000)
    with fill(tmp_path / "history.sqlite", 30, events, letters, keep) as history:
        assert len(history.read_wall(0.0, 1e12, ("time_s",))["time_s"]) == 3000
        texts = [event.text for event in history.events(0.0, 1e12)]
    connection = open_store(tmp_path / "history.sqlite")
    assert used_bytes(connection) <= 5_000_000 + events * (letters + 2000) and texts[-1].startswith("29 ")
    assert 0.1 * 5_000_000 < sum(len(text) for text in texts) and len(texts) < 30 * events
    connection.close()


def test_where_there_is_nothing_but_events_the_bound_holds_for_them_too(tmp_path: Path) -> None:
    path = tmp_path / "history.sqlite"
    writer = Writer(path, Run("boot", 0.0, WALL_AHEAD_S, "site", "line", 6), 0)
    for turn in range(6):
        writer.store([], [Event(time_s=float(turn), kind="alarm", text=3000 * "x") for _ in range(100)], WALL_AHEAD_S)
        writer.pack()
        writer.expire(Retention(1e12, 1e12, 500_000), float(turn))
    writer.disconnect()
    connection = open_store(path)
    assert used_bytes(connection) <= 500_000
    connection.close()


def test_few_events_stay_for_their_years_however_much_telemetry_there_is(tmp_path: Path) -> None:
    path = tmp_path / "history.sqlite"
    written(path, 60, 10.0, frames=50)
    connection = open_store(path)
    limit = used_bytes(connection) // 2
    connection.close()
    expired(path, Retention(1e12, 1e12, limit), "boot", 1000.0, turns=2)
    frames, events = kept(path)
    assert frames < 60 * 50 and len(events) == 60


def test_what_is_neither_old_nor_much_stays(tmp_path: Path) -> None:
    path = tmp_path / "history.sqlite"
    written(path, 5, DAY_S)
    assert expired(path, FOREVER, "boot", 5 * DAY_S) == 0
    assert kept(path)[0] == 100


def test_a_day_of_telemetry_and_a_day_of_events_go_in_a_turn_and_a_backlog_ends(tmp_path: Path) -> None:
    path = tmp_path / "history.sqlite"
    written(path, 20, DAY_S / 4)  # five days
    keep = Retention(DAY_S, DAY_S, 10**15)
    assert expired(path, keep, "boot", 100 * DAY_S, turns=300, every_s=10.0) == 5  # 50 minutes: the first, and a day
    assert kept(path) == (15 * 20, [f"event {k}" for k in range(5, 20)])
    assert expired(path, keep, "boot", 101 * DAY_S, turns=4) == 15
    assert kept(path) == (0, [])


def test_many_events_of_one_day_go_over_several_looks(tmp_path: Path) -> None:
    path = tmp_path / "history.sqlite"
    writer = Writer(path, Run("boot", 0.0, WALL_AHEAD_S, "site", "line", 6), 0)
    writer.store([], [Event(time_s=float(k), kind="k", text=str(k)) for k in range(EVENTS_AT_ONCE + 5)], WALL_AHEAD_S)
    writer.pack()
    writer.disconnect()
    expired(path, Retention(1e12, DAY_S, 10**15), "boot", 2 * DAY_S, turns=2, every_s=10.0)
    assert kept(path)[1] == []


@pytest.mark.parametrize(("off_s", "agreed", "gone"), [(60.0, False, 0), (60.0, True, 0), (9.5 * DAY_S, True, 5)])
def test_between_boots_time_counts_only_where_both_clocks_were_seen_to_agree(
    tmp_path: Path, off_s: float, agreed: bool, gone: int
) -> None:
    path = tmp_path / "history.sqlite"
    written(path, 5, 10.0, boot="before")
    written(path, 1, 10.0, boot="now")
    connection = open_store(path)
    if agreed:
        note_agreed(connection, "before", WALL_AHEAD_S)
        note_agreed(connection, "now", WALL_AHEAD_S + 50.0 + off_s)
    connection.close()
    assert expired(path, Retention(9 * DAY_S, 1e12, 10**15), "now", 20.0) == gone
    assert kept(path, "before")[0] == (5 - gone) * 20


def test_a_machine_whose_clock_never_agrees_still_ages_what_it_keeps_by_how_long_it_was_up(tmp_path: Path) -> None:
    path = tmp_path / "history.sqlite"
    written(path, 2, 10.0, boot="first")
    for boot in ("second", "third"):
        written(path, 1, 10.0, boot=boot)
        connection = open_store(path)
        note_seen(connection, boot, 4 * DAY_S)
        connection.close()
    written(path, 1, 10.0, boot="now")
    keep = Retention(9 * DAY_S, 1e12, 10**15)
    assert expired(path, keep, "now", 0.9 * DAY_S) == 0
    assert expired(path, keep, "now", 1.1 * DAY_S) == 3
    assert (kept(path, "first")[0], kept(path, "second")[0], kept(path, "third")[0]) == (0, 0, 20)


def test_a_wall_clock_that_went_backwards_over_a_boot_keeps_things_no_longer_than_the_machine_was_up(
    tmp_path: Path,
) -> None:
    path = tmp_path / "history.sqlite"
    written(path, 2, 10.0, boot="before")
    written(path, 1, 10.0, boot="now")
    connection = open_store(path)
    note_agreed(connection, "before", WALL_AHEAD_S)
    note_agreed(connection, "now", WALL_AHEAD_S - 300 * DAY_S)
    connection.close()
    keep = Retention(9 * DAY_S, 1e12, 10**15)
    assert expired(path, keep, "now", 8 * DAY_S) == 0
    assert expired(path, keep, "now", 9 * DAY_S + 5.0) == 2
    assert (kept(path, "before")[0], kept(path, "now")[0]) == (0, 20)


def test_the_newest_is_not_moved_about_to_give_back_what_is_used_again_at_once(tmp_path: Path) -> None:
    path = tmp_path / "history.sqlite"
    written(path, 40, 20.0, frames=20)
    connection, allowance = open_store(path), Allowance()
    before = connection.pragma("page_count")
    assert expire(connection, Retention(400.0, 1e12, 10**15), allowance, "boot", 810.0) == 20
    assert (connection.pragma("page_count"), connection.pragma("freelist_count") > 0) == (before, True)
    connection.close()
