"""The envelope: what is checked in every cycle, before and after the control law. Pure; time is counted in periods.

It trusts nobody: neither the sensors (quality, staleness, band, speed), nor the drives and the line PLC (state), nor
the law (finite, limits), nor the computer (overruns).
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from math import inf, isfinite

import numpy as np

from gateway.core.signals import BoolArray, Channel, DriveState, FloatArray, Inputs, Quality
from safety.actions import Action, Finding, found
from safety.limits import EnvelopeLimits

PARTING = 0.03  #: share of the speed by which the roller behind a break runs ahead; an elastic web stretches by less
MOST_COUNTED = 100  #: periods outside a limit; counts of more say nothing new
_GOOD = int(Quality.GOOD)  # plain integers compare several times as fast as members of an enum


@dataclass(frozen=True, slots=True)
class Supervision:
    """Which rules apply now; the phase of the loop says so."""

    feedback: bool  #: the law is engaged: its signals must be there, and rollers must not run away
    standstill: bool  #: the unwinder stands still
    tension_floor: bool  #: the web has been tensioned: no span may go slack
    drives: DriveState | None  #: the state that every drive must be in
    transport: bool  #: the line PLC has been asked for transport, and must give it


NOTHING = Supervision(feedback=False, standstill=False, tension_floor=False, drives=None, transport=False)


@dataclass(slots=True)
class EnvelopeState:
    """What the envelope remembers from period to period. Counts are periods in a row."""

    missing: int = 0  #: without a signal that control needs
    missing_history: int = 0  #: a bit a period over the last periods, the newest lowest
    plc_missing: int = 0
    overruns: int = 0  #: in which at least one period was skipped
    stopped: int = 0  #: in which the PLC gave no transport
    #: (n,), outside the tension band; and over the speed. Empty: none is
    outside: Sequence[int] = ()
    fast: Sequence[int] = ()


@dataclass(frozen=True, slots=True)
class Assessment:
    """What the samples of a period say."""

    findings: list[Finding]
    usable: bool  #: every signal that control needs is there in this period
    feedback_lost: bool  #: and has been missing for too long
    plc_lost: bool


def check_inputs(
    limits: EnvelopeLimits, state: EnvelopeState, inputs: Inputs, supervision: Supervision
) -> tuple[Assessment, EnvelopeState]:
    """Everything that the samples of this period say against running on."""
    missing = _missing_signals(limits, inputs)
    window = (1 << limits.miss_window) - 1
    after = EnvelopeState(
        missing=state.missing + 1 if missing else 0,
        missing_history=((state.missing_history << 1) | bool(missing)) & window if supervision.feedback else 0,
        plc_missing=state.plc_missing + 1 if inputs.plc.quality != Quality.GOOD else 0,
        overruns=state.overruns,
        stopped=state.stopped + 1 if supervision.transport and not inputs.plc.running else 0,
        outside=_count(state.outside, _outside_band(limits, inputs, supervision), inputs.tension),
        fast=_count(state.fast, _too_fast(limits, inputs, supervision), inputs.speed),
    )
    plc_lost = after.plc_missing >= limits.hold_periods
    findings = _signal_findings(limits, after, missing) if supervision.feedback else []
    if plc_lost:
        findings.append(found("line-plc-silent", Action.STOP, periods=after.plc_missing))
    findings += _plc_findings(limits, after, inputs)
    findings += _drive_findings(inputs, supervision)
    findings += [_out_of_band(limits, i, inputs) for i in _beyond(after.outside, limits)]
    findings += _speed_findings(limits, after, inputs, supervision)
    feedback_lost = after.missing >= limits.hold_periods
    return Assessment(findings, not missing, feedback_lost, plc_lost), after


def check_timing(limits: EnvelopeLimits, state: EnvelopeState, skipped: int) -> tuple[list[Finding], EnvelopeState]:
    """Overruns: `skipped` periods went by before this one. Skipped, never caught up; too many stop the line."""
    if not skipped and not state.overruns:
        return [], state
    overruns = state.overruns + 1 if skipped else 0
    findings: list[Finding] = []
    if overruns >= limits.overruns_in_a_row or skipped > limits.skipped_periods:
        late = {"skipped": skipped, "period_s": limits.period_s, "in_a_row": overruns}
        findings.append(found("overrun", Action.STOP, **late))
    return findings, replace(state, overruns=overruns)


def check_torque(asked_nm: FloatArray) -> list[Finding]:
    """Whether a law's answer may be used at all. Limits are not its concern: `limit_torque` applies them."""
    if all(map(isfinite, asked_nm.tolist())):
        return []
    rollers = ", ".join(str(i + 1) for i in np.flatnonzero(~np.isfinite(asked_nm)))
    return [found("torque-not-finite", Action.TORQUE_OFF, rollers=rollers)]


