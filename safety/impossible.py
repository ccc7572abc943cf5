"""Tensions and torques that cannot be true: what web, rollers, drives and noise cannot have done in a period. Pure.

From one sample to the next, eq. web_tension_dynamics lets a tension move by

    |dT_i| <= dt (EA/L_i |v_i - v_{i-1}| + |T_{i-1} v_{i-1} - T_i v_i| / L_i)

with parameters anywhere in their tolerances, and the speeds that were measured, what may be wrong in them, and how far
they went of late: load cells have filters. What goes further was never there: a word torn in two, a counter that
wrapped, a byte swapped, a unit that changed. It is not used; the last believed value stays.

Only a web that tears, or runs slack, may do what speeds do not show, and it does so in one direction: a fall that the
next sample confirms, by falling on or by lying below the band, is believed. So is, on the second sample, what is
possible and yet more than half of the band: on a stiff web that is anything.

A torque lies between nothing and what was asked for of late; what does not is believed if the next sample says the
same: then the drive does give it, which is for others to judge.
"""

from dataclasses import dataclass, field
from math import sqrt

import numpy as np

from gateway.core.line import Line
from gateway.core.line_limits import tension_bands_n, torque_limits_nm
from gateway.core.line_scales import line_scales
from gateway.core.signals import BoolArray, Channel, CountArray, FloatArray, Inputs, Quality
from gateway.core.theta import expected_noise
from safety.rejections import Impossible

MARGIN = 2.0  #: times what the equation allows: it is linear, and a web is not
CHANGE = 2.0  #: small tensions that a load cell may show more or less without any cause
USUAL = 10.0  #: times its usual change, where that is more: eight standard deviations of its noise
LEARNT_PERIODS = 256.0  #: that the usual change is the mean of, about
SURE = 5.0 * sqrt(2.0)  #: standard deviations of a speed, by which a difference of two may be wrong
MOST_AT_ONCE = 0.5  #: of the tension band: a larger change needs a second sample that says so
FILTERED_MOMENTS = 15.0  #: for which a load cell's filter may still show what speeds did
TORQUE_NOISE = 0.25  #: of the torque limit, by which a drive may report another torque than any that was asked for
LAGGING_MOMENTS = 5.0  #: for which a torque that was asked for may still be on its way
_GOOD, _MISSING = int(Quality.GOOD), int(Quality.MISSING)


@dataclass(frozen=True, slots=True)
class ValueLimits:
    """What samples of a line can do in a period. Arrays (n,)."""

    per_speed_n: FloatArray  #: N per m/s of difference between the rollers of the span
    free_n: FloatArray  #: whatever the speeds
    change_n: FloatArray  #: of two samples together, without any cause
    at_once_n: FloatArray  #: more needs a second sample that says so
    tension_min_n: FloatArray
    unseen_m_per_s: FloatArray  #: that a roller may change its speed by in a period without a sample
    torque_nm: FloatArray  #: by which a drive may report another torque than was asked for
    window: int  #: periods in which a load cell still shows what speeds did
    asked: int  #: periods in which what was asked of a drive may be under way


def value_limits(line: Line, speed_steps_m_per_s: FloatArray) -> ValueLimits:
    """Of `line`. `speed_steps_m_per_s` (n,) is what a count of each drive's speed is worth."""
    scales, limits, n = line_scales(line), line.limits, line.n
    stiffness = line.web.stiffness_n
    length_m = np.array([span.length_m.value * (1.0 - span.length_m.tolerance) for span in line.spans])
    radius_m = np.array([r.radius_m.value * (1.0 + r.radius_m.tolerance) for r in line.rollers])
    inertia = np.array([r.inertia_kg_m2.value * (1.0 - r.inertia_kg_m2.tolerance) for r in line.rollers])
    stretch_n_per_m = stiffness.value * (1.0 + stiffness.tolerance) / length_m
    per_speed_n = MARGIN * scales.period_s * stretch_n_per_m
    both_m_per_s = speed_steps_m_per_s + np.concatenate(([0.0], speed_steps_m_per_s[:-1]))
    wrong_m_per_s = SURE * expected_noise(line).speed_m_per_s + both_m_per_s
    # A roller out of round takes up and gives out web that its speed does not show; so does the one before it.
    wrong_m_per_s += 2.0 * line.gate.stress_eccentricity * limits.speed_max_m_per_s
    carried_n = MARGIN * scales.period_s * limits.tension_max_n * limits.speed_max_m_per_s / length_m
    low_n, high_n = tension_bands_n(line)
    torque_nm = torque_limits_nm(line)
    acceleration_m_per_s2 = radius_m / inertia * (torque_nm + radius_m * limits.tension_max_n)
    return ValueLimits(
        per_speed_n=per_speed_n,
        free_n=per_speed_n * wrong_m_per_s + carried_n,
        change_n=np.full(n, CHANGE * scales.tension_n),
        at_once_n=MOST_AT_ONCE * (high_n - low_n),
        tension_min_n=low_n,
        unseen_m_per_s=acceleration_m_per_s2 * scales.period_s,
        torque_nm=TORQUE_NOISE * torque_nm,
        window=scales.periods(FILTERED_MOMENTS),
        asked=scales.periods(LAGGING_MOMENTS),
    )


