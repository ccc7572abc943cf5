"""Load cells that show one value while the line moves. Pure; time is counted in periods.

A cell whose noise spans several of its counts never shows one value for long. One with a coarse resolution, or a
long filter, may: it shows the same count again and again, and nothing can be told this way. Which kind a cell is, is
learnt from its own changes: their usual size against the smallest one.
"""

from dataclasses import dataclass, field
from math import floor

import numpy as np

from gateway.core.line import Line
from gateway.core.signals import BoolArray, CountArray, FloatArray, Inputs, Quality
from safety.actions import Action, Finding

COUNTS = 3.0  #: that a usual change of a fine cell spans; the same value 60 times in a row is then beyond chance
LEARNT_CHANGES = 20  #: until a cell is judged
REMEMBERED = 100.0  #: changes that the usual size of a change is the mean of, about; of fewer while there are fewer
_GOOD = int(Quality.GOOD)


@dataclass(frozen=True, slots=True)
class StuckLimits:
    measured: BoolArray  #: (n,), spans that are controlled by a load cell
    stuck_periods: int  #: without a change until a cell counts as stuck, at least


def stuck_limits(line: Line) -> StuckLimits:
    return StuckLimits(
        measured=np.array([span.control == "tension" for span in line.spans]),
        stuck_periods=max(1, floor(line.limits.stuck_s / line.control.period_s + 1e-9)),
    )


@dataclass(slots=True)
class StuckState:
    """Last samples, counts and shares, each of shape (n,)."""

    tension_n: FloatArray = field(default_factory=lambda: np.zeros(0))
    speed_m_per_s: FloatArray = field(default_factory=lambda: np.zeros(0))
    same: CountArray = field(default_factory=lambda: np.zeros(0, np.int64))  #: samples without a change, in a row
    changes: CountArray = field(default_factory=lambda: np.zeros(0, np.int64))  #: seen so far
    smallest_n: FloatArray = field(default_factory=lambda: np.zeros(0))  #: change
    usual_n: FloatArray = field(default_factory=lambda: np.zeros(0))  #: size of a change
    stuck: BoolArray = field(default_factory=lambda: np.zeros(0, np.bool_))


def find_stuck(limits: StuckLimits, state: StuckState, inputs: Inputs) -> list[Finding]:
    """Bring `state.stuck` (n,) up to date; returns what stops the line: nobody else knows the tension of that span.

    A cell that stays at one value counts only while some roller's speed changes: a line on which nothing at all
    moves tells nothing.
    """
    tension, speed = inputs.tension, inputs.speed
    if len(state.same) != inputs.n:
        state.tension_n, state.speed_m_per_s = tension.value.copy(), speed.value.copy()
        state.same, state.changes = np.zeros(inputs.n, np.int64), np.zeros(inputs.n, np.int64)
        state.smallest_n, state.usual_n = np.full(inputs.n, np.inf), np.zeros(inputs.n)
        state.stuck = np.zeros(inputs.n, np.bool_)
        return []
    fresh = tension.quality == _GOOD
    size_n = np.abs(tension.value - state.tension_n)  # NaN for a cell that was never heard
    changed = fresh & (size_n > 0.0)
    alive = bool((speed.value != state.speed_m_per_s).any())
    state.changes += changed
    state.smallest_n = np.where(changed, np.minimum(state.smallest_n, size_n), state.smallest_n)
    weight = 1.0 / np.clip(state.changes, 1.0, REMEMBERED)
    state.usual_n = np.where(changed, state.usual_n + weight * (size_n - state.usual_n), state.usual_n)
    state.same = np.where(changed, 0, state.same + (fresh & limits.measured & alive))
    fine = (state.changes >= LEARNT_CHANGES) & (state.usual_n >= COUNTS * state.smallest_n)
    state.stuck = fine & (state.same >= limits.stuck_periods)
    np.copyto(state.tension_n, tension.value, where=fresh)
    state.speed_m_per_s[:] = speed.value
    return [_finding(state, int(i)) for i in np.flatnonzero(state.stuck)]


def _finding(state: StuckState, i: int) -> Finding:
    text = (
        f"the load cell of span {i + 1} has shown {state.tension_n[i]:.2f} N {state.same[i]} times in a row while "
        "rollers move: check it, its amplifier and its cable"
    )
    return Finding("load cell stuck", Action.STOP, text)
