"""Encoder jumps: a speed that no roller can have reached since its last sample is discarded. Pure.

A roller of radius R and inertia J under the torque limit u and web tensions up to T_max is accelerated by at most
R/J (u + R T_max) (eq. roller_velocity_dynamics without friction).
"""

from dataclasses import dataclass, field

import numpy as np

from gateway.core.line import Line
from gateway.core.signals import CountArray, FloatArray, Inputs, Quality
from safety.actions import Action, Finding

NOISE_M_PER_S = 0.002  #: of two speed samples together, well above any usable encoder's
MARGIN = 2.0  #: times what the nominal parameters allow; inertia and radius are not known better
MEMORY_S = 1.0  #: a second jump within this time is no coincidence
_GOOD = int(Quality.GOOD)


@dataclass(frozen=True, slots=True)
class JumpLimits:
    """Per roller, shape (n,)."""

    acceleration_m_per_s2: FloatArray
    period_s: float
    memory_periods: int


def jump_limits(line: Line) -> JumpLimits:
    """What the rollers of `line` can do, at the edge of their tolerances."""
    limits = line.limits
    radius = np.array([r.radius_m.value * (1 + r.radius_m.tolerance) for r in line.rollers])
    inertia = np.array([r.inertia_kg_m2.value * (1 - r.inertia_kg_m2.tolerance) for r in line.rollers])
    period_s = line.control.period_s
    most = MARGIN * radius / inertia * (limits.torque_nm + radius * limits.tension_max_n)
    return JumpLimits(most, period_s, round(MEMORY_S / period_s))


@dataclass(slots=True)
class JumpState:
    """The last believed speed (n,) in m/s, its age (n,) in periods, and how long a jump is remembered yet."""

    speed_m_per_s: FloatArray = field(default_factory=lambda: np.zeros(0))
    age: CountArray = field(default_factory=lambda: np.zeros(0, np.int64))
    remembered: CountArray = field(default_factory=lambda: np.zeros(0, np.int64))


def reject_jumps(limits: JumpLimits, state: JumpState, inputs: Inputs) -> list[Finding]:
    """Mark speeds that jumped as BAD, with the last believed value; a second jump of a roller stops the line.

    `state` is brought up to date. Without an earlier sample nothing is a jump.
    """
    speed = inputs.speed
    if len(state.age) != inputs.n:
        state.speed_m_per_s = np.full(inputs.n, np.nan)
        state.age = np.ones(inputs.n, np.int64)
        state.remembered = np.zeros(inputs.n, np.int64)
    good = speed.quality == _GOOD
    reach = limits.acceleration_m_per_s2 * (state.age * limits.period_s) + NOISE_M_PER_S
    with np.errstate(invalid="ignore"):
        jumped = good & (np.abs(speed.value - state.speed_m_per_s) > reach)  # False for NaN: no earlier sample
    findings: list[Finding] = []
    if jumped.any():
        findings = [_second(inputs, state, int(i)) for i in np.flatnonzero(jumped & (state.remembered > 0))]
        for i in np.flatnonzero(jumped):
            speed.reject(int(i))
            speed.value[i] = state.speed_m_per_s[i]
        state.remembered[jumped] = limits.memory_periods
        good = good & ~jumped
    state.remembered = np.maximum(state.remembered - ~jumped, 0)
    state.age = np.where(good, 1, state.age + 1)
    np.copyto(state.speed_m_per_s, speed.value, where=good)
    return findings


def _second(inputs: Inputs, state: JumpState, i: int) -> Finding:
    text = (
        f"the speed of roller {i + 1} jumped twice, to {inputs.speed.value[i]:.4f} from "
        f"{state.speed_m_per_s[i]:.4f} m/s: check its encoder and the encoder's cable"
    )
    return Finding("encoder jump", Action.STOP, text)
