"""Which alarms' conditions hold in a status, and the measured values that say so. One function a row of the table.

Where the loop is gone nothing is known of the line: then only what says that holds.
"""

from collections.abc import Callable

from gateway.core.doubts import WORDS, Doubt
from gateway.core.finding import Finding
from gateway.core.status import GatewayStatus, SpanStatus, band_n, torque_limit_nm
from gateway.supervisor.audit import AuditState
from gateway.wording.catalogue import sentences

OFF_SHARE = 0.2  #: of the set-point
MISSED_SHARE = 0.01  #: of the periods of ten seconds
LONGEST_TEXT = 400  #: characters
MOVING = ("RUN", "HOLD")
_CELL_DOUBTS = (WORDS[Doubt.CELL_STUCK], WORDS[Doubt.CELL_DRIFTS])


class Conditions:
    """`look` at each status in turn: why the line stopped is told once, in an event."""

    def __init__(self) -> None:
        self._told = ""  #: with the last change of state
        self.stopped_by: list[Finding] = []  #: what led to the last change of state
        self.false_loop: list[Finding] = []  #: what was found last of one that is none

    def look(self, status: GatewayStatus, audit: AuditState) -> dict[str, str]:
        """By alarm what is so now, in words."""
        self._hear(status)
        found = {"audit-unavailable": "" if audit.available else audit.text, "loop-lost": _loop_lost(status)}
        self.false_loop = status.loop.false_loop or self.false_loop
        found["false-loop"] = sentences(status.loop.false_loop)
        found["gateway-task"] = _gateway_task(status)
        found["unexplained-change"] = sentences(status.unexplained)
        found["history-not-stored"] = "" if status.historian.storing else status.historian.text
        if status.loop.running:
            found |= {name: condition(status) for name, condition in OF_THE_LINE.items()}
            found["line-stopped"] = self._line_stopped(status)
        return {name: text[:LONGEST_TEXT] for name, text in found.items() if text}

    def findings_of(self, alarm: str) -> list[Finding]:
        """What led to an alarm, by code and number."""
        return {"line-stopped": self.stopped_by, "false-loop": self.false_loop}.get(alarm, [])

    def _hear(self, status: GatewayStatus) -> None:
        newest = next((event for event in reversed(status.events) if event.kind == "state"), None)
        if newest is not None:
            self._told = newest.text.partition(": ")[2]
            self.stopped_by = newest.findings

    def _line_stopped(self, status: GatewayStatus) -> str:
        if status.loop.state != "STOP" or status.loop.by_person:
            return ""
        return self._told or "the gateway was not there to see why"


def _loop_lost(status: GatewayStatus) -> str:
    """A loop that nobody has started yet is none that was lost."""
    loop = status.loop
    return "" if loop.running or loop.age_s is None else f"no telemetry for {loop.age_s:.1f} s"


def _gateway_task(status: GatewayStatus) -> str:
    return "; ".join(f"{fault.task}: {fault.error}: {fault.text}" for fault in status.task_faults)


def _device_absent(status: GatewayStatus) -> str:
    return "; ".join(f"{', '.join(bus.absent)} on {bus.name}: {bus.last_error}" for bus in status.buses if bus.absent)


def _drive_fault(status: GatewayStatus) -> str:
    bad = ("FAULT", "STO", "ABSENT") if status.loop.state in MOVING else ("FAULT",)
    return "; ".join(f"drive of {span.roller}: {span.drive}" for span in status.spans if span.drive in bad)


def _load_cell(status: GatewayStatus) -> str:
    measured = [span for span in status.spans if span.control == "tension"] if status.loop.state in MOVING else []
    bad = [f"span {span.number} {span.name}: {span.quality}" for span in measured if span.quality != "GOOD"]
    return "; ".join([*bad, *(doubt for doubt in status.loop.doubts if doubt in _CELL_DOUBTS)])


def _torque_at_limit(status: GatewayStatus) -> str:
    doubted = WORDS[Doubt.SATURATED] in status.loop.doubts
    if status.loop.state not in MOVING or not (status.loop.saturated or doubted):
        return ""
    limits = status.limits
    most = max(status.spans, key=lambda span: abs(span.torque_nm or 0.0) / torque_limit_nm(span, limits))
    return f"{most.roller} at {most.torque_nm or 0.0:.1f} Nm; allowed: {torque_limit_nm(most, limits):g} Nm"


def _out_of_band(status: GatewayStatus) -> str:
    """Once the set-point is in the band: on the way there from a slack web it is not."""
    return "; ".join(
        f"{_measured(span)}; allowed: {least:g} to {most:g} N"
        for span, tension_n, setpoint_n in _controlled(status)
        for least, most in (band_n(span, status.limits),)
        if least <= setpoint_n <= most and not least <= tension_n <= most
    )


def _tension_off(status: GatewayStatus) -> str:
    return "; ".join(
        f"{_measured(span)}, set to {setpoint_n:.1f} N"
        for span, tension_n, setpoint_n in _controlled(status)
        if abs(tension_n - setpoint_n) > OFF_SHARE * setpoint_n > 0.0
    )


def _cycles_late(status: GatewayStatus) -> str:
    timing = status.timing
    if timing.missed <= MISSED_SHARE * timing.frames:
        return ""
    return f"{timing.missed} periods missed in the last {timing.frames}"


def _controlled(status: GatewayStatus) -> list[tuple[SpanStatus, float, float]]:
    """Spans whose tension is controlled now on a good value, with tension and set-point."""
    spans = status.spans if status.loop.state in MOVING else []
    return [
        (span, span.tension_n, span.setpoint_n) for span in spans
        if span.control == "tension" and span.quality == "GOOD"
        and span.tension_n is not None and span.setpoint_n is not None
    ]  # fmt: skip


def _measured(span: SpanStatus) -> str:
    return f"span {span.number} {span.name}: {span.tension_n or 0.0:.1f} N"


OF_THE_LINE: dict[str, Callable[[GatewayStatus], str]] = {
    "device-absent": _device_absent,
    "drive-fault": _drive_fault,
    "load-cell": _load_cell,
    "torque-at-limit": _torque_at_limit,
    "tension-out-of-band": _out_of_band,
    "tension-off": _tension_off,
    "cycles-late": _cycles_late,
}
