"""Tensioning: how fast a roller may turn and what torque it may have, until every span carries tension. Pure.

Symbols as in the paper: roller i pulls span i, m_i = J_i/R_i^2 is its mass at the web, k_i = EA/L_i the span's
stiffness, w the greatest surface speed of a roller in this stage (`[stages.tensioning]` of the line's file).

Speed. The torque that is sent stays within I_i + D_i (+-w - v_i), with D_i = J_i/(R_i tau) and I_i the torque that was
sent, passed through a lag: a speed controller with integral action that overrides whatever asks for more (external
reset). It needs no friction and no tension to be known, and gives way without a jump once the web holds the roller.

Torque. Beside that it stays within what the tension asked for explains, by the line's file at the edges of tolerance:

    -R_i S_{i+1} - width  to  R_i (T_i - S_{i+1}) + width
    width = share R_i max(T_i, T_{i+1}) + dry friction + (1 + share) f_i/R_i |v_i| + J_i/R_i w/ramp

with T the set-points now, S what load cells show of them (between 0 and T; without a cell: whichever allows more) and
v_i the roller's speed: a roller that is held gets nothing for a friction that it does not have.

Length. Roller i takes up x_i - x_{i-1} of span i, x being the way of a roller's surface. What of it is more than the
slack that may be there (`slack_max_m`) and than radii and strain leave open stretches the web, to k_i times that at
least. A span that ought to carry tension by that, and shows none, has no web, or its load cell does not see it.
"""

from dataclasses import dataclass, field

import numpy as np

from gateway.core.line import Line
from gateway.core.line_limits import tension_bands_n
from gateway.core.line_rules_process import TENSIONING_SPEED_MAX_M_PER_S, TENSIONING_SPEED_SHARE
from gateway.core.signals import BoolArray, CountArray, FloatArray, Inputs
from gateway.core.theta import NOISE_SHARE, expected_noise
from safety.actions import Action, Finding, found

#: Of the set-point: what a web that tightens would come to by the roller's momentum if nothing braked. The stage does:
#: what is left stays below the set-point.
CATCH_SHARE = 1.5
UNSEEN_SHARE = 0.5  #: of the greatest tension, for the same where no load cell sees the span
AIM_SHARE = 0.8  #: of that speed is aimed at: noise and overshoot have the rest
TRIP_FACTOR = 2.0  #: times that speed: torque goes off
TRIP_DEVIATIONS = 5.0  #: and by so many standard deviations of what is expected of encoders beyond it
TRIP_COUNTS = 2.0  #: and by so many of the drive's counts
LAG_DELAYS = 4.0  #: time constant of the speed limit, in delays of the loop
RESET_LAGS = 4.0  #: time constant of its integral action, in time constants of the limit
RAMP_LAGS = 4.0  #: in which a roller may come to its speed, in time constants of the limit
CARRIES = 0.3  #: of the set-point: the tension to which slack is taken up
ANSWERS = 0.5  #: of what is due: a span that shows less does not answer
TAKING_UP_SHARE = 0.5  #: of the speed limit, that web is taken up at on average, at least
SILENT_S = 0.3  #: for so long it has not answered, through load cells' filters and noise


@dataclass(frozen=True, slots=True)
class TensioningLimits:
    """Arrays (n,). SI."""

    speed_m_per_s: float  #: w
    period_s: float
    measured: BoolArray  #: a load cell measures the span
    # The speed limit
    speed_gain: FloatArray  #: D, Nm per m/s
    reset_share: float  #: by which I follows what was sent, in a period
    # What explains a torque
    radius_m: FloatArray
    share_m: FloatArray  #: share R, at its upper edge
    dry_nm: float
    friction_gain: FloatArray  #: (1 + share) f/R, at its upper edge, Nm per m/s
    friction_most: FloatArray  #: f/R, at its upper edge, Nm per m/s
    ramp_nm: FloatArray  #: J/R w/ramp
    # What the length of web explains
    stiffness_n_per_m: FloatArray  #: EA/L, at its lower edge
    slack_m: FloatArray
    stretch_m: FloatArray  #: of a span, at twice the greatest tension: no healthy one takes more up
    unsure: FloatArray  #: (n+1,), share of a way by which it may be off, the unwinder's first: radius and strain
    silent_periods: int
    tension_after_n: float


