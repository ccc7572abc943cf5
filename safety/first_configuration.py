"""What speaks against a configuration that nobody has judged yet: a law that drives the web apart. Pure.

The monitor of a trial has something to go back to, and mostly a model. A first configuration has neither: of a law with
the wrong sign the web is torn in a tenth of a second. So it is judged by what it asks for. Symbols as in the paper:
x_i is the error of tension i, k_i = EA/L_i. What a torque more than that of the last moments, du, makes of it is

    x_i'' = k_i (R_i/J_i du_i - R_{i-1}/J_{i-1} du_{i-1})

Divergence. x_i grows, what is asked for makes it grow faster, and where both last for as long as a law takes to show
that it means it (`AHEAD_MOMENTS`) the tension leaves its band: x_i + x_i' t + x_i'' t^2/2. No law that is any good asks
for that for longer than its own dead time. Drives that do something else, and load cells that show something else, do
not look like this: there the law asks for the opposite.

Chattering. From period to period, what is asked for moves by several times what a torque may change by, and lies as far
from what is sent: that goes from one edge to the other, whatever the noise.
"""

from dataclasses import dataclass, field

import numpy as np

from gateway.core.line import Line
from gateway.core.line_limits import tension_bands_n, torque_limits_nm
from gateway.core.line_scales import line_scales
from gateway.core.signals import CountArray, FloatArray
from safety.actions import Action, Finding, found

AHEAD_MOMENTS = 4.0  #: that are looked ahead: two dead times, and as long for a torque to be taken back
LASTS_MOMENTS = 1.5  #: for so long it is so: longer than the delay in which a good law answers to the past
FLOOR_SHARE = 0.05  #: of the way to the edge of the band: noise is smaller
MEAN_MOMENTS = 10.0  #: time constant of the torque of the last moments
WINDOW_MOMENTS = 12.0
FAR = 6.0  #: moves that are so many times what a torque may change by in a period are asked for by no good law
MOST_COUNTED = 10.0  #: of either: what lies far from what is sent and stands still is no chattering


@dataclass(frozen=True, slots=True)
class FirstLimits:
    """Of one line. Arrays (n,). SI."""

    low_n: FloatArray
    high_n: FloatArray
    measured: FloatArray  #: 1.0 where a load cell measures the span
    torque_nm: FloatArray
    step_nm: float  #: by which a torque may change in a period
    ahead: float  #: periods
    reach_nm: float  #: by which it changes in half of them, at most
    stiffness_n_per_m: FloatArray
    lightness: FloatArray  #: R/J times the period squared
    lasts: int  #: periods
    forgets: float  #: share by which the mean follows, in a period
    window: int  #: periods


def first_limits(line: Line) -> FirstLimits:
    """What the guards of a first configuration need of `line`."""
    scales, period_s = line_scales(line), line.control.period_s
    low, high = tension_bands_n(line)
    step_nm = line.limits.torque_rate_nm_per_s * period_s
    ahead = AHEAD_MOMENTS * scales.moment_s / period_s
    radius = np.array([roller.radius_m.value for roller in line.rollers])
    inertia = np.array([roller.inertia_kg_m2.value for roller in line.rollers])
    length = np.array([span.length_m.value for span in line.spans])
    return FirstLimits(
        low_n=low, high_n=high, torque_nm=torque_limits_nm(line), step_nm=step_nm, ahead=ahead,
        measured=np.array([1.0 if span.control == "tension" else 0.0 for span in line.spans]),
        reach_nm=0.5 * ahead * step_nm, stiffness_n_per_m=line.web.stiffness_n.value / length,
        lightness=radius / inertia * period_s**2, lasts=max(2, scales.periods(LASTS_MOMENTS)),
        forgets=1.0 / max(1, scales.periods(MEAN_MOMENTS)), window=max(10, scales.periods(WINDOW_MOMENTS)),
    )  # fmt: skip


@dataclass(slots=True)
class FirstState:
    """Since the configuration was engaged."""

    mean_nm: FloatArray | None = None  #: (n,), what was sent in the last moments
    errors_n: list[FloatArray] = field(default_factory=list[FloatArray])  #: (n,) each, the newest last
    asked_nm: FloatArray | None = None  #: (n,), in the period before
    lasting: CountArray = field(default_factory=lambda: np.zeros(0, np.int64))  #: (n,), periods in a row
    #: (n,), periods in a row above the lower edge of the band; from the window's length on a span has been brought up
    above: CountArray = field(default_factory=lambda: np.zeros(0, np.int64))
    far: list[float] = field(default_factory=list[float])  #: of the window's periods
    far_sum: float = 0.0


