"""A wall clock that is wrong, jumps, or is set an hour after the start: nothing is lost by it, and dates come right."""

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from gateway.core.messages import Event
from gateway.core.steady_clock import AGREES_AFTER_S
from gateway.supervisor import historian as module
from gateway.supervisor.historian import FILE_NAME, Historian
from gateway.supervisor.history import History
from gateway.supervisor.retention import Retention
from tests.unit.supervisor_support import frame_of
from tests.unit.test_historian import eventually

DAY_S = 86_400.0
TRUE_S = 1_795_000_000.0  # Unix time when the machine started, truly
KEEP = Retention(90 * DAY_S, 365 * DAY_S, 10**15)


class Clocks:
    def __init__(self, ahead_s: float) -> None:
        self.now_s = 1000.0
        self.ahead_s = ahead_s

    def monotonic(self) -> float:
        return self.now_s

    def wall(self) -> float:
        return self.now_s + self.ahead_s


class Line:
    """A historian under clocks of the test, and a frame and an event every minute of theirs."""

    def __init__(self, historian: Historian, clocks: Clocks) -> None:
        self.historian, self.clocks, self.stored = historian, clocks, 0

    def runs(self, minutes: int) -> None:
        for _ in range(minutes):
            self.clocks.now_s += 60.0
            self.stored += 1
            self.historian.frame(frame_of(self.stored, self.clocks.now_s))
            self.historian.event(Event(time_s=self.clocks.now_s, kind="alarm", text="slack"))
            eventually(lambda: self.historian.health().frames_stored == self.stored)


@contextmanager
def line_with(folder: Path, clocks: Clocks) -> Iterator[Line]:
    historian = Historian(
        folder, "site", "line", 6, retention=KEEP, reserve_bytes=0, clock=clocks.monotonic, wall_clock=clocks.wall
    )
    historian.start()
    try:
        yield Line(historian, clocks)
    finally:
        assert historian.close()


@pytest.fixture(autouse=True)
def _quick(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(module, "FLUSH_S", 0.002)


def dates(folder: Path) -> tuple[list[float], list[float]]:
    """Unix times of all frames and all events, in the order of their monotonic times."""
    with History(folder / FILE_NAME) as history:
        found = history.read(0.0, 1e9, ["wall_s"])["wall_s"].tolist()
        return found, [event.wall_s for event in sorted(history.events(-1e12, 1e12), key=lambda event: event.time_s)]


def test_an_hour_that_was_stored_in_1970_is_kept_and_dated_once_the_clock_is_set(tmp_path: Path) -> None:
    clocks = Clocks(0.0)
    with line_with(tmp_path, clocks) as line:
        line.runs(60)
        clocks.ahead_s = TRUE_S
        line.runs(round(AGREES_AFTER_S / 60.0) + 3)
        stored = line.stored
    expected = [TRUE_S + 1000.0 + 60.0 * (k + 1) for k in range(stored)]
    assert dates(tmp_path) == (expected, expected)


def test_two_minutes_of_a_clock_twenty_years_ahead_delete_nothing(tmp_path: Path) -> None:
    clocks = Clocks(TRUE_S)
    with line_with(tmp_path, clocks) as line:
        line.runs(60)
        clocks.ahead_s += 20 * 365 * DAY_S
        line.runs(2)
        clocks.ahead_s = TRUE_S
        line.runs(12)
        stored = line.stored
    expected = [TRUE_S + 1000.0 + 60.0 * (k + 1) for k in range(stored)]
    assert dates(tmp_path) == (expected, expected)  # those two minutes, too


def test_a_clock_that_is_wrong_for_an_hour_deletes_nothing_and_dates_come_right_again(tmp_path: Path) -> None:
    clocks = Clocks(TRUE_S)
    with line_with(tmp_path, clocks) as line:
        line.runs(30)
        clocks.ahead_s -= 20 * 365 * DAY_S  # before 2026
        line.runs(30)
        clocks.ahead_s = TRUE_S + 20 * 365 * DAY_S
        line.runs(60)
        clocks.ahead_s = TRUE_S
        line.runs(12)
        stored = line.stored
    expected = [TRUE_S + 1000.0 + 60.0 * (k + 1) for k in range(stored)]
    assert dates(tmp_path) == (expected, expected)
