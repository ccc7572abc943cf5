"""Load cells that drift, told from the balance of torques. Pure; time is counted in periods.

At constant set-points the average of eq. roller_velocity_dynamics is

    rho_i = u_i - f_i/R_i v_i + R_i (T_{i+1} - T_i) = 0

with the true tensions. What is wrong in the model shifts rho_i by a constant. If cell k shows d_k too much, control
keeps the shown value, and rho_i moves by R_i (d_{i+1} - d_i): a drift of cell k alone moves rho_{k-1}/R and rho_k/R
by the same amount in opposite directions, which no change of one roller's friction does. (Roller 0 has no torque
that is known here, so cell 1 is told from roller 1 alone, and at a higher threshold. A span without a cell leaves both
of its rollers without a balance: the cells beside it are not watched.)
"""

from dataclasses import dataclass, field

import numpy as np

from gateway.core.line import Line
from gateway.core.line_scales import line_scales
from gateway.core.signals import FloatArray
from gateway.core.web_model import WebModel, equilibrium_torque, nominal_model

BLOCK_MOMENTS = 50.0  #: that averages are taken over
WINDOW_BLOCKS = 10  #: of the moving average, and of the reference
SETTLE_MOMENTS = 250.0  #: after a set-point moved, until the reference begins
#: A change that is told, in small tensions. Ten seconds of the benchmark's disturbance move the average by 0.4.
DRIFT = 2.0
DRIFT_ALONE = 3.0  #: the same for cell 1


@dataclass(frozen=True, slots=True)
class DriftLimits:
    model: WebModel
    measured: FloatArray  #: (n,), 1.0 where a load cell measures the span
    block_periods: int
    settle_periods: int
    small_n: float  #: a tension that is small on this line


def drift_limits(line: Line) -> DriftLimits:
    scales = line_scales(line)
    measured = np.array([1.0 if span.control == "tension" else 0.0 for span in line.spans])
    block_periods, settle_periods = scales.periods(BLOCK_MOMENTS), scales.periods(SETTLE_MOMENTS)
    return DriftLimits(nominal_model(line), measured, block_periods, settle_periods, scales.tension_n)


@dataclass(slots=True)
class DriftState:
    settling: int = 0  #: periods until blocks count
    in_block: int = 0  #: periods summed so far
    #: (3, n), over the block: torques, speeds and tensions
    sums: FloatArray = field(default_factory=lambda: np.zeros((3, 0)))
    blocks_nm: list[FloatArray] = field(default_factory=list[FloatArray])  #: the last averages, the newest at the end
    reference_nm: FloatArray | None = None  #: (n,)
    drift_n: FloatArray = field(default_factory=lambda: np.zeros(0))  #: (n,), of each cell, as far as it is told


def restart(limits: DriftLimits, state: DriftState) -> None:
    """A set-point moved, a cell is stuck, or control was not on: what was balanced before does not count."""
    state.settling = limits.settle_periods
    state.in_block = 0
    state.blocks_nm = []
    state.reference_nm = None
    state.sums = np.zeros((3, limits.model.n))


def watch_balance(
    limits: DriftLimits, state: DriftState, tension_n: FloatArray, speed_m_per_s: FloatArray, torque_nm: FloatArray
) -> None:
    """Take in a period at constant set-points: samples (n,), and the torque (n,) that was applied meanwhile."""
    if state.settling > 0:
        state.settling -= 1
        return
    state.sums += (torque_nm, speed_m_per_s, tension_n)
    state.in_block += 1
    if state.in_block >= limits.block_periods:
        # rho is linear: its average is that of the averages.
        state.blocks_nm.append(balance_nm(limits.model, *(state.sums / state.in_block)))
        state.in_block = 0
        state.sums.fill(0.0)
        _judge(limits, state)


def balance_nm(model: WebModel, torque_nm: FloatArray, speed_m_per_s: FloatArray, tension_n: FloatArray) -> FloatArray:
    """rho (n,), from averages (n,)."""
    return torque_nm - equilibrium_torque(model, tension_n, speed_m_per_s)


def _judge(limits: DriftLimits, state: DriftState) -> None:
    if len(state.blocks_nm) < WINDOW_BLOCKS:
        return
    state.blocks_nm = state.blocks_nm[-WINDOW_BLOCKS:]
    average_nm: FloatArray = np.mean(state.blocks_nm, axis=0)
    if state.reference_nm is None:
        state.reference_nm = average_nm
        state.drift_n = np.zeros(limits.model.n)
        return
    change_n = (average_nm - state.reference_nm) / limits.model.radius_m
    state.drift_n = drift_of(change_n, limits.small_n) * limits.measured


def drift_of(change_n: FloatArray, small_n: float) -> FloatArray:
    """Which cells (n,) drift by how much (N), from the change of rho_i / R_i (n,) since the reference; 0: none told."""
    told_n, told_alone_n = DRIFT * small_n, DRIFT_ALONE * small_n
    drift_n = np.zeros(len(change_n))
    before, after = change_n[:-1], -change_n[1:]
    agree = (np.minimum(before, after) > told_n) | (np.maximum(before, after) < -told_n)
    drift_n[1:] = np.where(agree, 0.5 * (before + after), 0.0)
    # What cell 2 explains of roller 1 is not cell 1's.
    alone = -change_n[0] + (drift_n[1] if len(change_n) > 1 else 0.0)
    drift_n[0] = alone if abs(alone) > told_alone_n else 0.0
    return drift_n
