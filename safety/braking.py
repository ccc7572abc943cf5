"""After a web break: every roller with a brake is slowed down on its own speed, on a ramp that all rollers keep. Pure.

Rollers between which the web is whole must slow down alike: one that brakes harder than its neighbour pulls the web
against it. So there is one ramp for all that the web may tie together, no steeper than the weakest of them follows at
the worst of its tolerances (`gateway.core.braking`), and each roller holds to it by its own speed alone:

    u = J a/R - f |v|/R + J/(R tau) (|v| - v_ramp),    -f_least |v|/R <= u <= B(v),  |u| <= J |v|/(R t_end)

against the motion, with |v| and v_ramp smoothed alike. A roller whose friction alone would stop it sooner is driven
against its friction, and no more: standing, it would be a brake that the web pulls at. f_least is the least of its
tolerance, so that no drive makes a roller faster whatever its friction is. u vanishes with the speed, so that nothing
is turned back: t_end is longer than a torque takes to act, and J in it at the least of its tolerance.

A ramp does not stay above all of its rollers: where friction slows them down faster than it falls, it comes down to the
fastest of them, and the unwinder's request follows as steeply as anything is slowed down.

Where the rollers at both ends of a span without tension run apart, the web has broken there, and the rollers behind it
are a group of their own with a ramp of their own: no web ties them to the unwinder. The rollers ahead of it never run
faster than the unwinder does.

Where a controlled stop cannot go on at speed (a load cell or an encoder is lost, the unwinder does not slow down, the
law has failed) the web is whole, and braked the same way. A load cell that says nothing from the beginning on is not
relied on: what it said last gives neither room nor way.

A brake is released where it could hurt, until a person arms: of a roller that becomes faster while it is braked (its
drive is wired the wrong way round), whose speed is not known, whose drive has left, or whose DC link is full; of the
rollers that are tied to an unwinder whose speed is not known. A span near its limit is not pulled at: what is ahead of
it brakes less, and both rollers of a span that is pulled beyond its set-point give way by half of that. Nothing is
gained there by taking torque off: what coasts pulls the web against what stops.
"""

from collections.abc import Iterator
from dataclasses import dataclass, field

import numpy as np

from gateway.core.braking import Brakes, brakes_of, braking_torque_nm, deceleration_m_per_s2
from gateway.core.line import Line
from gateway.core.line_scales import line_scales
from gateway.core.signals import BoolArray, CountArray, FloatArray, Inputs, Quality
from safety.actions import Action, Finding, found
from safety.envelope import PARTING, limit_of, parted
from safety.limits import EnvelopeLimits

FOLLOWS_MOMENTS = 15.0  #: tau: in this time a roller comes back to its ramp; shorter would shake the web
EVENED = 0.5  #: of what a span pulls beyond its set-point, by which both of its rollers give way
LEAST_SHARE = 0.2  #: of a ramp that is kept in any case
OUTWEIGHED = 0.25  #: of that feedback, that friction which may not be there may take of it
STILL_MOMENTS = 25.0  #: for so long everything that is braked has stood: until then the brakes damp what swings
END_PERIODS = 8  #: t_end: no torque stops what turns in less
SMOOTH_PERIODS = 10  #: that a measured speed is averaged over: what the web swings with is not fed back
SMOOTHED = 3.0  #: times that: tau, at least, for what is fed back is as late
NOTICED = 0.02  #: of the speed at the beginning: what a brake must have done until its sign is judged
BACKWARDS = 0.25  #: of what a brake should have done, the other way
LATE_PERIODS = 3.0  #: by which a torque may act later than it is taken to
WEB_ERROR = 0.4  #: of what the web has done, by which that may be misjudged
RESTS = 0.005  #: of the greatest speed: what is slower stands
CONFIRMED = 2  #: periods in a row: one sample may be a spike
_GOOD = int(Quality.GOOD)


@dataclass(frozen=True)
class BrakingLimits:
    brakes: Brakes
    tension_min_n: float | FloatArray  #: (n,) where spans have limits of their own
    tension_max_n: float | FloatArray
    measured: BoolArray  #: (n,)
    hold_periods: int  #: without a speed until a brake is released
    period_s: float
    follows_s: float  #: tau
    still_periods: int  #: in which nothing that is braked has turned, until the stop is over

    @property
    def rests_m_per_s(self) -> float:
        """What is slower stands."""
        return RESTS * self.brakes.speed_max_m_per_s