def tensioning_speed_m_per_s(line: Line) -> float:
    """The greatest surface speed of a roller while tensioning: as the line's file has it, else derived from it.

    At most a tenth of the line's speed, at most 0.1 m/s, and no more than what a web that tightens stands: a mass m
    that runs into a spring k at speed w comes to w sqrt(m k), or to w m k R^2/f where friction brakes it sooner, and
    to k w t more in the loop's delay t. Where no load cell sees it, a friction that is less than it may be adds to it.
    """
    given = line.stages.tensioning.roller_speed_max_m_per_s
    if given is not None:
        return given
    return min(greatest_tensioning_speed_m_per_s(line), float(_catch_speeds_m_per_s(line).min()))


def greatest_tensioning_speed_m_per_s(line: Line) -> float:
    """What the line's file may ask for at most."""
    return min(TENSIONING_SPEED_SHARE * line.limits.speed_max_m_per_s, TENSIONING_SPEED_MAX_M_PER_S)


def tensioning_trip_m_per_s(line: Line, count_m_per_s: float = 0.0) -> float:
    """The surface speed of a roller at which torque goes off while tensioning. No noise of an encoder comes to it.

    `count_m_per_s` is what a count of a drive's speed is worth at most.
    """
    speed = tensioning_speed_m_per_s(line)
    shown_m_per_s = TRIP_DEVIATIONS * expected_noise(line).speed_m_per_s + TRIP_COUNTS * count_m_per_s
    return max(TRIP_FACTOR * speed, speed + shown_m_per_s)


def delay_s(line: Line) -> float:
    """From a sample to what a torque that it causes has begun to change."""
    return line.control.latency_s + 2.0 * line.control.period_s


def lag_s(line: Line) -> float:
    """Time constant of the speed limit.

    It leaves the loop's delay its time, and the noise of encoders a share of what torque may change by in a period.
    """
    lever = max(roller.inertia_kg_m2.value / roller.radius_m.value for roller in line.rollers)
    noise_nm_s = lever * expected_noise(line).speed_m_per_s
    quiet_s = noise_nm_s / (NOISE_SHARE * line.limits.torque_rate_nm_per_s * line.control.period_s)
    return max(LAG_DELAYS * delay_s(line), quiet_s)


def _catch_speeds_m_per_s(line: Line) -> FloatArray:
    radius, inertia, friction = _roller_values(line)
    mass, stiffness = inertia / radius**2, line.web.stiffness_n.value / _lengths_m(line)
    lightest = np.array([roller.friction_nms_per_rad.tolerance for roller in line.rollers])
    braking = friction * (1.0 - lightest) / radius**2
    impedance: FloatArray = np.minimum(np.sqrt(mass * stiffness), mass * stiffness / braking)
    lowest_n = np.min([recipe.tension_n for recipe in line.recipes], axis=0)
    measured = np.array([span.control == "tension" for span in line.spans])
    # Where no load cell brakes it, all of that goes into the web, and what its friction may be less than is known too.
    wide = np.array([roller.radius_m.tolerance for roller in line.rollers])
    unsure = friction / radius**2 * ((1.0 + lightest) / (1.0 - wide) ** 2 - (1.0 - lightest) / (1.0 + wide) ** 2)
    most_n = np.where(measured, CATCH_SHARE * lowest_n, UNSEEN_SHARE * tension_bands_n(line)[1])
    return most_n / (impedance + stiffness * delay_s(line) + np.where(measured, 0.0, unsure))