def limit_torque(limits: EnvelopeLimits, asked_nm: FloatArray, applied_nm: FloatArray, interval_s: float) -> FloatArray:
    """The torque (n,) nearest to `asked_nm` that keeps limit and rate, `applied_nm` being that of the period before.

    `interval_s` is the time for which the torque before will have acted: shorter than a period after a late wake-up.
    `asked_nm` must be finite: minimum and maximum would hide a NaN.
    """
    step = limits.torque_rate_nm_per_s * min(max(interval_s, 0.0), limits.period_s)
    torque = np.minimum(np.maximum(asked_nm, applied_nm - step), applied_nm + step)
    return np.minimum(np.maximum(torque, -limits.torque_nm), limits.torque_nm)


def _missing_signals(limits: EnvelopeLimits, inputs: Inputs) -> list[str]:
    tensions_good = inputs.tension.good() or not (inputs.tension.quality * limits.measured).any()
    if tensions_good and inputs.speed.good() and inputs.unwind_speed.good():
        return []
    tensions = [i + 1 for i in range(inputs.n) if limits.measured[i] and inputs.tension.quality[i]]
    speeds = [i + 1 for i in range(inputs.n) if inputs.speed.quality[i]]
    return _named("T", tensions) + _named("v", speeds) + (["v0"] if inputs.unwind_speed.quality[0] else [])


def _named(symbol: str, numbers: list[int]) -> list[str]:
    """ "T1", "T4"; or "T1-T6" for more than two without a gap."""
    if len(numbers) > 2 and numbers[-1] - numbers[0] == len(numbers) - 1:
        return [f"{symbol}{numbers[0]}-{symbol}{numbers[-1]}"]
    return [f"{symbol}{number}" for number in numbers]


def _signal_findings(limits: EnvelopeLimits, state: EnvelopeState, missing: list[str]) -> list[Finding]:
    """A missing signal holds the outputs; too many in a row, or too many at all, stop the line."""
    often = state.missing_history.bit_count()
    if not missing:
        return []
    signals, stops = ", ".join(missing), state.missing >= limits.hold_periods
    if not stops and often > 2 * limits.hold_periods:
        counts = {"missed": often, "periods": limits.miss_window}
        return [found("signals-missing-often", Action.STOP, signals=signals, **counts)]
    action, counts = Action.STOP if stops else Action.HOLD_OUTPUTS, {"missed": state.missing}
    return [found("signals-missing", action, signals=signals, periods=limits.hold_periods, **counts)]


def _plc_findings(limits: EnvelopeLimits, state: EnvelopeState, inputs: Inputs) -> list[Finding]:
    plc = inputs.plc
    if plc.quality != Quality.GOOD:
        return []
    if plc.emergency_stop:
        return [found("emergency-stop", Action.TORQUE_OFF)]
    if not plc.permissive:
        return [found("no-permissive", Action.STOP)]
    if state.stopped >= limits.transport_periods:
        return [found("transport-stopped", Action.STOP)]
    return []


def _drive_findings(inputs: Inputs, supervision: Supervision) -> list[Finding]:
    if supervision.drives is None:
        return []
    wanted = int(supervision.drives)
    wrong = [(i, state) for i, state in enumerate(inputs.drive_state.tolist()) if state != wanted]
    if not wrong:
        return []
    drives = ", ".join(f"{i + 1} {DriveState(state).name}" for i, state in wrong)
    return [found("drive-state", Action.STOP, wanted=supervision.drives.name, drives=drives)]


def _count(before: Sequence[int], now: list[bool], channel: Channel) -> Sequence[int]:
    """Periods in a row for which `now` (n,) holds. A sample that did not come says nothing: the count stays."""
    if not any(now) and not any(before):
        return ()
    return [
        (min(count + 1, MOST_COUNTED) if holds else 0) if quality == _GOOD else count
        for count, holds, quality in zip(before or [0] * len(now), now, channel.quality.tolist(), strict=True)
    ]


def _beyond(counts: Sequence[int], limits: EnvelopeLimits) -> list[int]:
    return [i for i, count in enumerate(counts) if count >= limits.band_periods]