def braking_limits(line: Line, limits: EnvelopeLimits) -> BrakingLimits:
    """How `line` is braked."""
    scales = line_scales(line)
    return BrakingLimits(
        brakes=brakes_of(line),
        tension_min_n=limits.tension_min_n,
        tension_max_n=limits.tension_max_n,
        measured=limits.measured > 0.0,
        hold_periods=limits.hold_periods,
        period_s=limits.period_s,
        follows_s=max(FOLLOWS_MOMENTS * scales.moment_s, SMOOTHED * SMOOTH_PERIODS * limits.period_s),
        still_periods=scales.periods(STILL_MOMENTS),
    )


@dataclass(slots=True)
class BrakingState:
    """Of one stop. Arrays (n,)."""

    speed_m_per_s: FloatArray  #: smoothed
    unwind_speed_m_per_s: float  #: the same of the unwinder
    ramp_m_per_s: FloatArray  #: (2,), of what is tied to the unwinder; of what is behind a break
    smooth_ramp_m_per_s: FloatArray  #: (2,), as late as the smoothed speeds are
    asked_m_per_s: float  #: of the unwinder
    relieved_n: FloatArray  #: tension of each span from which on what is ahead of it brakes less
    begun_m_per_s: FloatArray  #: speeds at the beginning
    by_brake_m_per_s: FloatArray  #: by how much each should be slower since, as its torque has it
    late_m_per_s: FloatArray  #: by how much that may be off because torques act later
    by_web_m_per_s: FloatArray  #: and as web and friction have it
    by_web_most_m_per_s: FloatArray  #: the same, every period's magnitude
    set_n: FloatArray  #: tension set-points, (n,)
    energy_j: FloatArray  #: that each DC link still takes
    begun_at_m_per_s: float
    silent: BoolArray  #: spans (n,) of whose tension nothing has been heard since before the beginning
    broken_at: int = 0  #: rollers from here on (counted from 0) are behind a break; n: none is known
    released: BoolArray = field(default_factory=lambda: np.zeros(0, np.bool_))  #: brakes
    unknown: CountArray = field(default_factory=lambda: np.zeros(0, np.int64))  #: periods without a speed
    blind: int = 0  #: periods without the unwinder's speed
    apart: CountArray = field(default_factory=lambda: np.zeros(0, np.int64))  #: periods without tension, speeds parted
    still: int = 0  #: periods in which nothing that is braked has turned
    again: int = 0  #: periods in which the broken span carried tension


@dataclass(frozen=True, slots=True)
class Braking:
    """What a period of it asks for."""

    torque_nm: FloatArray  #: (n,), before limits of rate
    released: BoolArray  #: (n,), rollers whose torque goes to zero
    unwind_speed_m_per_s: float  #: to be asked of the line PLC
    over: bool  #: everything that is braked stands, and the unwinder is asked for no speed
    findings: list[Finding]  #: what is new


def begin(
    limits: BrakingLimits,
    inputs: Inputs,
    request_m_per_s: float,
    tension_n: FloatArray,
    lost: BoolArray,
    *,
    signals_lost: bool = False,
) -> BrakingState:
    """Where a web break is found. `tension_n` (n,) are the set-points, `lost` (n,) the drives that have left.

    `request_m_per_s` is what the unwinder was asked for last. `signals_lost`: what is missing now has been missing for
    so long that it is not relied on.
    """
    n, brakes = inputs.n, limits.brakes
    speed = np.where(np.isfinite(inputs.speed.value), inputs.speed.value, request_m_per_s)
    unwind = inputs.unwind_speed.value.item(0)
    begun_at = max(request_m_per_s, float(np.abs(speed).max()))
    unwind = unwind if np.isfinite(unwind) else request_m_per_s
    # An unwinder that has not followed its request: the web that it gives is what the rollers are slowed down from.
    late = unwind - request_m_per_s > PARTING * begun_at
    ramp = unwind if late else request_m_per_s
    state = BrakingState(
        speed_m_per_s=speed.copy(),
        unwind_speed_m_per_s=unwind,
        ramp_m_per_s=np.full(2, ramp),
        smooth_ramp_m_per_s=np.full(2, ramp),
        asked_m_per_s=request_m_per_s,
        relieved_n=0.5 * (np.minimum(tension_n, limits.tension_max_n) + limits.tension_max_n),
        begun_m_per_s=speed.copy(),
        by_brake_m_per_s=np.zeros(n),
        late_m_per_s=np.zeros(n),
        by_web_m_per_s=np.zeros(n),
        by_web_most_m_per_s=np.zeros(n),
        set_n=tension_n.copy(),
        energy_j=brakes.energy_j.copy(),
        begun_at_m_per_s=begun_at,
        silent=signals_lost & (inputs.tension.quality != _GOOD),
        broken_at=n,
        released=lost.copy(),
        unknown=np.where(signals_lost & (inputs.speed.quality != _GOOD), limits.hold_periods, 0),
        apart=np.where(_apart(limits, inputs, begun_at), CONFIRMED, 0),
    )
    _find_break(limits, state)
    return state


