"""When faults come and go, by world time. Pure: time is an argument, what is due comes out."""

from dataclasses import dataclass
from math import inf

from sim_plant.faults.parse import FaultRefused, Injection
from sim_plant.faults.table import Lasting

MOST_FAULTS = 1000  #: waiting and acting at one time
_GRID_S = 1e-9  #: a sum of decimal times is a little off


@dataclass(frozen=True, slots=True)
class Entry:
    """A fault that waits or acts. `number` counts from 1 and is never used again."""

    number: int
    injection: Injection
    begin_s: float
    end_s: float  #: inf is until cleared


@dataclass(frozen=True, slots=True)
class Change:
    """Something that is to be done now: the fault of this entry begins, or it ends."""

    entry: Entry
    begins: bool
    time_s: float


class FaultSchedule:
    """The faults that are to come and those that act."""

    def __init__(self) -> None:
        self._waiting: list[Entry] = []
        self._acting: list[Entry] = []
        self._added = 0

    @property
    def due_s(self) -> float:
        """When `step` will have something to do; inf when nothing is due."""
        return min((*(e.begin_s for e in self._waiting), *(e.end_s for e in self._acting)), default=inf)

    @property
    def waiting(self) -> tuple[Entry, ...]:
        return tuple(self._waiting)

    @property
    def acting(self) -> tuple[Entry, ...]:
        return tuple(self._acting)

    def add(self, injection: Injection, now_s: float) -> Entry:
        """Plan a fault. One that is to come at once is due now.

        Raises FaultRefused when its time has passed, or when the same fault of the same target, or one of its group, is
        there at that time.
        """
        begin_s = now_s if injection.at_s is None else injection.at_s
        if begin_s < now_s - _GRID_S:
            raise FaultRefused(
                f"{injection}: the line's time is {now_s:.3f} s already; leave out at, or name a later one"
            )
        if len(self._waiting) + len(self._acting) >= MOST_FAULTS:
            raise FaultRefused(f"there are {MOST_FAULTS} faults already; clear some")
        once = injection.fault.lasting is Lasting.ONCE
        end_s = begin_s if once else begin_s + (inf if injection.for_s is None else injection.for_s)
        for other in (*self._waiting, *self._acting):
            if _exclude(injection, other.injection) and begin_s < other.end_s and other.begin_s < end_s:
                there = f"fault {other.number} ({other.injection}) is in the way"
                raise FaultRefused(f"{injection}: {there}; clear it first, or name another time")
        self._added += 1
        entry = Entry(self._added, injection, begin_s, end_s)
        self._waiting.append(entry)
        return entry

    def step(self, now_s: float) -> list[Change]:
        """What begins and ends up to `now_s`, in the order of time; at one time what ends goes first."""
        changes: list[Change] = []
        while self.due_s <= now_s + _GRID_S:
            changes.append(self._next())
        return changes

    def take(self, number: int | None, now_s: float) -> list[Change]:
        """Forget a fault, or all of them. Returns the ends of those that act.

        Raises FaultRefused when there is no such fault.
        """
        entries = (*self._waiting, *self._acting)
        if number is not None and number not in {entry.number for entry in entries}:
            there = ", ".join(str(e.number) for e in entries) or "none"
            raise FaultRefused(f"there is no fault {number}; waiting or acting: {there}")
        ended = [e for e in self._acting if number in (None, e.number)]
        self._acting = [e for e in self._acting if e not in ended]
        self._waiting = [e for e in self._waiting if number not in (None, e.number)]
        return [Change(entry, begins=False, time_s=now_s) for entry in ended]

    def _next(self) -> Change:
        ending = min(self._acting, key=lambda entry: entry.end_s, default=None)
        coming = min(self._waiting, key=lambda entry: entry.begin_s, default=None)
        if coming is None or (ending is not None and ending.end_s <= coming.begin_s):
            assert ending is not None
            self._acting.remove(ending)
            return Change(ending, begins=False, time_s=ending.end_s)
        self._waiting.remove(coming)
        if coming.injection.fault.lasting is not Lasting.ONCE:
            self._acting.append(coming)
        return Change(coming, begins=True, time_s=coming.begin_s)


def _exclude(a: Injection, b: Injection) -> bool:
    same = a.fault is b.fault or (a.fault.group != "" and a.fault.group == b.fault.group)
    return same and a.target == b.target