def _outside_band(limits: EnvelopeLimits, inputs: Inputs, supervision: Supervision) -> list[bool]:
    low, high = limits.tension_min_n if supervision.tension_floor else -inf, limits.tension_max_n
    # A channel that was never heard is NaN, and of no GOOD quality: it is not counted. GOOD and no number is outside.
    if isinstance(low, float) and isinstance(high, float):
        return [not low <= tension_n <= high for tension_n in inputs.tension.value.tolist()]
    within: list[bool] = ((low <= inputs.tension.value) & (inputs.tension.value <= high)).tolist()
    return [not each for each in within]


def _out_of_band(limits: EnvelopeLimits, span: int, inputs: Inputs) -> Finding:
    # Over-tension: the law itself relieves it best, while the line slows down. Slack or a broken web: a tension loop
    # would only spin its roller up, and a heavy one would coast: all are braked on one ramp (`braking`).
    tension_n = float(inputs.tension.value[span])
    low_n, high_n = limit_of(limits.tension_min_n, span), limit_of(limits.tension_max_n, span)
    values = {"span": span + 1, "tension_n": tension_n, "low_n": low_n, "high_n": high_n}
    if tension_n > high_n:
        return found("tension-high", Action.STOP, **values)
    if _rollers_part(limits, span, inputs):
        return found("web-break", Action.BRAKE, **values)
    return found("slack", Action.BRAKE, **values)


def limit_of(limit: float | FloatArray, span: int) -> float:
    """Of a span (from 0), where limits may be one for all or (n,)."""
    return float(limit[span]) if isinstance(limit, np.ndarray) else limit


def _rollers_part(limits: EnvelopeLimits, span: int, inputs: Inputs) -> bool:
    """Whether the rollers at both ends of a span (from 0) say, too, that nothing holds them together."""
    unwind_m_per_s = inputs.unwind_speed.value.item(0)
    return bool(parted(inputs.speed.value, unwind_m_per_s, limits.parting_m_per_s)[span])


def parted(speed_m_per_s: FloatArray, unwind_m_per_s: float, least_m_per_s: float) -> BoolArray:
    """Spans (n,) whose rollers run apart: the one behind is faster than any web between them would let it be.

    `least_m_per_s`: by which it must be, however slow they are.
    """
    before = np.concatenate(((unwind_m_per_s,), speed_m_per_s[:-1]))
    return speed_m_per_s - before > np.maximum(least_m_per_s, PARTING * np.abs(before))


def _roller_limit(limits: EnvelopeLimits, supervision: Supervision) -> float:
    if supervision.standstill:
        return min(limits.tensioning_speed_m_per_s, limits.speed_max_m_per_s)
    return limits.roller_speed_m_per_s


def _too_fast(limits: EnvelopeLimits, inputs: Inputs, supervision: Supervision) -> list[bool]:
    if not supervision.feedback:
        return [False] * inputs.n
    limit = _roller_limit(limits, supervision)
    return [not abs(speed) <= limit for speed in inputs.speed.value.tolist()]  # NaN and GOOD: nobody knows how fast


def _fast_roller(limits: EnvelopeLimits, supervision: Supervision, i: int, speed: float) -> Finding:
    if supervision.standstill:
        allowed = _roller_limit(limits, supervision)
        values = {"roller": i + 1, "speed_m_per_s": speed, "allowed_m_per_s": allowed}
        return found("tensioning-roller-speed", Action.TORQUE_OFF, **values)
    values = {"roller": i + 1, "speed_m_per_s": speed, "line_most_m_per_s": limits.speed_max_m_per_s}
    return found("roller-speed", Action.TORQUE_OFF, **values)


def _speed_findings(
    limits: EnvelopeLimits, state: EnvelopeState, inputs: Inputs, supervision: Supervision
) -> list[Finding]:
    # A roller that runs away has no web to pull: torque off. An unwinder that is too fast is slowed down.
    findings = [_fast_roller(limits, supervision, i, float(inputs.speed.value[i])) for i in _beyond(state.fast, limits)]
    speed, greatest = inputs.unwind_speed.value.item(0), limits.unwinder_overspeed * limits.speed_max_m_per_s
    if not abs(speed) <= greatest and inputs.unwind_speed.good():
        values = {"speed_m_per_s": speed, "allowed_m_per_s": limits.speed_max_m_per_s}
        findings.append(found("overspeed", Action.STOP, **values))
    return findings