def brake(
    limits: BrakingLimits, state: BrakingState, inputs: Inputs, lost: BoolArray, applied_nm: FloatArray
) -> Braking:
    """A period of it; `lost` (n,) are drives that have left, `applied_nm` (n,) acts now. Brings `state` up to date."""
    state.silent = state.silent & (inputs.tension.quality != _GOOD)
    findings = list(_web_findings(limits, state, inputs))
    _smooth(state, inputs)
    _spend(limits, state, applied_nm)
    _explain(limits, state, inputs, applied_nm)
    findings.extend(_released(limits, state, inputs, lost))
    behind = np.arange(inputs.n) >= state.broken_at
    share = _share(limits, state, inputs)
    _advance(limits, state, behind, share)
    torque = _torque_nm(limits, state, inputs, behind, np.append(share[1:], 1.0))
    holding = (inputs.speed.quality != _GOOD) & ~state.released
    torque[holding] = applied_nm[holding]  # a speed that is missing for a period: as before
    turning = limits.brakes.braked & ~state.released & (np.abs(state.speed_m_per_s) > limits.rests_m_per_s)
    still = state.asked_m_per_s == 0.0 and not turning.any()
    state.still = state.still + 1 if still else 0
    over = bool((state.released | ~limits.brakes.braked).all() or state.still >= limits.still_periods)
    return Braking(torque, state.released, state.asked_m_per_s, over, findings)


def _apart(limits: BrakingLimits, inputs: Inputs, begun_at_m_per_s: float) -> BoolArray:
    """Spans (n,) without tension whose rollers run apart: both say that the web has broken there.

    Measured by the speed at the beginning: nearly at rest rollers part a little whatever the web is.
    """
    good = (inputs.tension.quality == _GOOD) & (inputs.speed.quality == _GOOD)
    slack = good & limits.measured & (inputs.tension.value < limits.tension_min_n)
    return slack & parted(inputs.speed.value, inputs.unwind_speed.value.item(0), PARTING * begun_at_m_per_s)


def _find_break(limits: BrakingLimits, state: BrakingState) -> None:
    """The first span that is known to be broken; once found it stays there, and its rollers get their own ramp."""
    broken = np.flatnonzero(state.apart >= CONFIRMED)
    if len(broken) and state.broken_at == len(state.apart):
        state.broken_at = k = int(broken[0])
        # It begins at the speed of the one that is hardest to slow down: what brakes less would pull the others.
        heaviest = k + int(np.argmax((limits.brakes.inertia_kg_m2 / limits.brakes.radius_m**2)[k:]))
        state.ramp_m_per_s[1] = state.smooth_ramp_m_per_s[1] = abs(state.speed_m_per_s[heaviest])


def _web_findings(limits: BrakingLimits, state: BrakingState, inputs: Inputs) -> Iterator[Finding]:
    """Where the web has broken, and where it turns out to be whole: all is on one ramp again then."""
    state.apart = np.where(_apart(limits, inputs, state.begun_at_m_per_s), state.apart + 1, 0)
    _find_break(limits, state)
    if state.broken_at == inputs.n:
        return
    span, tension = state.broken_at, inputs.tension
    carries = tension.quality[span] == _GOOD and tension.value[span] >= limit_of(limits.tension_min_n, span)
    state.again = state.again + 1 if carries else 0
    if state.again == CONFIRMED:
        state.broken_at, state.again = inputs.n, 0
        yield found("broken-span-carries", Action.NONE, span=span + 1, tension_n=tension.value[span])


