"""Load cells that show one value while the line moves. Pure; time is counted in periods."""

from dataclasses import dataclass, field
from math import floor

import numpy as np

from gateway.core.line import Line
from gateway.core.signals import BoolArray, CountArray, FloatArray, Inputs, Quality
from safety.actions import Action, Finding

_GOOD = int(Quality.GOOD)


@dataclass(frozen=True, slots=True)
class StuckLimits:
    measured: BoolArray  #: (n,), spans that are controlled by a load cell
    stuck_s: float
    stuck_periods: int  #: without a change until a cell counts as stuck


def stuck_limits(line: Line) -> StuckLimits:
    period_s = line.control.period_s
    return StuckLimits(
        measured=np.array([span.control == "tension" for span in line.spans]),
        stuck_s=line.limits.stuck_s,
        stuck_periods=max(1, floor(line.limits.stuck_s / period_s + 1e-9)),
    )


@dataclass(slots=True)
class StuckState:
    """Last samples, and counts of periods, each of shape (n,)."""

    tension_n: FloatArray = field(default_factory=lambda: np.zeros(0))
    speed_m_per_s: FloatArray = field(default_factory=lambda: np.zeros(0))
    same: CountArray = field(default_factory=lambda: np.zeros(0, np.int64))  #: without a change
    stuck: BoolArray = field(default_factory=lambda: np.zeros(0, np.bool_))


def find_stuck(limits: StuckLimits, state: StuckState, inputs: Inputs) -> list[Finding]:
    """Bring `state.stuck` (n,) up to date; returns what stops the line: nobody else knows the tension of that span.

    A cell that stays at one value counts only while some roller's speed changes: a line on which nothing at all
    moves tells nothing.
    """
    tension, speed = inputs.tension, inputs.speed
    if len(state.same) != inputs.n:
        state.tension_n, state.speed_m_per_s = tension.value.copy(), speed.value.copy()
        state.same = np.zeros(inputs.n, np.int64)
        state.stuck = np.zeros(inputs.n, np.bool_)
        return []
    fresh = tension.quality == _GOOD
    changed = fresh & (tension.value != state.tension_n)
    alive = bool((speed.value != state.speed_m_per_s).any())
    state.same = np.where(changed, 0, state.same + (fresh & limits.measured & alive))
    state.stuck = state.same >= limits.stuck_periods
    np.copyto(state.tension_n, tension.value, where=fresh)
    state.speed_m_per_s[:] = speed.value
    return [_finding(limits, state, int(i)) for i in np.flatnonzero(state.stuck)]


def _finding(limits: StuckLimits, state: StuckState, i: int) -> Finding:
    text = (
        f"the load cell of span {i + 1} has shown {state.tension_n[i]:.2f} N for {limits.stuck_s:g} s while rollers "
        "move: check it, its amplifier and its cable"
    )
    return Finding("load cell stuck", Action.STOP, text)
