"""The envelope: what is checked in every cycle, before and after the control law. Pure; time is counted in periods.

It trusts nobody: neither the sensors (quality, staleness, band), nor the drives (state), nor the law (finite, limits).
"""

from dataclasses import dataclass, field, replace

import numpy as np

from gateway.core.signals import DriveState, FloatArray, Inputs, IntArray, Quality
from safety.actions import Action, Finding
from safety.limits import EnvelopeLimits


@dataclass(slots=True)
class EnvelopeState:
    """What the envelope remembers from period to period."""

    missing_periods: int = 0  #: in a row, in which a signal that control needs was not GOOD
    plc_missing_periods: int = 0
    overruns: int = 0  #: in a row, in which at least one period was skipped
    #: (n,), in a row outside the tension band
    outside_periods: IntArray = field(default_factory=lambda: np.zeros(0, dtype=np.int8))


@dataclass(frozen=True, slots=True)
class Supervision:
    """Which rules apply now; the state machine says so."""

    feedback: bool  #: the law is engaged: its signals must be there
    tension_floor: bool  #: the web has been tensioned: no span may go slack
    drives_enabled: bool  #: every drive must follow its torque


def check_inputs(
    limits: EnvelopeLimits, state: EnvelopeState, inputs: Inputs, supervision: Supervision
) -> tuple[list[Finding], EnvelopeState]:
    """Everything that the samples of this period say against running on."""
    findings: list[Finding] = []
    missing = _missing_signals(limits, inputs)
    missing_periods = state.missing_periods + 1 if missing else 0
    if missing and supervision.feedback:
        last = missing_periods >= limits.hold_periods
        findings.append(
            Finding(
                "signals",
                Action.STOP if last else Action.HOLD_OUTPUTS,
                f"no usable sample of {', '.join(missing)} in {missing_periods} periods of {limits.hold_periods}: "
                "check the device, its cable and its supply",
            )
        )
    plc_missing = state.plc_missing_periods + 1 if inputs.plc.quality != Quality.GOOD else 0
    if plc_missing >= limits.hold_periods:
        findings.append(Finding("line PLC", Action.STOP, f"the line PLC has not answered for {plc_missing} periods"))
    findings += _plc_findings(inputs)
    if supervision.drives_enabled:
        findings += _drive_findings(inputs)
    outside, band = _band_findings(limits, state, inputs, supervision.tension_floor)
    findings += band
    unwind = inputs.unwind_speed
    if unwind.quality[0] == Quality.GOOD and unwind.value[0] > 1.1 * limits.speed_max_m_per_s:
        findings.append(
            Finding(
                "overspeed",
                Action.STOP,
                f"the unwinder runs at {unwind.value[0]:.4f} m/s, allowed is {limits.speed_max_m_per_s} m/s",
            )
        )
    return findings, replace(
        state, missing_periods=missing_periods, plc_missing_periods=plc_missing, outside_periods=outside
    )


def check_timing(limits: EnvelopeLimits, state: EnvelopeState, skipped: int) -> tuple[list[Finding], EnvelopeState]:
    """Overruns: `skipped` periods went by before this one. Skipped, never caught up; too many stop the line."""
    overruns = state.overruns + 1 if skipped else 0
    findings: list[Finding] = []
    if overruns >= limits.overruns_in_a_row or skipped > limits.skipped_periods:
        findings.append(
            Finding(
                "overrun",
                Action.STOP,
                f"missed {skipped} periods of {limits.period_s * 1e3:g} ms at once, {overruns} times in a row: "
                "take load off this computer or give the loop real-time priority",
            )
        )
    return findings, replace(state, overruns=overruns)


def check_torque(asked_nm: FloatArray) -> list[Finding]:
    """Whether a law's answer may be used at all. Limits are not its concern: `limit_torque` applies them."""
    if np.isfinite(asked_nm).all():
        return []
    drives = ", ".join(str(i + 1) for i in np.flatnonzero(~np.isfinite(asked_nm)))
    return [Finding("finite torque", Action.TORQUE_OFF, f"the control law gave no finite torque for roller {drives}")]


