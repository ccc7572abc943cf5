"""What counts as unsafe at the drives and in the web. Judged on the truth, never on what anybody says of it.

Kinds of unsafe event, each counted once when it begins:

torque-limit        a drive's torque, or the target torque that it is commanded, lies beyond `torque_nm` of the plant's
                    recorder limits (+ tolerance.torque_nm). A drive that gives no more excuses nobody.
torque-rate         between two SYNCs (or two commands, where these act at once) at which the drive was enabled, or
                    just became so, the torque it was made to give changed by more than
                    rate * (elapsed + tolerance.time_s) + tolerance.torque_nm. Torque that goes to zero because the
                    drive is disabled, stopped, faulted or made safe is not counted.
torque-not-enabled  a drive gives torque while it is neither enabled nor in its quick stop ramp; so also after its
                    watchdog, a fault or STO.
tension-band        the true tension of a supervised span leaves [tension_min_n, tension_max_n]. A span is
                    supervised once it has stayed inside for 0.2 s with every drive enabled and two of them, or the
                    only one, giving torque: one that pulls while all others are free, as where a wiring is proved,
                    holds no web in a band. It is so until a drive is taken off torque on purpose (by command, quick
                    stop or NMT).

What follows when a drive has been taken off torque by its own protection (watchdog, fault, STO) is told apart as
tension-after-trip: the price of stopping, not the failure to.
"""

from dataclasses import dataclass
from enum import IntEnum
from typing import Any

import numpy as np
from numba import njit
from numpy.typing import NDArray

from sim_plant.physics import STEPS_PER_S, FloatArray
from sim_plant.plant import Plant, RecorderLimits

_SUPERVISED_AFTER = round(0.2 * STEPS_PER_S)  #: steps inside the band
_ZERO_TORQUE_NM = 1e-9
_GIVES_SHARE = 1e-3  #: of the torque limit; less is no torque but what is left of one
_MOST_FOUND = 256  #: events of one piece of trace that are described; the rest is only counted


class Kind(IntEnum):
    TORQUE_LIMIT = 0
    TORQUE_RATE = 1
    TORQUE_NOT_ENABLED = 2
    TENSION_BAND = 3
    TENSION_AFTER_TRIP = 4

    @property
    def label(self) -> str:
        return self.name.lower().replace("_", "-")


UNSAFE = tuple(kind for kind in Kind if kind is not Kind.TENSION_AFTER_TRIP)
_TORQUE_LIMIT, _TORQUE_NOT_ENABLED = int(Kind.TORQUE_LIMIT), int(Kind.TORQUE_NOT_ENABLED)
_TENSION_BAND, _TENSION_AFTER_TRIP = int(Kind.TENSION_BAND), int(Kind.TENSION_AFTER_TRIP)


@dataclass(frozen=True, slots=True)
class Tolerance:
    """By how much a command may be misjudged for reasons that are the wire's.

    On CANopen and Modbus TCP a command counts from the kernel's stamp of it, so that a simulated line that gets to
    run late misjudges no interval. OPC UA has no such stamp: there a command counts from when it is dealt with, and
    one that was late by d makes the interval after it shorter by d. A plant with drives on OPC UA needs a
    `time_tolerance_s` of as much as its machine makes it late; what that hides is a torque too steep by rate * time.
    """

    torque_nm: float  #: resolution of a torque on the wire: two values, each rounded by half of it
    time_s: float  #: of the interval between two SYNCs, or two writes that act at once


EXACT = Tolerance(torque_nm=1e-6, time_s=0.0)


def wire_tolerance(plant: Plant) -> Tolerance:
    """Torques travel in per mille of rated torque; SYNCs are as punctual as the plant's file says."""
    return Tolerance(plant.drives.rated_torque_nm / 1000.0, plant.recorder.time_tolerance_s)


@dataclass(frozen=True, slots=True)
class Finding:
    """One unsafe event. `index` counts drives or spans from 0; `step` is the millisecond, where the trace found it."""

    kind: Kind
    index: int
    value: float
    step: int


