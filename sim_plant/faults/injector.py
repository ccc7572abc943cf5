"""Faults of one line: planned, done and taken back by world time, and noted in its recording."""

from collections.abc import Callable
from dataclasses import dataclass
from math import isinf
from typing import Any, Protocol

from sim_plant.faults.effects import Begin, End, prepare
from sim_plant.faults.parse import Injection
from sim_plant.faults.schedule import Change, Entry, FaultSchedule
from sim_plant.faults.targets import FaultyLine


class Timer(Protocol):
    """As `world.Timer`: the action it was made with is called at `due_s`."""

    @property
    def due_s(self) -> float: ...
    @due_s.setter
    def due_s(self, value: float) -> None: ...


class Note(Protocol):
    """As `Recorder.note`."""

    def __call__(self, kind: str, now_s: float, **what: Any) -> None: ...


@dataclass(frozen=True, slots=True)
class Listed:
    """A fault as it is shown. Times in s; None is until cleared."""

    number: int
    fault: str
    acts: bool
    begin_s: float
    end_s: float | None


class Injector:
    """`timer` makes a timer that calls back at world times (`World.timer`), so that faults come at their millisecond.

    Without it `step` must be called.
    """

    def __init__(
        self, line: FaultyLine, note: Note, timer: Callable[[Callable[[float], None]], Timer] | None = None
    ) -> None:
        self._line = line
        self._note = note
        self._schedule = FaultSchedule()
        self._begins: dict[int, Begin] = {}
        self._ends: dict[int, End] = {}
        self._timer = None if timer is None else timer(self.step)

    def add(self, injection: Injection, now_s: float) -> int:
        """Plan a fault, or do it at once if it has no time. Returns its number.

        Raises FaultRefused for what this line has not, a time that has passed, and a fault that is there already.
        """
        begin = prepare(self._line, injection)
        entry = self._schedule.add(injection, now_s)
        self._begins[entry.number] = begin
        self.step(now_s)
        return entry.number

    def clear(self, number: int | None, now_s: float) -> list[int]:
        """End a fault, or all of them; those that are still to come do not come. Returns the numbers.

        Raises FaultRefused when there is no such fault.
        """
        before = {entry.number for entry in self._entries()}
        for change in self._schedule.take(number, now_s):
            self._do(change)
        cleared = sorted(before - {entry.number for entry in self._entries()})
        for gone in cleared:
            self._begins.pop(gone, None)
        self._set_timer()
        return cleared

    def step(self, now_s: float) -> None:
        """Do what is due by `now_s`."""
        for change in self._schedule.step(now_s):
            self._do(change)
        self._set_timer()

    def listed(self) -> list[Listed]:
        """What waits and what acts, by number."""
        acting = {entry.number for entry in self._schedule.acting}
        return [
            Listed(e.number, str(e.injection), e.number in acting, e.begin_s, None if isinf(e.end_s) else e.end_s)
            for e in sorted(self._entries(), key=lambda entry: entry.number)
        ]

    def _entries(self) -> tuple[Entry, ...]:
        return (*self._schedule.waiting, *self._schedule.acting)

    def _do(self, change: Change) -> None:
        entry = change.entry
        if change.begins:
            self._note("fault-injected", change.time_s, number=entry.number, fault=str(entry.injection))
            end = self._begins.pop(entry.number)(change.time_s)
            if end is not None:
                self._ends[entry.number] = end
        else:
            what = self._ends.pop(entry.number)(change.time_s)
            self._note("fault-cleared", change.time_s, number=entry.number, fault=str(entry.injection), **what)

    def _set_timer(self) -> None:
        if self._timer is not None:
            self._timer.due_s = self._schedule.due_s
