"""Load cells that torques, speeds and the cells beside them contradict. Pure; time is counted in periods.

Averaged over a window of t seconds, eq. roller_velocity_dynamics holds with the speeds at its two ends, whatever the
line does in between:

    T_i - T_{i+1} = u_i/R_i - f_i v_i/R_i^2 - J_i/R_i^2 (v_end - v_begin)/t

with each parameter anywhere in its tolerance, and a dry friction (`gateway.core.tension_estimate`). A cell that shows
d too much contradicts both rollers of its span by d, in the same direction; a drive, an encoder or a bearing that is
not as it should be contradicts two cells, each from one side, and blames none. Nothing is known of the unwinder's
torque: cell 1 is told by roller 1 alone, later, where roller 2 excludes that it is cell 2; it may be drive 1 as well.

Windows are compared twice: as they are, which finds a cell whose zero was wrong when control began, as far as friction
and zeros leave it open; and with what was before, which finds a zero, a factor or decimals that change while the line
runs: what does not change falls out of that. A span without a cell leaves its two rollers without a balance.
"""

from dataclasses import dataclass, field

import numpy as np

from gateway.core.line import Line
from gateway.core.line_limits import tension_bands_n
from gateway.core.line_scales import line_scales
from gateway.core.signals import CountArray, FloatArray, Inputs
from gateway.core.tension_estimate import TORQUE_ERROR, Balance, balance_of, changes_of, pull_n
from gateway.core.theta import expected_noise
from safety.actions import Action, Finding, found

BLOCK_MOMENTS = 10.0  #: that samples are averaged over
WINDOWS = (1, 4, 16)  #: blocks: soon where noise allows, within a second, and as exactly as heavy rollers need
EACH = (1, 1, 2)  #: so many blocks a window is looked at
LOOKS = (3, 2, 2)  #: in a row, at one window, until a cell is told
END_SAMPLES = 3  #: whose mean stands for the end of a block
ALONE = 2  #: times as many for cell 1
SURELY = 0.15  #: of a span's tension band, beyond all noise: one look counts for all
STEADY = 4  #: blocks, from which on a window is looked at as it is
BEFORE = 8  #: blocks before a window that it is compared with
KEPT = BEFORE + max(WINDOWS)
BAND_SHARE = 0.05  #: of a span's tension band, by which a cell must be off to be told
ZEROS_SHARE = 0.10  #: the same, that the zeros of two proved cells may be off together (`proving.ZERO_SHARE`)
DEVIATIONS = 4.0  #: of the noise of a window
GIVEN_SHARE = 0.3  #: of a torque, that what a drive gives may be off by (`drive_feedback.ASKED_SHARE`)
CHANGE_SHARE = 0.1  #: the same of what it changes by
LAG_MOMENTS = 3.0  #: by which a drive, or a cell's filter, may be behind
LEARNT_BLOCKS = 32.0  #: that the usual noise is the mean of, about
CHANCE = 1.1  #: mean difference of two blocks, in standard deviations of one
CODE = "load-cell-contradicted"
_TORQUE, _SPEED, _TENSION = 0, 1, 2


@dataclass(frozen=True)
class CellLimits:
    """Arrays (n,)."""

    balance: Balance
    changes: Balance
    seen: FloatArray  #: 1 where a load cell measures the span, else NaN
    band_n: FloatArray
    block_periods: int
    block_s: float
    lag_s: float
    radius_m: FloatArray
    speed_noise_n: FloatArray  #: of a block, that two samples of a speed make of its acceleration
    tension_noise_n: float  #: of a block, of the difference of two tensions


def cell_limits(line: Line) -> CellLimits:
    """Of `line`."""
    scales, noise, balance = line_scales(line), expected_noise(line), balance_of(line)
    block_periods = scales.periods(BLOCK_MOMENTS)
    block_s = block_periods * line.control.period_s
    low_n, high_n = tension_bands_n(line)
    spans = [cell.span for cell in line.load_cells]
    return CellLimits(
        balance=balance,
        changes=changes_of(balance),
        seen=np.where(np.isin(np.arange(1, line.n + 1), spans), 1.0, np.nan),
        band_n=high_n - low_n,
        block_periods=block_periods,
        block_s=block_s,
        lag_s=LAG_MOMENTS * scales.moment_s,
        radius_m=np.array([roller.radius_m.value for roller in line.rollers]),
        speed_noise_n=balance.mass_kg[1] * noise.speed_m_per_s * 2.0**0.5 / block_s,
        tension_noise_n=noise.tension_n * (2.0 / block_periods) ** 0.5,
    )


