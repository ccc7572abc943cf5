"""Spans without a load cell: their tension as torques and speeds have it, against the band in every period. Pure.

The estimate is an interval (`gateway.core.tension_estimate`). Only where all of it lies outside the band is something
found: what may be inside stops no line.

That tells a break only where tolerances and dry friction leave nothing of the band. A break is a fall, and of a change
far more is known: it is found where a span has for certain lost a good part of its set-point within moments, against
what was before. Set-points that move, and what noise may make of it, are no fall.
"""

from dataclasses import dataclass, field

import numpy as np

from gateway.core.line import Line
from gateway.core.signals import BoolArray, CountArray, FloatArray, Inputs, Quality
from gateway.core.tension_estimate import (
    MEAN_PERIODS,
    Balance,
    balance_of,
    changes_of,
    estimate_n,
    fall_noise_n,
    least_fall_n,
    pull_n,
)
from safety.actions import Action, Finding, found
from safety.envelope import limit_of
from safety.limits import EnvelopeLimits

_GOOD = int(Quality.GOOD)

BEFORE_PERIODS = 200  #: that what was before is averaged over
CONFIRMED_PERIODS = 10  #: outside in a row


@dataclass(frozen=True)
class EstimateLimits:
    balance: Balance
    tension_min_n: float | FloatArray  #: (n,) where spans have limits of their own
    tension_max_n: float | FloatArray
    period_s: float
    changes: Balance
    noise_n: FloatArray  #: (n,), that a fall may be of noise


def estimate_limits(line: Line, limits: EnvelopeLimits) -> EstimateLimits | None:
    """None: every span has a load cell, and there is nothing to estimate."""
    balance = balance_of(line)
    if not (balance.estimated | balance.indicated).any():
        return None
    return EstimateLimits(
        balance, limits.tension_min_n, limits.tension_max_n, limits.period_s, changes_of(balance),
        fall_noise_n(line, balance),
    )  # fmt: skip


@dataclass(slots=True)
class EstimateState:
    """Averages, and how long each span has been outside, or has lost its tension. Arrays (n,)."""

    means: FloatArray | None = None  #: (4, n): torques, speeds, tensions, set-points
    twice: FloatArray | None = None  #: (5, n): the same and accelerations, averaged once more
    before: FloatArray | None = None  #: (5, n): the same over longer
    outside: CountArray = field(default_factory=lambda: np.zeros(0, np.int64))
    fallen: CountArray = field(default_factory=lambda: np.zeros(0, np.int64))


def find_estimated(
    limits: EstimateLimits,
    state: EstimateState,
    inputs: Inputs,
    applied_nm: FloatArray,
    set_n: FloatArray,
    *,
    floor: bool,
) -> list[Finding]:
    """What stops the line, from the samples of a period that are all good, and the torques (n,) that acted meanwhile.

    `set_n` (n,) are the set-points of the tensions.

    `floor`: the web has been tensioned, and no span may be below the band. `state` is brought up to date.
    """
    silent = limits.balance.indicated & (inputs.tension.quality != _GOOD)
    estimated = limits.balance.estimated | silent
    judged = limits.balance.estimated | limits.balance.indicated
    before_n = 0.0 if state.means is None else state.means[2]
    now = np.array([applied_nm, inputs.speed.value, np.where(estimated, before_n, inputs.tension.value), set_n])
    if state.means is None:
        state.means = now
        state.outside, state.fallen = np.zeros((2, inputs.n), np.int64)
        return []
    before, state.means = state.means, state.means + (now - state.means) / MEAN_PERIODS
    state.means[3] = set_n  # it has no noise, and no lag
    torque, speed, tension, _ = state.means
    acceleration = (speed - before[1]) / limits.period_s
    pull = pull_n(limits.balance, torque, speed, acceleration)
    least, most = estimate_n(limits.balance, tension, pull, estimated)
    outside = judged & ((least > limits.tension_max_n) | (floor & (most < limits.tension_min_n)))
    state.outside = np.where(outside, state.outside + 1, 0)
    fall_n = _fall_n(limits, state, np.vstack((state.means, acceleration)), estimated, floor)
    if not (np.count_nonzero(state.outside) or np.count_nonzero(state.fallen)):
        return []
    broken = np.flatnonzero(state.fallen >= CONFIRMED_PERIODS).tolist()
    found_ = [_broken(i, fall_n[i], set_n[i]) for i in broken]
    outside_ = np.flatnonzero(state.outside >= CONFIRMED_PERIODS).tolist()
    return found_ + [_finding(limits, i, least[i], most[i]) for i in outside_]


def steady_n(limits: EstimateLimits, state: EstimateState) -> FloatArray | None:
    """The least and the most (2, n) that each tension may be, without the noise of single samples; None: not known yet.

    Of averages of averages: it lags by twice MEAN_PERIODS. A load cell that only shows is not relied on: nobody looks
    whether it stands still.
    """
    if state.twice is None:
        return None
    balance, (torque, speed, tension, _, acceleration) = limits.balance, state.twice
    unseen = balance.estimated | balance.indicated
    return estimate_n(balance, tension, pull_n(balance, torque, speed, acceleration), unseen)


def _fall_n(
    limits: EstimateLimits, state: EstimateState, now: FloatArray, estimated: BoolArray, floor: bool
) -> FloatArray:
    """What each span (n,) has for certain lost against what was before; counts where that is a break.

    `now` (5, n) are the averages, and accelerations as noisy as the difference of two samples.
    """
    state.twice = now if state.twice is None else state.twice + (now - state.twice) / MEAN_PERIODS
    state.twice[3] = now[3]
    now = state.twice
    if state.before is None or not floor:
        state.before = now
    change = now - state.before
    if not np.count_nonzero(state.fallen):  # else a fall that is looked at would become what was before
        state.before = state.before + change / BEFORE_PERIODS
    torque, speed, tension, set_n, acceleration = change
    pull = pull_n(limits.changes, torque, speed, acceleration)
    fall_n: FloatArray = -estimate_n(limits.changes, tension, pull, estimated)[1]
    before_n = np.maximum(now[3], state.before[3])
    least_n = least_fall_n(before_n, limits.tension_min_n, limits.noise_n) + float(np.abs(set_n).sum())
    state.fallen = np.where(estimated & floor & (fall_n > least_n), state.fallen + 1, 0)
    return fall_n


def _broken(i: int, fall_n: float, set_n: float) -> Finding:
    return found("web-break-estimated", Action.BRAKE, span=i + 1, fall_n=fall_n, set_n=set_n)


def _finding(limits: EstimateLimits, i: int, least_n: float, most_n: float) -> Finding:
    slack = most_n < limit_of(limits.tension_min_n, i)  # as where a load cell sees it
    return found(
        "tension-estimated",
        Action.BRAKE if slack else Action.STOP,
        span=i + 1,
        least_n=least_n,
        most_n=most_n,
        low_n=limit_of(limits.tension_min_n, i),
        high_n=limit_of(limits.tension_max_n, i),
    )