def _roller_values(line: Line) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Radius, inertia and friction, (n,) each."""
    rollers = line.rollers
    return (
        np.array([roller.radius_m.value for roller in rollers]),
        np.array([roller.inertia_kg_m2.value for roller in rollers]),
        np.array([roller.friction_nms_per_rad.value for roller in rollers]),
    )


def _lengths_m(line: Line) -> FloatArray:
    return np.array([span.length_m.value for span in line.spans])


def tensioning_limits(line: Line) -> TensioningLimits:
    """The limits of `line` while it tensions its web."""
    speed, share, lag = tensioning_speed_m_per_s(line), line.stages.tensioning.torque_share, lag_s(line)
    radius, inertia, friction = _roller_values(line)
    wide = np.array([roller.radius_m.tolerance for roller in line.rollers])
    heavy = np.array([roller.inertia_kg_m2.tolerance for roller in line.rollers])
    rough = np.array([roller.friction_nms_per_rad.tolerance for roller in line.rollers])
    long = np.array([span.length_m.tolerance for span in line.spans])
    softest_n = line.web.stiffness_n.value * (1.0 - line.web.stiffness_n.tolerance)
    return TensioningLimits(
        speed_m_per_s=speed,
        period_s=line.control.period_s,
        measured=np.array([span.control == "tension" for span in line.spans]),
        speed_gain=inertia / (radius * lag),
        reset_share=min(1.0, line.control.period_s / (RESET_LAGS * lag)),
        radius_m=radius,
        share_m=share * radius * (1.0 + wide),
        dry_nm=line.gate.stress_coulomb_nm,
        friction_gain=(1.0 + share) * friction * (1.0 + rough) / (radius * (1.0 - wide)),
        friction_most=friction * (1.0 + rough) / (radius * (1.0 - wide)),
        ramp_nm=inertia * (1.0 + heavy) / (radius * (1.0 - wide)) * speed / (RAMP_LAGS * lag),
        stiffness_n_per_m=softest_n / (_lengths_m(line) * (1.0 + long)),
        stretch_m=2.0 * line.limits.tension_max_n * _lengths_m(line) * (1.0 + long) / softest_n,
        slack_m=np.array([span.slack_max_m for span in line.spans]),
        # What the PLC says of the unwinder is a speed of the web, and it stands.
        unsure=np.append(0.0, wide) + CARRIES * line.limits.tension_max_n / softest_n,
        silent_periods=max(1, round(SILENT_S / line.control.period_s)),
        tension_after_n=line.web.tension_after_n,
    )


def longest_tensioning_s(line: Line) -> float:
    """What a tensioning may take at most: with all the slack that may be there, at half of its speed."""
    return line.limits.tensioning_time_s + taking_up_s(tensioning_limits(line), np.full(line.n, np.inf))


def taking_up_s(limits: TensioningLimits, taken_up_m: FloatArray) -> float:
    """What so much web (n,) may have taken to be taken up; more than slack and stretch take no longer."""
    most_m = limits.slack_m + limits.stretch_m
    counted_m = np.minimum(np.maximum(taken_up_m, 0.0), most_m)
    return float(counted_m.sum()) / (TAKING_UP_SHARE * limits.speed_m_per_s)


@dataclass(slots=True)
class TensioningState:
    """Of one tensioning. Arrays (n,), empty before it has begun."""

    first_tension_n: FloatArray = field(default_factory=lambda: np.zeros(0))  #: shown when it began
    way_m: FloatArray = field(default_factory=lambda: np.zeros(0))  #: (n+1,), of the unwinder's surface, then rollers'
    silent: CountArray = field(default_factory=lambda: np.zeros(0, np.int64))  #: periods in a row without an answer
    sent_nm: FloatArray = field(default_factory=lambda: np.zeros(0))  #: I: the torque that was sent, through a lag


def begin_tensioning(state: TensioningState, inputs: Inputs) -> None:
    """The drives have taken over, at zero torque; the web is as it is."""
    state.first_tension_n = inputs.tension.value.copy()
    state.way_m = np.zeros(inputs.n + 1)
    state.silent = np.zeros(inputs.n, np.int64)
    state.sent_nm = np.zeros(inputs.n)


def taken_up_m(state: TensioningState) -> FloatArray:
    """The length of web (n,) that each span's roller has taken up since tensioning began."""
    return np.diff(state.way_m)