@dataclass(slots=True)
class CellState:
    """What was seen since control began. Rows are torques, speeds and tensions, (3, n)."""

    in_block: int = 0  #: periods
    blocks: int = 0
    block: FloatArray = field(default_factory=lambda: np.zeros((0, 3, 0)))  #: its samples, (periods, 3, n)
    means: FloatArray = field(default_factory=lambda: np.zeros((KEPT, 3, 0)))  #: of blocks, the newest last
    ends: FloatArray = field(default_factory=lambda: np.zeros((KEPT + 1, 3, 0)))  #: samples at their ends
    residual_n: FloatArray = field(default_factory=lambda: np.zeros(0))  #: of the block before
    usual_n: FloatArray = field(default_factory=lambda: np.zeros(0))  #: by which residuals differ
    waiting: list[int] = field(default_factory=list[int])  #: windows that are still to be looked at
    beyond: CountArray = field(
        default_factory=lambda: np.zeros((0, 0), np.int64)
    )  #: (windows, n), looks in a row, negative where less is shown


def find_contradicted(limits: CellLimits, state: CellState, inputs: Inputs, applied_nm: FloatArray) -> list[Finding]:
    """What stops the line, from samples that are all usable and the torques (n,) that acted meanwhile.

    Once a period; most do no more than add up. `state` is brought up to date.
    """
    if not state.block.size:
        _begin(limits, state, inputs, applied_nm)
        return []
    rows = state.block[state.in_block]
    rows[_TORQUE], rows[_SPEED], rows[_TENSION] = applied_nm, inputs.speed.value, inputs.tension.value
    state.in_block += 1
    if state.in_block >= limits.block_periods:
        _end_block(limits, state)
    elif state.waiting:  # one a period: none of them is long
        return _look(limits, state, state.waiting.pop())
    return []


def _begin(limits: CellLimits, state: CellState, inputs: Inputs, applied_nm: FloatArray) -> None:
    n = inputs.n
    state.block = np.zeros((limits.block_periods, 3, n))
    state.means, state.ends = np.zeros((KEPT, 3, n)), np.zeros((KEPT + 1, 3, n))
    state.ends[-1] = applied_nm, inputs.speed.value, inputs.tension.value
    state.residual_n = np.full(n, np.nan)
    state.usual_n = _noise_n(limits, 1)
    state.beyond = np.zeros((len(WINDOWS), n), np.int64)


def _noise_n(limits: CellLimits, blocks: int) -> FloatArray:
    """The standard deviation (n,) that is expected of what a roller says, over so many blocks."""
    return np.hypot(limits.speed_noise_n / blocks, limits.tension_noise_n / blocks**0.5)


def _end_block(limits: CellLimits, state: CellState) -> None:
    means, ends = state.means, state.ends
    means[:-1], ends[:-1] = means[1:], ends[1:]
    means[-1] = state.block.mean(axis=0)
    ends[-1] = state.block[-END_SAMPLES:].mean(axis=0)  # of one that is torn little is left
    state.in_block = 0
    state.blocks += 1
    state.waiting = [k for k, blocks in enumerate(WINDOWS) if state.blocks >= blocks and state.blocks % EACH[k] == 0]
    torque, speed, tension = means[-1]
    acceleration = (ends[-1, _SPEED] - ends[-2, _SPEED]) / limits.block_s
    pull = pull_n(limits.changes, torque, speed, acceleration).mean(axis=0)
    residual_n = tension - np.append(tension[1:], limits.balance.after_n) - pull
    differs_n = np.abs(residual_n - state.residual_n)
    state.residual_n = residual_n
    state.usual_n += np.where(np.isnan(differs_n), 0.0, differs_n - state.usual_n) / LEARNT_BLOCKS


