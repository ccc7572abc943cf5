"""Drives that answer with what they said before: correctly framed, in time, and old. Pure; time is counted in periods.

The measured speed of a turning roller jitters: it hardly ever comes twice, to the last count. Whether that is so for a
drive is learnt from its own samples: one with a coarse or filtered speed repeats itself, and nothing can be told this
way. Only reversals teach that there is jitter: in a ramp a coarse speed changes with every sample, too.
"""

from dataclasses import dataclass, field

import numpy as np

from gateway.core.line import Line
from gateway.core.signals import CountArray, FloatArray, Inputs, Quality
from safety.actions import Action, Finding

REPEATS = 7  #: of one sample until a drive counts as frozen: by chance once in decades, at one in RARE
LEARNT_REVERSALS = 150  #: of the speed, until a drive is judged
REMEMBERED_REVERSALS = 10_000  #: then half of what was learnt is forgotten
RARE = 30  #: reversals to which at most one repeat belongs; jitter reverses two times in three
TURNING = 0.02  #: of the line's greatest speed; slower, an encoder may well count nothing between two samples
_GOOD = int(Quality.GOOD)


@dataclass(slots=True)
class FrozenState:
    """Arrays (n,)."""

    speed_m_per_s: FloatArray = field(default_factory=lambda: np.zeros(0))  #: last sample
    change_m_per_s: FloatArray = field(default_factory=lambda: np.zeros(0))  #: the last one that was not zero
    reversals: CountArray = field(default_factory=lambda: np.zeros(0, np.int64))  #: changes against the one before
    repeats: CountArray = field(default_factory=lambda: np.zeros(0, np.int64))  #: samples like it, of runs that ended
    same: CountArray = field(default_factory=lambda: np.zeros(0, np.int64))  #: repeats in a row


def turning_m_per_s(line: Line) -> float:
    """The speed from which on a roller turns fast enough for its samples to be judged."""
    return TURNING * line.limits.speed_max_m_per_s


def find_frozen(turning_from_m_per_s: float, state: FrozenState, inputs: Inputs) -> list[Finding]:
    """Drives whose samples stand still while their rollers turn. Brings `state` up to date."""
    speed = inputs.speed
    if len(state.same) != inputs.n:
        state.speed_m_per_s = np.full(inputs.n, np.nan)
        state.change_m_per_s = np.zeros(inputs.n)
        state.reversals, state.repeats, state.same = (np.zeros(inputs.n, np.int64) for _ in range(3))
    fresh = speed.quality == _GOOD
    told = fresh & (np.abs(speed.value) > turning_from_m_per_s)
    change = speed.value - state.speed_m_per_s  # NaN at first
    repeated, changed = told & (change == 0.0), fresh & (change != 0.0)
    state.reversals += told & (change * state.change_m_per_s < 0.0)
    # A run of repeats teaches how usual they are when it has ended: before, it may be the fault.
    state.repeats += np.where(changed, state.same, 0)
    old = state.reversals > REMEMBERED_REVERSALS
    state.reversals[old] //= 2
    state.repeats[old] //= 2
    state.same = np.where(repeated, state.same + 1, np.where(fresh, 0, state.same))
    np.copyto(state.change_m_per_s, change, where=changed)
    rare = (state.reversals >= LEARNT_REVERSALS) & (RARE * state.repeats <= state.reversals)
    frozen = rare & (state.same >= REPEATS)
    np.copyto(state.speed_m_per_s, speed.value, where=fresh)
    return [_finding(inputs, state, int(i)) for i in np.flatnonzero(frozen)] if frozen.any() else []


def _finding(inputs: Inputs, state: FrozenState, i: int) -> Finding:
    text = (
        f"the drive of roller {i + 1} has shown {inputs.speed.value[i]:.6f} m/s {state.same[i] + 1} times in a row: "
        "its samples are frozen; restart the drive, and check what lies between"
    )
    return Finding("drive frozen", Action.STOP, text)