def _smooth(state: BrakingState, inputs: Inputs) -> None:
    good = inputs.speed.quality == _GOOD
    state.unknown = np.where(good, 0, state.unknown + 1)
    state.speed_m_per_s += np.where(good, inputs.speed.value - state.speed_m_per_s, 0.0) / SMOOTH_PERIODS
    seen = inputs.unwind_speed.good() and inputs.plc.quality == Quality.GOOD
    state.blind = 0 if seen else state.blind + 1
    if seen:
        state.unwind_speed_m_per_s += (inputs.unwind_speed.value.item(0) - state.unwind_speed_m_per_s) / SMOOTH_PERIODS


def _spend(limits: BrakingLimits, state: BrakingState, applied_nm: FloatArray) -> None:
    """The energy that the drives have taken in this period."""
    power_w = np.maximum(-applied_nm * state.speed_m_per_s / limits.brakes.radius_least_m, 0.0)
    state.energy_j -= power_w * limits.period_s


def _explain(limits: BrakingLimits, state: BrakingState, inputs: Inputs, applied_nm: FloatArray) -> None:
    """What torque, web and friction have done to each speed in this period (eq. roller_velocity_dynamics)."""
    brakes, period_s = limits.brakes, limits.period_s
    radius, inertia = brakes.radius_m, brakes.inertia_kg_m2
    known = limits.measured & (inputs.tension.quality == _GOOD)
    tension = np.append(np.where(known, inputs.tension.value, 0.0), 0.0)
    doubt = np.append(np.where(known, 0.0, state.set_n), 0.0)
    web = radius**2 / inertia * (tension[1:] - tension[:-1])
    friction = brakes.friction_nms_per_rad / inertia * state.speed_m_per_s
    by_torque = radius / inertia * applied_nm * period_s
    state.by_brake_m_per_s -= by_torque
    state.late_m_per_s = np.maximum(state.late_m_per_s, LATE_PERIODS * np.abs(by_torque))
    state.by_web_m_per_s -= (web - friction) * period_s
    most = np.abs(web) + np.abs(friction) + radius**2 / inertia * (doubt[1:] + doubt[:-1]) / WEB_ERROR
    state.by_web_most_m_per_s += most * period_s


def _turns_backwards(state: BrakingState) -> BoolArray:
    """Rollers (n,) that what their torque has done to them speaks for a drive wired the wrong way round."""
    did = state.begun_m_per_s - state.speed_m_per_s - state.by_web_m_per_s
    least = NOTICED * state.begun_at_m_per_s + state.late_m_per_s
    doubt = BACKWARDS * state.by_brake_m_per_s + WEB_ERROR * state.by_web_most_m_per_s + least
    return (state.by_brake_m_per_s > least) & (did < -doubt)


def _released(limits: BrakingLimits, state: BrakingState, inputs: Inputs, lost: BoolArray) -> Iterator[Finding]:
    """Bring `state.released` up to date; says why, once for each roller."""
    ahead = np.arange(inputs.n) < state.broken_at
    reasons = (
        (lost, "brake-released-drive-left"),
        (state.unknown >= limits.hold_periods, "brake-released-speed-unknown"),
        (state.energy_j <= 0.0, "brake-released-energy-spent"),
        (_turns_backwards(state), "brake-released-turns-backwards"),
        (ahead & (state.blind >= limits.hold_periods), "brake-released-unwinder-unknown"),
    )
    for which, code in reasons:
        for i in np.flatnonzero(which & ~state.released):
            speed = state.speed_m_per_s[i]
            yield found(code, Action.NONE, roller=int(i) + 1, speed_m_per_s=speed)
        state.released = state.released | which


def _share(limits: BrakingLimits, state: BrakingState, inputs: Inputs) -> FloatArray:
    """Share (n,) of its brake that what is ahead of each span may use: near its limit the span is not pulled at."""
    room = np.maximum(limits.tension_max_n - state.relieved_n, 1e-9 * limits.tension_max_n)
    # A cell that is pulled beyond its capacity has no good value: its last one is what is known.
    known = limits.measured & ~state.silent & np.isfinite(inputs.tension.value)
    return np.where(known, np.clip((limits.tension_max_n - inputs.tension.value) / room, 0.0, 1.0), 1.0)


