"""Speeds that cannot be true are discarded: rollers by their acceleration, v0 by its request. Pure.

A roller's acceleration is that of eq. roller_velocity_dynamics,

    a_i = R_i/J_i (u_i + R_i (T_{i+1} - T_i)) - f_i/J_i v_i

with the torque u that acted, or none if the drive has let go, and parameters anywhere in their tolerances.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field
from math import isnan

import numpy as np

from gateway.core.line import Line
from gateway.core.line_scales import line_scales
from gateway.core.signals import CountArray, FloatArray, Inputs, Quality
from safety.actions import Action, Finding, found
from safety.rejections import Impossible

MEMORY_MOMENTS = 50.0  #: a second jump within so long is no coincidence
UNWINDER_MARGIN = 0.15  #: of the line's greatest speed: noise of v0, and how far it overshoots its request
UNWINDER_SPEED = ("unwinder speed", 0)  #: its channel and number, as it is told
_GOOD = int(Quality.GOOD)


@dataclass(frozen=True, slots=True)
class JumpLimits:
    """Arrays (n,), each at the edge of its tolerance that allows more."""

    radius_m: FloatArray
    radius_per_inertia: FloatArray  #: R/J, 1/(kg m)
    friction_rate_per_s: FloatArray  #: f/J
    noise_m_per_s: FloatArray  #: of two samples together, well above any usable encoder's; two counts included
    tension_max_n: float
    unwinder_m_per_s: float
    period_s: float
    memory_periods: int


def jump_limits(line: Line, speed_steps_m_per_s: FloatArray) -> JumpLimits:
    """What the rollers of `line` can do. `speed_steps_m_per_s` (n,) is what a count of each drive's speed is worth."""
    rollers, period_s, scales = line.rollers, line.control.period_s, line_scales(line)
    radius = np.array([r.radius_m.value * (1 + r.radius_m.tolerance) for r in rollers])
    inertia = np.array([r.inertia_kg_m2.value * (1 - r.inertia_kg_m2.tolerance) for r in rollers])
    friction = np.array([r.friction_nms_per_rad.value * (1 + r.friction_nms_per_rad.tolerance) for r in rollers])
    return JumpLimits(
        radius_m=radius,
        radius_per_inertia=radius / inertia,
        friction_rate_per_s=friction / inertia,
        noise_m_per_s=scales.speed_m_per_s + 2.0 * speed_steps_m_per_s,
        tension_max_n=line.limits.tension_max_n,
        unwinder_m_per_s=UNWINDER_MARGIN * line.limits.speed_max_m_per_s,
        period_s=period_s,
        memory_periods=scales.periods(MEMORY_MOMENTS),
    )


@dataclass(slots=True)
class JumpState:
    """Last believed values, and the periods of the last believed value and of the last jump; arrays (n,).

    Periods are counted from 1.
    """

    period: int = 0
    speed_m_per_s: FloatArray = field(default_factory=lambda: np.zeros(0))
    believed: CountArray = field(default_factory=lambda: np.zeros(0, np.int64))
    jumped: CountArray = field(default_factory=lambda: np.zeros(0, np.int64))
    unwind_speed_m_per_s: float = np.nan
    unwind_doubted_m_per_s: float = np.nan  #: the last one that fell away from its request; NaN: it keeps to it
    unwind_confirmed: bool = False  #: what was not believed was true, as this period's sample says
    rejected: list[Impossible] = field(default_factory=list[Impossible])  #: since they were taken in