@dataclass(slots=True)
class ValueState:
    """What was believed last. Arrays (n,) unless said otherwise; empty before the first sample."""

    period: int = 0
    tension_n: FloatArray = field(default_factory=lambda: np.zeros(0))  #: believed
    believed: CountArray = field(default_factory=lambda: np.zeros(0, np.int64))  #: when
    usual_n: FloatArray = field(default_factory=lambda: np.zeros(0))  #: of its changes
    doubted_n: FloatArray = field(default_factory=lambda: np.zeros(0))  #: not believed in the period before; NaN: was
    possible: BoolArray = field(default_factory=lambda: np.zeros(0, np.bool_))  #: though it could have been
    falling: BoolArray = field(default_factory=lambda: np.zeros(0, np.bool_))  #: further than speeds show, and believed
    #: (n + 1,), the unwinder's first; room for the next; and by how much they have changed
    speed_m_per_s: FloatArray = field(default_factory=lambda: np.zeros(0))
    spare_m_per_s: FloatArray = field(default_factory=lambda: np.zeros(0))
    moved_m_per_s: FloatArray = field(default_factory=lambda: np.zeros(0))
    apart_m_per_s: FloatArray = field(default_factory=lambda: np.zeros((0, 0)))  #: (window, n), of a span's rollers
    asked_nm: FloatArray = field(default_factory=lambda: np.zeros((0, 0)))  #: (asked, n)
    heard: bool = False  #: every load cell, in an earlier period
    torque_nm: FloatArray = field(default_factory=lambda: np.zeros(0))  #: believed
    doubted_nm: FloatArray = field(default_factory=lambda: np.zeros(0))  #: as of tensions
    confirmed: list[tuple[str, int]] = field(default_factory=list[tuple[str, int]])  #: whose doubted sample was true


def begin(limits: ValueLimits, state: ValueState, inputs: Inputs, asked_nm: FloatArray) -> None:
    """What is measured now is believed: control has just taken over."""
    n = inputs.n
    state.period, state.heard = 0, False
    state.tension_n = inputs.tension.value.copy()
    state.believed = np.zeros(n, np.int64)
    state.usual_n = np.zeros(n)
    state.doubted_n = np.full(n, np.nan)
    state.possible, state.falling = np.zeros(n, np.bool_), np.zeros(n, np.bool_)
    state.speed_m_per_s = np.concatenate((inputs.unwind_speed.value, inputs.speed.value))
    state.spare_m_per_s, state.moved_m_per_s = np.zeros(n + 1), np.zeros(n + 1)
    state.apart_m_per_s = np.zeros((limits.window, n))
    state.asked_nm = np.tile(asked_nm, (limits.asked, 1))
    state.torque_nm, state.doubted_nm = inputs.torque.value.copy(), np.full(n, np.nan)


def reject_impossible(
    limits: ValueLimits, state: ValueState, inputs: Inputs, request_m_per_s: float, asked_nm: FloatArray
) -> list[Impossible]:
    """Mark tensions and torques that cannot be as BAD, with the last believed value; returns them.

    `request_m_per_s`: the unwinder's speed that was asked for last; `asked_nm` (n,): the torques. Once a period, after
    the speeds have been looked at; `state` is brought up to date.
    """
    if len(state.tension_n) != inputs.n:
        begin(limits, state, inputs, asked_nm)
    state.period += 1
    state.confirmed.clear()
    _take_in_speeds(limits, state, inputs, request_m_per_s)
    state.asked_nm[state.period % limits.asked] = asked_nm
    return [*_tensions(limits, state, inputs.tension), *_torques(limits, state, inputs.torque, asked_nm)]


def _take_in_speeds(limits: ValueLimits, state: ValueState, inputs: Inputs, request_m_per_s: float) -> None:
    """By how much the rollers of each span may have gone apart in this period, whenever in it they were measured."""
    speed, before, moved = state.spare_m_per_s, state.speed_m_per_s, state.moved_m_per_s
    speed[0], speed[1:] = inputs.unwind_speed.value[0], inputs.speed.value
    np.abs(np.subtract(speed, before, out=moved), out=moved)
    # A line PLC that steps has gone there before it says so.
    asked_m_per_s = abs(request_m_per_s - speed.item(0))
    if asked_m_per_s > moved.item(0):
        moved[0] = asked_m_per_s
    if not (inputs.speed.good() and inputs.unwind_speed.good()):
        if not inputs.unwind_speed.good():  # where it is not believed that it stands already, its web may
            moved[0] = max(moved.item(0), abs(speed.item(0)))
        moved[1:] += np.where(inputs.speed.quality == _GOOD, 0.0, limits.unseen_m_per_s)
    apart = state.apart_m_per_s[state.period % limits.window]
    np.abs(np.subtract(speed[1:], speed[:-1], out=apart), out=apart)
    apart += moved[1:]
    apart += moved[:-1]
    state.speed_m_per_s, state.spare_m_per_s = speed, before