def watch_spans(
    limits: TensioningLimits, state: TensioningState, inputs: Inputs, target_n: FloatArray
) -> list[Finding]:
    """A period's way of every roller, and the spans that do not answer to the length that was taken up.

    `target_n` (n,) are the set-points that tensioning leads to. Speeds that did not come count as the last ones.
    """
    way = state.way_m
    way[0] += limits.period_s * inputs.unwind_speed.value[0]
    way[1:] += limits.period_s * inputs.speed.value
    stretch_m = surely_stretched_m(limits, state)
    if not np.count_nonzero(stretch_m > 0.0):
        state.silent.fill(0)
        return []
    due_n = limits.stiffness_n_per_m * np.maximum(stretch_m, 0.0)
    risen_n = inputs.tension.value - state.first_tension_n
    # What the stage's own torque could hold at most is no sign of a missing web where nobody measures tension.
    held_n = 2.0 * (target_n + limits.dry_nm / limits.radius_m)
    needed_n = np.minimum(target_n - state.first_tension_n, CARRIES * target_n)
    slack = (needed_n >= (1.0 - ANSWERS) * CARRIES * target_n) & (due_n >= needed_n) & (risen_n < ANSWERS * needed_n)
    silent = np.where(limits.measured, slack, due_n >= held_n)
    state.silent = np.where(silent, state.silent + 1, 0)
    taken_m = taken_up_m(state)
    return [
        _no_web(limits, i, float(taken_m[i]), float(inputs.tension.value[i]))
        for i in np.flatnonzero(state.silent >= limits.silent_periods).tolist()
    ]


def surely_stretched_m(limits: TensioningLimits, state: TensioningState) -> FloatArray:
    """Length (n,) that was taken up beyond the slack that may be there, whatever radii and strain leave open."""
    unsure_m = limits.unsure * np.abs(state.way_m)
    return taken_up_m(state) - unsure_m[1:] - unsure_m[:-1] - limits.slack_m


def _no_web(limits: TensioningLimits, i: int, taken_up: float, tension_n: float) -> Finding:
    if limits.measured[i]:
        return found("no-web", Action.TORQUE_OFF, span=i + 1, taken_up_m=taken_up, tension_n=tension_n)
    return found("no-web-unmeasured", Action.TORQUE_OFF, span=i + 1, taken_up_m=taken_up)


def limit_tensioning_torque(
    limits: TensioningLimits, state: TensioningState, asked_nm: FloatArray, inputs: Inputs, setpoint_n: FloatArray
) -> FloatArray:
    """The torque (n,) nearest to `asked_nm` that keeps a roller's speed and what its tension explains.

    `setpoint_n` (n,) are the tensions asked for now. `asked_nm` must be finite.
    """
    reach, speed = AIM_SHARE * limits.speed_m_per_s, inputs.speed.value
    low = state.sent_nm - limits.speed_gain * (reach + speed)
    high = state.sent_nm + limits.speed_gain * (reach - speed)
    torque: FloatArray = np.minimum(np.maximum(asked_nm, low), high)
    low, high = explained_torque_nm(limits, inputs, setpoint_n)
    return np.minimum(np.maximum(torque, low), high)


def explained_torque_nm(
    limits: TensioningLimits, inputs: Inputs, setpoint_n: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """The least and the greatest torque (n,) that the tensions asked for, `setpoint_n` (n,), explain."""
    behind_n = np.append(setpoint_n[1:], limits.tension_after_n)
    shown_n = np.minimum(np.maximum(inputs.tension.value, 0.0), setpoint_n)
    least_n = np.append(np.where(limits.measured, shown_n, 0.0)[1:], limits.tension_after_n)
    most_n = np.append(np.where(limits.measured, shown_n, setpoint_n)[1:], limits.tension_after_n)
    width = (
        limits.share_m * np.maximum(setpoint_n, behind_n)
        + limits.dry_nm
        + limits.friction_gain * np.abs(inputs.speed.value)
        + limits.ramp_nm
    )
    return -limits.radius_m * most_n - width, limits.radius_m * (setpoint_n - least_n) + width


def note_sent(limits: TensioningLimits, state: TensioningState, torque_nm: FloatArray) -> None:
    """The torque (n,) that was sent in this period."""
    state.sent_nm += limits.reset_share * (torque_nm - state.sent_nm)