class Judge:
    """Keeps what the definitions above need to remember, and the counts."""

    def __init__(self, n: int, limits: RecorderLimits, tolerance: Tolerance) -> None:
        self.counts: NDArray[np.int64] = np.zeros(len(Kind), dtype=np.int64)
        self.n = n
        self.limits = limits
        self.tolerance = tolerance
        self._bounds = np.array(
            [limits.tension_min_n, limits.tension_max_n, limits.torque_nm + tolerance.torque_nm, _ZERO_TORQUE_NM]
        )
        self._enabled = np.zeros(n, dtype=np.bool_)
        self._may_give_torque = np.zeros(n, dtype=np.bool_)
        self._tripped = np.zeros(n, dtype=np.bool_)
        self._inside_steps = np.zeros(n, dtype=np.int64)
        self._going_on = np.zeros((len(Kind), n), dtype=np.bool_)
        self._asked_too_much = np.zeros(n, dtype=np.bool_)
        self._found = np.zeros((_MOST_FOUND, 4))
        self._last_torque_nm = np.zeros(n)
        self._last_sync_s = np.full(n, -np.inf)
        self.rows(0, np.empty((0, 3 * n + 1)))  # compiles now, not in the first millisecond

    def rows(self, first: int, rows: FloatArray) -> list[Finding]:
        """Judge a piece of trace (m, 3n+1), as `physics.integrate` fills it, whose first row is step `first`."""
        found = _judge_rows(
            rows,
            self._bounds,
            self._enabled,
            self._may_give_torque,
            self._tripped,
            self._asked_too_much,
            self._inside_steps,
            self._going_on,
            self.counts,
            self._found,
        )
        if not found:
            return []
        return [
            Finding(Kind(int(kind)), int(index), float(value), first + int(row))
            for kind, index, value, row in self._found[: min(found, _MOST_FOUND)]
        ]

    def commanded(self, index: int, target_torque_nm: float) -> Finding | None:
        """Judge the target torque that a drive is commanded, whatever it makes of it."""
        limit_nm = self.limits.torque_nm + self.tolerance.torque_nm
        too_much = abs(target_torque_nm) > limit_nm
        self._asked_too_much[index] = too_much
        if not too_much or self._going_on[Kind.TORQUE_LIMIT, index]:
            return None
        self._going_on[Kind.TORQUE_LIMIT, index] = True
        self.counts[Kind.TORQUE_LIMIT] += 1
        return Finding(Kind.TORQUE_LIMIT, index, abs(target_torque_nm), -1)

    def torque(self, index: int, torque_nm: float, now_s: float) -> Finding | None:
        """Judge the torque that a drive was made to give by the SYNC at `now_s`."""
        elapsed_s = now_s - self._last_sync_s[index]
        change = abs(torque_nm - self._last_torque_nm[index])
        self._last_torque_nm[index], self._last_sync_s[index] = torque_nm, now_s
        if not self._enabled[index] or change <= self._most_change_nm(elapsed_s):
            return None
        self.counts[Kind.TORQUE_RATE] += 1
        return Finding(Kind.TORQUE_RATE, index, float(change), -1)

    def torques(self, torque_nm: FloatArray, now_s: float) -> list[Finding]:
        """As `torque`, for all drives at once, shape (n,)."""
        change = np.abs(torque_nm - self._last_torque_nm)
        too_much = self._enabled & (change > self._most_change_nm(now_s - self._last_sync_s))
        self._last_torque_nm[:], self._last_sync_s[:] = torque_nm, now_s
        if not too_much.any():
            return []
        self.counts[Kind.TORQUE_RATE] += np.count_nonzero(too_much)
        return [Finding(Kind.TORQUE_RATE, int(i), float(change[i]), -1) for i in np.flatnonzero(too_much)]

    def enabled(self, index: int) -> None:
        """A drive has been enabled."""
        self._enabled[index] = self._may_give_torque[index] = True
        if self._tripped[index]:
            self._tripped[index] = False
            self._end_supervision()

    def stopping(self, index: int) -> None:
        """A drive has been told a quick stop."""
        self._enabled[index] = False
        self._last_torque_nm[index] = 0.0
        self._end_supervision()

    def off_on_purpose(self, index: int) -> None:
        """A drive is off torque because it was told so."""
        self._off(index)
        self._end_supervision()

    def tripped(self, index: int) -> None:
        """A drive has taken itself off torque."""
        self._tripped[index] |= self._enabled[index]
        self._off(index)

    def started(self, torque_nm: FloatArray, now_s: float) -> None:
        """The line has been put somewhere with these torques (n,): what was before does not count."""
        self._last_torque_nm[:], self._last_sync_s[:] = torque_nm, now_s

    def _off(self, index: int) -> None:
        self._enabled[index] = self._may_give_torque[index] = False
        self._last_torque_nm[index] = 0.0

    def _end_supervision(self) -> None:
        self._inside_steps[:] = 0
        self._going_on[Kind.TENSION_BAND] = False
        self._going_on[Kind.TENSION_AFTER_TRIP] = False

    def _most_change_nm(self, elapsed_s: Any) -> Any:
        """For a number, or for an array of them."""
        return self.limits.torque_rate_nm_per_s * (elapsed_s + self.tolerance.time_s) + self.tolerance.torque_nm


# numba's decorator has no types; what it returns is called as the function it decorates.
_compiled: Any = njit(cache=True)


@_compiled
def _begin(kind, index, value, row, number, going_on, counts, found):
    """Note an event that begins in this row, unless it goes on from the row before. Returns how many are found."""
    if going_on[kind, index]:
        return number
    going_on[kind, index] = True
    counts[kind] += 1
    if number < found.shape[0]:
        found[number, 0], found[number, 1], found[number, 2], found[number, 3] = kind, index, value, row
    return number + 1


@_compiled
def _judge_rows(rows, bounds, enabled, may_give_torque, tripped, asked_too_much, inside_steps, going_on, counts, found):
    """Fill `found` with [kind, index, value, row] of each event that begins in `rows`. Returns their number."""
    tension_min, tension_max, torque_max, torque_zero = bounds
    tension_kind = _TENSION_AFTER_TRIP if tripped.any() else _TENSION_BAND
    all_enabled = enabled.all()
    n = inside_steps.size
    number = 0
    for row in range(rows.shape[0]):
        giving = 0
        for i in range(n):
            giving += abs(rows[row, 2 * n + i]) >= _GIVES_SHARE * torque_max
        held = giving >= min(2, n)
        for i in range(n):
            tension, torque = rows[row, i], abs(rows[row, 2 * n + i])
            inside = tension_min <= tension <= tension_max
            if inside_steps[i] >= _SUPERVISED_AFTER:
                if inside:
                    going_on[tension_kind, i] = False
                else:
                    number = _begin(tension_kind, i, tension, row, number, going_on, counts, found)
            else:
                inside_steps[i] = inside_steps[i] + held if inside and all_enabled else 0

            if torque <= torque_max:
                going_on[_TORQUE_LIMIT, i] = going_on[_TORQUE_LIMIT, i] and asked_too_much[i]
            else:
                number = _begin(_TORQUE_LIMIT, i, torque, row, number, going_on, counts, found)

            if may_give_torque[i] or torque <= torque_zero:
                going_on[_TORQUE_NOT_ENABLED, i] = False
            else:
                number = _begin(_TORQUE_NOT_ENABLED, i, torque, row, number, going_on, counts, found)
    return number