def _tensions(limits: ValueLimits, state: ValueState, tension: Channel) -> list[Impossible]:
    value_n = tension.value
    change_n = np.abs(value_n - state.tension_n)  # NaN without a load cell, or an earlier sample: nothing is beyond it
    if not np.count_nonzero(change_n > limits.change_n):
        state.doubted_n.fill(np.nan)
        state.falling.fill(False)
        _believe(state, tension, change_n)
        return []
    allowed_n = np.maximum(limits.change_n, USUAL * state.usual_n)
    elapsed = state.period - state.believed
    # Of `fmax`: a speed that is no number says nothing; others do.
    apart = np.fmax.reduce(state.apart_m_per_s, axis=0)
    reach_n = (limits.per_speed_n * apart + limits.free_n) * elapsed + allowed_n
    good = tension.quality == _GOOD
    possible = change_n <= reach_n
    doubtful = good & (change_n > np.minimum(reach_n, limits.at_once_n + allowed_n))
    # One period more, from the sample before that was not believed: NaN where it was.
    on_n = value_n - state.doubted_n
    stays = state.possible & (np.abs(on_n) <= reach_n)
    below = np.maximum(state.doubted_n, value_n) < state.tension_n - limits.change_n
    falls = below & ((value_n < limits.tension_min_n) | (on_n < -allowed_n))
    falls |= state.falling & (value_n < state.tension_n)
    rejected = doubtful & ~stays & ~falls
    state.falling = doubtful & falls
    # NaN where the sample before was believed: nothing is nearer to it.
    _confirm(state, "tension", good & ~rejected & (np.abs(on_n) < change_n))
    found = [
        Impossible("tension", i + 1, value_n.item(i), float(state.tension_n[i] - reach_n[i]),
                   float(state.tension_n[i] + reach_n[i]), "N", confirmable=True)
        for i in np.flatnonzero(rejected).tolist()
    ]  # fmt: skip
    state.doubted_n = np.where(rejected, value_n, np.nan)
    state.possible = possible & rejected
    for i in np.flatnonzero(rejected).tolist():
        tension.reject(i)
        value_n[i] = state.tension_n[i]
        change_n[i] = np.nan
    _believe(state, tension, change_n)
    return found


def _confirm(state: ValueState, channel: str, which: BoolArray) -> None:
    if which.any():
        state.confirmed += [(channel, i + 1) for i in np.flatnonzero(which).tolist()]


def _believe(state: ValueState, tension: Channel, change_n: FloatArray) -> None:
    """What is left of this period's samples is true, and teaches how a load cell usually changes."""
    if tension.good():
        state.believed.fill(state.period)
    else:
        good = tension.quality == _GOOD
        state.believed[good] = state.period
        change_n = np.where(good & np.isfinite(change_n), change_n, state.usual_n)
    state.tension_n[:] = tension.value
    if state.heard:
        change_n -= state.usual_n
        change_n /= LEARNT_PERIODS
        state.usual_n += change_n
    else:  # a change from nothing is none
        state.heard = not np.isnan(state.tension_n[tension.quality != _MISSING]).any()


def _torques(limits: ValueLimits, state: ValueState, torque: Channel, asked_nm: FloatArray) -> list[Impossible]:
    value_nm = torque.value
    if not np.count_nonzero(np.abs(value_nm - asked_nm) > limits.torque_nm):  # NaN: a drive that reports none
        state.torque_nm[:] = value_nm
        return []
    low_nm = np.minimum(state.asked_nm.min(axis=0), 0.0) - limits.torque_nm
    high_nm = np.maximum(state.asked_nm.max(axis=0), 0.0) + limits.torque_nm
    outside = (torque.quality == _GOOD) & ((value_nm < low_nm) | (value_nm > high_nm))
    # What a drive reports twice it gives; and where it was a period before, it may still be.
    before = np.abs(value_nm - state.torque_nm) <= limits.torque_nm
    again = np.abs(value_nm - state.doubted_nm) <= limits.torque_nm
    rejected = outside & ~before & ~again
    _confirm(state, "torque", outside & again)
    found = [
        Impossible("torque", i + 1, value_nm.item(i), float(low_nm[i]), float(high_nm[i]), "Nm", confirmable=True)
        for i in np.flatnonzero(rejected).tolist()
    ]
    state.doubted_nm = np.where(rejected, value_nm, np.nan)
    for i in np.flatnonzero(rejected).tolist():
        torque.reject(i)
        value_nm[i] = state.torque_nm[i]
    state.torque_nm[:] = value_nm
    return found