def limit_torque(limits: EnvelopeLimits, asked_nm: FloatArray, applied_nm: FloatArray, interval_s: float) -> FloatArray:
    """The torque (n,) nearest to `asked_nm` that keeps limit and rate, `applied_nm` being that of the period before.

    `interval_s` is the time for which the torque before will have acted: shorter than a period after a late wake-up.
    `asked_nm` must be finite: minimum and maximum would hide a NaN.
    """
    step = limits.torque_rate_nm_per_s * min(max(interval_s, 0.0), limits.period_s)
    torque = np.minimum(np.maximum(asked_nm, applied_nm - step), applied_nm + step)
    return np.minimum(np.maximum(torque, -limits.torque_nm), limits.torque_nm)


def feedback_usable(limits: EnvelopeLimits, inputs: Inputs) -> bool:
    """Whether every signal that the control law needs has a GOOD sample in this period."""
    return not _missing_signals(limits, inputs)


def _missing_signals(limits: EnvelopeLimits, inputs: Inputs) -> list[str]:
    if inputs.speed.good() and inputs.unwind_speed.good() and not (inputs.tension.quality * limits.measured).any():
        return []
    tensions = [i + 1 for i in range(inputs.n) if limits.measured[i] and inputs.tension.quality[i]]
    speeds = [i + 1 for i in range(inputs.n) if inputs.speed.quality[i]]
    names = [f"{what} {_in_words(numbers)}" for what, numbers in (("tension", tensions), ("speed", speeds)) if numbers]
    return names + (["unwinder speed"] if inputs.unwind_speed.quality[0] else [])


def _in_words(numbers: list[int]) -> str:
    """ "3", "1 and 4", or "1 to 6" for what is without a gap."""
    if len(numbers) > 2 and numbers[-1] - numbers[0] == len(numbers) - 1:
        return f"{numbers[0]} to {numbers[-1]}"
    return " and ".join(map(str, numbers))


def _plc_findings(inputs: Inputs) -> list[Finding]:
    plc = inputs.plc
    if plc.quality != Quality.GOOD:
        return []
    if plc.emergency_stop:
        return [Finding("emergency stop", Action.TORQUE_OFF, "the emergency stop circuit is open")]
    if not plc.permissive:
        return [Finding("permissive", Action.STOP, "the line PLC has withdrawn its permissive")]
    return []


def _drive_findings(inputs: Inputs) -> list[Finding]:
    if (inputs.drive_state == DriveState.ENABLED).all():
        return []
    lost = [i for i in range(inputs.n) if inputs.drive_state[i] != DriveState.ENABLED]
    texts = [f"{i + 1} {DriveState(int(inputs.drive_state[i])).name}" for i in lost]
    return [Finding("drives", Action.STOP, f"drives that no longer follow: {', '.join(texts)}: read their fault")]


def _band_findings(
    limits: EnvelopeLimits, state: EnvelopeState, inputs: Inputs, floor: bool
) -> tuple[IntArray, list[Finding]]:
    tension = inputs.tension
    with np.errstate(invalid="ignore"):  # a channel that was never heard is NaN, and of no GOOD quality
        outside = tension.value > limits.tension_max_n
        if floor:
            outside |= tension.value < limits.tension_min_n
    fresh = tension.quality == Quality.GOOD
    before = state.outside_periods if len(state.outside_periods) == inputs.n else np.zeros(inputs.n, np.int8)
    # A sample that did not come says nothing: the count stays.
    count = np.where(fresh, np.where(outside, np.minimum(before + 1, 100), 0), before).astype(np.int8)
    return count, [_out_of_band(limits, int(i), tension.value[i]) for i in np.flatnonzero(count >= limits.band_periods)]


def _out_of_band(limits: EnvelopeLimits, span: int, tension_n: float) -> Finding:
    # Over-tension: the law itself relieves it best, while the line slows down. Slack or a broken web: a tension loop
    # would only spin its roller up.
    action = Action.STOP if tension_n > limits.tension_max_n else Action.TORQUE_OFF
    return Finding(
        "tension band",
        action,
        f"tension {span + 1} is {tension_n:.2f} N, allowed is {limits.tension_min_n:g} to {limits.tension_max_n:g} N",
    )