def _look(limits: CellLimits, state: CellState, window: int) -> list[Finding]:
    """At one window, as it is unless it is short, and beside what was before it."""
    blocks = WINDOWS[window]
    now, change = state.means[-blocks:].mean(axis=0), state.ends[-1] - state.ends[-1 - blocks]
    window_s = blocks * limits.block_s
    noise_n = DEVIATIONS * _noise_n(limits, blocks) * np.maximum(state.usual_n / (CHANCE * _noise_n(limits, 1)), 1.0)
    # What is behind shows an earlier average: off by what has changed from one end of the window to the other.
    moved_n = np.abs(change[_TENSION])
    lag_n = limits.lag_s / window_s * (np.abs(change[_TORQUE]) / limits.radius_m + moved_n)
    lag_n[:-1] += limits.lag_s / window_s * moved_n[1:]
    acceleration = change[_SPEED] / window_s
    off_n = np.zeros(len(noise_n))
    if blocks >= STEADY:
        off_n = _off_n(limits, limits.balance, now, acceleration, noise_n, lag_n, BAND_SHARE + ZEROS_SHARE, GIVEN_SHARE)
    if state.blocks >= blocks + BEFORE:
        before, ends = state.means[-blocks - BEFORE : -blocks].mean(axis=0), state.ends[:, _SPEED]
        before_m_per_s = ends[-1 - blocks] - ends[-1 - blocks - BEFORE]
        acceleration = acceleration - before_m_per_s / (BEFORE * limits.block_s)
        creeping = np.minimum(np.abs(now[_SPEED]), np.abs(before[_SPEED])) < limits.balance.creeping_m_per_s
        lag_n += np.where(creeping, 2.0 * limits.balance.dry_n, 0.0)  # it may have turned round
        changed_n = _off_n(limits, limits.changes, now - before, acceleration, noise_n, lag_n, BAND_SHARE, CHANGE_SHARE)
        off_n = np.where(off_n == 0.0, changed_n, off_n)
    counts = state.beyond[window]
    counted = np.sign(off_n).astype(np.int64) * np.where(np.abs(off_n) > SURELY * limits.band_n, LOOKS[window], 1)
    counts[:] = np.where(counts * counted > 0, counts + counted, counted)
    if not np.count_nonzero(counts):
        return []
    needed = np.full(len(counts), LOOKS[window])
    needed[0] *= ALONE
    spans = np.flatnonzero(np.abs(counts) >= needed).tolist()
    shown_n = state.ends[-1, _TENSION]
    return [found(CODE, Action.BRAKE, span=i + 1, shown_n=shown_n.item(i), off_n=off_n.item(i)) for i in spans]


def _off_n(
    limits: CellLimits, balance: Balance, rows: FloatArray, acceleration: FloatArray, noise_n: FloatArray,
    lag_n: FloatArray, share: float, torque_share: float,
) -> FloatArray:  # fmt: skip
    """By how much each cell (n,) shows more than both rollers of its span allow, or less; 0: it may be right.

    `noise_n` and `lag_n` (n,) are what each roller may be off by; `share` of its band a cell may,
    and `torque_share` of its torque what a drive gives.
    """
    torque, speed, tension = rows
    tension = tension * limits.seen
    wider_n = lag_n + (torque_share - TORQUE_ERROR) * np.abs(torque) / limits.radius_m
    pull = pull_n(balance, torque, speed, acceleration) + np.array((-wider_n, wider_n))
    allowed_n = share * limits.band_n
    behind_n = tension - np.append(tension[1:], balance.after_n)
    # Of the roller at the span's end, then of the one before it, which has the opposite sign.
    most_n, least_n = behind_n - pull[1], pull[0] - behind_n
    at_end_n = np.maximum(noise_n, allowed_n)
    above_n, below_n = most_n - at_end_n, least_n - at_end_n
    at_begin_n = np.maximum(noise_n[:-1], allowed_n[1:])
    above_n[1:] = np.minimum(above_n[1:], least_n[:-1] - at_begin_n)
    below_n[1:] = np.minimum(below_n[1:], most_n[:-1] - at_begin_n)
    off_n = np.where(above_n > 0.0, above_n + allowed_n, np.where(below_n > 0.0, -below_n - allowed_n, 0.0))
    if len(off_n) > 1 and off_n[0] != 0.0:
        # As well cell 2 may be off by as much, the other way, unless roller 2 excludes that.
        by_one_n, left_n = (most_n[0], most_n[1]) if off_n[0] > 0.0 else (least_n[0], least_n[1])
        if not left_n + by_one_n > 0.0:
            off_n[0] = 0.0
    return off_n