def _advance(limits: BrakingLimits, state: BrakingState, behind: BoolArray, share: FloatArray) -> None:
    """Both ramps, by a period: no steeper than the weakest roller on them follows, less where a span is pulled at."""
    brakes = limits.brakes
    for k, on_it in enumerate((~behind, behind)):
        rate = _rate(brakes, state, float(state.ramp_m_per_s[k]), on_it)
        if k == 0:  # what the unwinder can, the rollers have always followed; and somebody stands beside a broken web
            rate = max(rate, brakes.stop_rate_m_per_s2)
        rate *= max(float(share[on_it].min(initial=1.0)), LEAST_SHARE)
        # It ends softly: what is a little late would pull the web against what stands already.
        ramp = float(state.ramp_m_per_s[k])
        # Friction that is not driven against slows rollers down by itself: a ramp that stays above them all would be
        # followed by none, and the web would hold back those of little friction.
        late = ramp - float(np.abs(state.speed_m_per_s[on_it]).max(initial=0.0)) if on_it.any() else 0.0
        ramp -= max(min(rate, ramp / limits.follows_s) * limits.period_s, late)
        state.ramp_m_per_s[k] = ramp if ramp > 0.25 * limits.rests_m_per_s else 0.0
    # The unwinder goes along, as steeply as anything is slowed down.
    least = state.asked_m_per_s - brakes.wanted_m_per_s2 * limits.period_s
    state.asked_m_per_s = max(min(float(state.ramp_m_per_s[0]), state.asked_m_per_s), least, 0.0)
    state.smooth_ramp_m_per_s += (state.ramp_m_per_s - state.smooth_ramp_m_per_s) / SMOOTH_PERIODS


def _rate(brakes: Brakes, state: BrakingState, speed_m_per_s: float, on_it: BoolArray) -> float:
    if not on_it.any():
        return brakes.wanted_m_per_s2
    able = deceleration_m_per_s2(brakes, speed_m_per_s, brakes.braked & ~state.released)
    return min(float(able[on_it].min()), brakes.wanted_m_per_s2)


def _torque_nm(
    limits: BrakingLimits, state: BrakingState, inputs: Inputs, behind: BoolArray, share: FloatArray
) -> FloatArray:
    brakes = limits.brakes
    speed = np.abs(state.speed_m_per_s)
    tied_m_per_s = max(0.0, min(float(state.smooth_ramp_m_per_s[0]), state.unwind_speed_m_per_s))
    ramp = np.where(behind, state.smooth_ramp_m_per_s[1], tied_m_per_s)
    rate = np.where(
        behind,
        _rate(brakes, state, float(state.ramp_m_per_s[1]), behind),
        _rate(brakes, state, float(state.ramp_m_per_s[0]), ~behind),
    )
    rate[ramp <= 0.5 * limits.rests_m_per_s] = 0.0
    inertia_per_radius = brakes.inertia_kg_m2 / brakes.radius_m
    now = inputs.speed.value
    # Driven against more friction than there is, a roller without web would run away; and where more of it is expected
    # than the least that its tolerance allows, the feedback of its speed must still outweigh the difference.
    least = brakes.friction_least_nms_per_rad * np.fmin(speed, np.abs(now)) / brakes.radius_most_m
    friction = brakes.friction_nms_per_rad * speed / brakes.radius_m
    friction = np.minimum(friction, least + OUTWEIGHED * inertia_per_radius * speed / limits.follows_s)
    wanted = inertia_per_radius * (rate + (speed - ramp) / limits.follows_s) - friction
    known = limits.measured & ~state.silent & np.isfinite(inputs.tension.value)
    excess_n = np.append(np.where(known, np.maximum(inputs.tension.value - state.set_n, 0.0), 0.0), 0.0)
    trim = EVENED * brakes.radius_m * (excess_n[:-1] - excess_n[1:])  # what pulls the web gives way
    wanted += trim
    # At the end what is smoothed still turns when the roller does not.
    ends = brakes.inertia_least_kg_m2 / brakes.radius_m * np.abs(now) / (END_PERIODS * limits.period_s)
    most = np.minimum(share * braking_torque_nm(brakes, speed), ends)
    torque = -np.sign(now) * np.clip(wanted, -np.minimum(least + np.maximum(-trim, 0.0), ends), most)
    torque[state.released | (np.sign(now) != np.sign(state.speed_m_per_s))] = 0.0
    return torque