def reject_jumps(
    limits: JumpLimits, state: JumpState, inputs: Inputs, torques_nm: Sequence[FloatArray]
) -> list[Finding]:
    """Mark speeds that jumped as BAD, with the last believed value; a second jump of a roller stops the line.

    `torques_nm` are all torques (n,) that have acted since the last sample. `state` is brought up to date. Without an
    earlier sample nothing is a jump.
    """
    speed = inputs.speed
    if len(state.believed) != inputs.n:
        state.speed_m_per_s = np.full(inputs.n, np.nan)
        state.believed = np.full(inputs.n, state.period)
        state.jumped = np.full(inputs.n, state.period - limits.memory_periods)
    state.period += 1
    change = np.abs(speed.value - state.speed_m_per_s)  # NaN without an earlier sample: not greater than anything
    if speed.good() and not np.count_nonzero(change > limits.noise_m_per_s):  # within noise whatever torque acted
        state.believed.fill(state.period)
        state.speed_m_per_s[:] = speed.value
        return []
    good = speed.quality == _GOOD
    # Where nobody knows how far it can have come, it has jumped; without an earlier sample nothing has.
    first = np.isnan(state.speed_m_per_s)
    reach = _reach(limits, state, inputs, torques_nm)
    jumped = good & ~first & ~(change <= reach)
    findings: list[Finding] = []
    if jumped.any():
        again = jumped & (state.period - state.jumped <= limits.memory_periods)
        findings = [_second(inputs, state, int(i)) for i in np.flatnonzero(again)]
        for i in np.flatnonzero(jumped).tolist():
            speed.reject(i)
            last, far = state.speed_m_per_s.item(i), reach.item(i)
            state.rejected.append(Impossible("speed", i + 1, speed.value.item(i), last - far, last + far, "m/s"))
            speed.value[i] = last
        state.jumped[jumped] = state.period
        good = good & ~jumped
    state.believed[good] = state.period
    state.speed_m_per_s[good] = speed.value[good]
    return findings


def _reach(limits: JumpLimits, state: JumpState, inputs: Inputs, torques_nm: Sequence[FloatArray]) -> FloatArray:
    """How far (m/s) each roller can have come since its last believed sample, (n,); at least the noise."""
    tension = np.where(inputs.tension.quality == _GOOD, np.abs(inputs.tension.value), limits.tension_max_n)
    pull_n = np.maximum(tension, np.concatenate((tension[1:], (0.0,))))  # the web may have let go on either side
    torque_nm: FloatArray = np.max(np.abs(torques_nm), axis=0)
    drive = limits.radius_per_inertia * (torque_nm + limits.radius_m * pull_n)
    brake = limits.friction_rate_per_s * np.abs(state.speed_m_per_s)
    elapsed_s = (state.period - state.believed) * limits.period_s
    return (drive + brake) * elapsed_s + limits.noise_m_per_s


def reject_unwinder(limits: JumpLimits, state: JumpState, inputs: Inputs, request_m_per_s: float) -> None:
    """Mark a v0 as BAD that has gone neither near its request nor stayed near its last value.

    It may step: a PLC without a ramp does. Towards its request that is believed at once; away from it, as where the
    transport is stopped by another, only what the next sample confirms, and nothing beyond standstill. While it is not
    asked for anything it may be moved by hand, so that this is for a line under control.
    """
    state.unwind_confirmed = False
    unwind = inputs.unwind_speed
    if not unwind.good():
        return
    value, last, margin = unwind.value.item(0), state.unwind_speed_m_per_s, limits.unwinder_m_per_s
    if isnan(last):
        last = value
    near = min(last, request_m_per_s) - margin, max(last, request_m_per_s) + margin
    if not near[0] <= value <= near[1]:
        doubted, state.unwind_doubted_m_per_s = state.unwind_doubted_m_per_s, value
        possible = min(near[0], -margin) <= value <= max(near[1], margin)
        # The next sample is near it, or has gone on; NaN, where there is none before, is neither.
        state.unwind_confirmed = possible and (abs(value - doubted) <= margin or abs(value) < abs(doubted))
        if not state.unwind_confirmed:
            unwind.reject(0)
            unwind.value[0] = last
            state.rejected.append(Impossible(*UNWINDER_SPEED, value, *near, "m/s", confirmable=possible))
            return
    else:
        state.unwind_doubted_m_per_s = np.nan
    state.unwind_speed_m_per_s = value


def _second(inputs: Inputs, state: JumpState, i: int) -> Finding:
    values = {"speed_m_per_s": inputs.speed.value.item(i), "before_m_per_s": state.speed_m_per_s.item(i)}
    return found("encoder-jump", Action.STOP, roller=i + 1, **values)