def look_at_first(
    limits: FirstLimits,
    state: FirstState,
    tension_n: FloatArray,
    setpoint_n: FloatArray,
    asked_nm: FloatArray,
    sent_nm: FloatArray,
) -> list[Finding]:
    """A period's tensions and set-points (n,), the torque that the law asks for, and what was sent in the one before.

    Returns what speaks against the law: `first-diverges`, `first-chatters`.
    """
    error_n = limits.measured * (tension_n - setpoint_n)
    if state.mean_nm is None:
        state.mean_nm, state.errors_n, state.asked_nm = sent_nm.copy(), [error_n], asked_nm
        state.lasting = np.zeros(len(error_n), np.int64)
        state.above = np.where(tension_n >= limits.low_n, limits.window, 0)
        return []
    return _diverges(limits, state, tension_n, error_n, asked_nm, sent_nm) + _chatters(limits, state, asked_nm, sent_nm)


def _diverges(
    limits: FirstLimits,
    state: FirstState,
    tension_n: FloatArray,
    error_n: FloatArray,
    asked_nm: FloatArray,
    sent_nm: FloatArray,
) -> list[Finding]:
    assert state.mean_nm is not None
    before_n = state.errors_n
    rate_n = (error_n - before_n[0]) / len(before_n)  # a period
    before_n.append(error_n)
    if len(before_n) > 3:
        before_n.pop(0)
    setpoint_n = tension_n - error_n
    is_up = state.above >= limits.window
    near_n = FLOOR_SHARE * np.minimum(limits.high_n - setpoint_n, setpoint_n - limits.low_n).min()
    if np.abs(error_n).max() <= near_n:  # as nearly always: nothing is away from its set-point
        state.mean_nm = state.mean_nm + limits.forgets * (sent_nm - state.mean_nm)
        state.above = np.where(is_up | (tension_n >= limits.low_n), state.above + 1, 0)
        state.lasting.fill(0)
        return []
    reached_nm = np.minimum(np.maximum(asked_nm, sent_nm - limits.reach_nm), sent_nm + limits.reach_nm)
    reached_nm = np.minimum(np.maximum(reached_nm, -limits.torque_nm), limits.torque_nm)
    moved = limits.lightness * (reached_nm - state.mean_nm)
    state.mean_nm = state.mean_nm + limits.forgets * (sent_nm - state.mean_nm)
    pull_n = limits.stiffness_n_per_m * (moved - np.concatenate(((0.0,), moved[:-1])))  # a period squared
    ahead = limits.ahead
    leads_to_n = tension_n + limits.measured * (rate_n * ahead + 0.5 * pull_n * ahead**2)
    # What is still being brought up into the band cannot be too low.
    state.above = np.where(is_up | (tension_n >= limits.low_n), state.above + 1, 0)
    high, low = limits.high_n, np.where(is_up & (setpoint_n > limits.low_n), limits.low_n, -np.inf)
    way_n = np.where(error_n > 0.0, high - setpoint_n, setpoint_n - low)
    outward = (error_n * rate_n > 0.0) & (error_n * pull_n > 0.0) & (np.abs(error_n) > FLOOR_SHARE * way_n)
    state.lasting = np.where(outward & ((leads_to_n > high) | (leads_to_n < low)), state.lasting + 1, 0)
    i = int(state.lasting.argmax())
    if state.lasting[i] < limits.lasts:
        return []
    values = {"tension_n": float(tension_n[i]), "setpoint_n": float(setpoint_n[i]), "asked_nm": float(asked_nm[i])}
    return [found("first-diverges", Action.BRAKE, span=i + 1, roller=i + 1, **values)]


def _chatters(limits: FirstLimits, state: FirstState, asked_nm: FloatArray, sent_nm: FloatArray) -> list[Finding]:
    assert state.asked_nm is not None
    moved, beyond = np.abs(asked_nm - state.asked_nm).max(), np.abs(asked_nm - sent_nm).max()
    most_nm = MOST_COUNTED * limits.step_nm
    far = 0.5 * (min(float(moved), most_nm) + min(float(beyond), most_nm)) / limits.step_nm
    state.asked_nm = asked_nm
    state.far.append(far)
    state.far_sum += far
    if len(state.far) <= limits.window:
        return []
    state.far_sum -= state.far.pop(0)
    if state.far_sum < FAR * limits.window:
        return []
    share = state.far_sum / limits.window
    return [found("first-chatters", Action.BRAKE, times=share, periods=limits.window)]
