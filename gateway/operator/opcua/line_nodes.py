"""What a line tells of itself as nodes: spans, rollers, unwinder, controller, and how well this server knows them."""

from collections.abc import Iterator
from dataclasses import dataclass
from datetime import UTC, datetime

from gateway.core.decisions import ProposalList
from gateway.core.line import Line
from gateway.core.line_limits import tension_band_n, torque_limit_nm
from gateway.core.status import GatewayStatus, SpanStatus
from gateway.operator.opcua.space import (
    BOOLEAN,
    DOUBLE,
    GOOD,
    LAST_USABLE,
    NO_COMMUNICATION,
    NO_DATA,
    STRING,
    UINT32,
    Row,
    Space,
    Value,
)
from gateway.operator.opcua.units import METRE, METRE_PER_SECOND, NEWTON, NEWTON_METRE, SECOND

ROOT = "Line"
SENSOR_FAILURE: int = 0x808C0000  #: BadSensorFailure
NOT_CONNECTED: int = 0x808A0000  #: BadNotConnected
CODES = {"GOOD": GOOD, "STALE": LAST_USABLE, "BAD": SENSOR_FAILURE, "MISSING": NOT_CONNECTED}  #: by quality


@dataclass(frozen=True)
class Told:
    """A value for a node."""

    path: str
    value: Value
    code: int = GOOD


async def make_line(space: Space, line: Line) -> None:
    """All nodes; what never changes has its value at once."""
    limits = line.limits
    speed, torque = (0.0, limits.speed_max_m_per_s), (-limits.torque_nm, limits.torque_nm)
    await _objects(space, line, speed)
    widest = (limits.tension_min_n, limits.tension_max_n)
    span = await space.type("SpanType", "The web between two rollers", _span_rows(*widest))
    await space.object(f"{ROOT}.Spans", ROOT, "By number; span 1 begins at the unwinder")
    roller = await space.type("RollerType", "A driven roller", _roller_rows(speed, torque))
    await space.object(f"{ROOT}.Rollers", ROOT, "By number; roller 1 ends span 1")
    for number in range(1, line.n + 1):
        most_nm = torque_limit_nm(line, number)
        for group, rows, kind in (
            ("Spans", _span_rows(*tension_band_n(line, number)), span),
            ("Rollers", _roller_rows(speed, (-most_nm, most_nm)), roller),
        ):
            path = f"{ROOT}.{group}.{number}"
            await space.object(path, f"{ROOT}.{group}", "", kind)
            await space.variables(path, rows)
    for told in _fixed(line):
        await space.tell(told.path, told.value, None, told.code)


async def _objects(space: Space, line: Line, speed: tuple[float, float]) -> None:
    await space.object(ROOT, "", f"{line.site}/{line.line}", await space.type("LineType", "A roll-to-roll line", ()))
    for name, tells, rows in (
        ("Identification", "Who this line is", _IDENTIFICATION),
        ("Operation", "What the line does, and what a person can do next", _OPERATION),
        ("Unwinder", "Roller 0, which the line PLC drives", _unwinder_rows(speed)),
        ("Limits", "What must never be left; changed only in the line's file", _LIMITS),
        ("Controller", "What controls the line, and how it fares", _CONTROLLER),
        ("Performance", "How well the configuration in service did when it was measured last", _PERFORMANCE),
        ("Connection", "How well this server knows the line; always good", _CONNECTION),
    ):
        kind = await space.type(f"{name}Type", tells, rows)
        await space.object(f"{ROOT}.{name}", ROOT, tells, kind)
        await space.variables(f"{ROOT}.{name}", rows)


def of_status(status: GatewayStatus) -> Iterator[Told]:
    running = status.loop.running
    for name, value in {
        "State": status.loop.state, "Text": status.loop.text, "Next": status.loop.next, "Running": running,
        "Stands": status.stands, "Saturated": status.loop.saturated,
        "Events": [f"{event.kind}: {event.text}" for event in status.events],
    }.items():  # fmt: skip
        yield Told(f"{ROOT}.Operation.{name}", value)
    yield _measured(f"{ROOT}.Unwinder.Speed", status.unwind_speed_m_per_s, running)
    yield _measured(f"{ROOT}.Unwinder.Setpoint", status.speed_setpoint_m_per_s, running)
    change, timing = status.change, status.timing
    for name, value in {
        "Mode": mode(status), "Stage": "" if change is None else change.stage,
        "StageText": "" if change is None else change.text,
        "Changing": "" if change is None else change.proposal, "Health": health(status),
        "Doubts": status.loop.doubts, "Missed": timing.missed, "AuditHead": status.audit_head,
    }.items():  # fmt: skip
        yield Told(f"{ROOT}.Controller.{name}", value)
    for name, spread in (("CycleP99", timing.cycle), ("LatenessP99", timing.lateness)):
        yield _measured(f"{ROOT}.Controller.{name}", None if spread is None else spread.p99_s, running)
    for span in status.spans:
        yield from _of_span(span, running)


def of_proposals(found: ProposalList) -> Iterator[Told]:
    """What the list of proposals tells of the controller."""
    for name, value in {
        "InService": found.in_service or "", "LastKnownGood": found.last_known_good or "", "Revision": found.epoch,
        "Model": found.model or "",
    }.items():  # fmt: skip
        yield Told(f"{ROOT}.Controller.{name}", value)
    controller = found.controller
    measured = None if controller is None else controller.performance
    for path, value in {
        "Controller.Kind": None if controller is None else controller.kind,
        "Controller.Phase": None if controller is None else controller.phase,
        "Performance.Value": None if measured is None else measured.rmse_n,
        "Performance.Baseline": None if measured is None else measured.baseline_rmse_n,
        "Performance.Scenario": None if measured is None else measured.scenario,
        "Performance.Measured": None if measured is None else _rfc_3339(measured.measured_s),
    }.items():
        yield Told(f"{ROOT}.{path}", value, NO_DATA if value is None else GOOD)


def _rfc_3339(wall_s: float) -> str:
    return datetime.fromtimestamp(wall_s, UTC).isoformat(timespec="seconds").replace("+00:00", "Z")


def list_paths() -> list[str]:
    """Of what the list of proposals tells of the controller."""
    controller = ("InService", "LastKnownGood", "Revision", "Model", "Kind", "Phase")
    return [f"{ROOT}.Controller.{name}" for name in controller] + [
        f"{ROOT}.Performance.{row.name}" for row in _PERFORMANCE
    ]


#: By the stage of a change.
_MODES = {"deploying": "deploying", "probation": "on probation", "keeping": "keeping", "running": "experiment"}


def mode(status: GatewayStatus) -> str:
    """What the controller is there for now."""
    if status.loop.state not in ("RUN", "HOLD"):
        return "off"
    return "in service" if status.change is None else _MODES.get(status.change.stage, "in service")


def health(status: GatewayStatus) -> str:
    """In words."""
    if not status.loop.running:
        return status.loop.text
    wrong = list(status.loop.doubts)
    if status.loop.saturated:
        wrong.append("a torque or its rate is at its limit")
    if status.timing.missed:
        wrong.append(f"{status.timing.missed} periods were missed in the last seconds")
    return "; ".join(wrong) or "nothing is wrong"


def live_paths(line: Line) -> list[str]:
    """Of all that says nothing true when the gateway is away."""
    groups = {
        "Operation": _OPERATION, "Unwinder": _unwinder_rows((0.0, 0.0)), "Controller": _CONTROLLER,
        "Performance": _PERFORMANCE,
    }  # fmt: skip
    paths = [f"{ROOT}.{group}.{row.name}" for group, rows in groups.items() for row in rows]
    paths.remove(f"{ROOT}.Operation.Recipes")
    for number in range(1, line.n + 1):
        paths += [f"{ROOT}.Spans.{number}.{name}" for name in ("Tension", "Setpoint", "Error", "Quality")]
        paths += [f"{ROOT}.Rollers.{number}.{name}" for name in ("Speed", "Torque", "TorqueActual", "Drive")]
    return paths


def _of_span(span: SpanStatus, running: bool) -> Iterator[Told]:
    path, roller = f"{ROOT}.Spans.{span.number}", f"{ROOT}.Rollers.{span.number}"
    code = CODES.get(span.quality, SENSOR_FAILURE)
    for name, value in (("Tension", span.tension_n), ("Error", span.error_n)):
        held = value if code in (GOOD, LAST_USABLE) else None
        yield Told(f"{path}.{name}", held, NO_COMMUNICATION if value is None and code in (GOOD, LAST_USABLE) else code)
    yield _measured(f"{path}.Setpoint", span.setpoint_n, running)
    yield Told(f"{path}.Quality", span.quality)
    yield _measured(f"{roller}.Speed", span.speed_m_per_s, running)
    yield _measured(f"{roller}.Torque", span.torque_nm, running)
    yield _measured(f"{roller}.TorqueActual", span.torque_actual_nm, running)
    yield Told(f"{roller}.Drive", span.drive)


def _measured(path: str, value: float | None, running: bool) -> Told:
    if value is None:
        return Told(path, None, NO_COMMUNICATION)
    return Told(path, value, GOOD if running else LAST_USABLE)


def _fixed(line: Line) -> Iterator[Told]:
    values: dict[str, Value] = {
        "Identification.Manufacturer": "r2rgate", "Identification.ProductName": "r2rgate operator",
        "Identification.Site": line.site, "Identification.Line": line.line,
        "Identification.Description": line.description, "Operation.Recipes": [one.name for one in line.recipes],
        "Limits.TensionMin": line.limits.tension_min_n, "Limits.TensionMax": line.limits.tension_max_n,
        "Limits.Torque": line.limits.torque_nm, "Limits.Speed": line.limits.speed_max_m_per_s,
    }  # fmt: skip
    yield from (Told(f"{ROOT}.{name}", value) for name, value in values.items())
    for number, (span, roller) in enumerate(zip(line.spans, line.rollers, strict=True), 1):
        yield Told(f"{ROOT}.Spans.{number}.Name", span.name)
        yield Told(f"{ROOT}.Spans.{number}.Control", span.control)
        yield Told(f"{ROOT}.Rollers.{number}.Name", roller.name)
        yield Told(f"{ROOT}.Rollers.{number}.Radius", roller.radius_m.value)


def _span_rows(low: float, high: float) -> list[Row]:
    return [
        Row("Name", STRING, "As the line's file has it"),
        Row("Control", STRING, "tension, or draw: no load cell, the roller keeps a speed ratio"),
        Row("Tension", DOUBLE, "Measured", NEWTON, (low, high), history=True),
        Row("Setpoint", DOUBLE, "Of the tension", NEWTON, (low, high), history=True),
        Row("Error", DOUBLE, "Tension minus set-point", NEWTON, (low - high, high - low)),
        Row("Quality", STRING, "Of the measurement, in the loop's words: GOOD, STALE, BAD or MISSING"),
    ]


def _roller_rows(speed: tuple[float, float], torque: tuple[float, float]) -> list[Row]:
    return [
        Row("Name", STRING, "As the line's file has it"),
        Row("Radius", DOUBLE, "Nominal", METRE, (0.0, 1.0)),
        Row("Speed", DOUBLE, "Of the web at the roller", METRE_PER_SECOND, speed),
        Row("Torque", DOUBLE, "Applied", NEWTON_METRE, torque),
        Row("TorqueActual", DOUBLE, "As the drive reports it", NEWTON_METRE, torque),
        Row("Drive", STRING, "What the drive says of itself"),
    ]


def _unwinder_rows(speed: tuple[float, float]) -> list[Row]:
    return [
        Row("Speed", DOUBLE, "Of the web at the unwinder", METRE_PER_SECOND, speed),
        Row("Setpoint", DOUBLE, "Of the speed", METRE_PER_SECOND, speed),
    ]


_IDENTIFICATION = (
    Row("Manufacturer", STRING, "Of this program"),
    Row("ProductName", STRING, "Of this program"),
    Row("Site", STRING, "As the line's file has it"),
    Row("Line", STRING, "As the line's file has it"),
    Row("Description", STRING, "As the line's file has it"),
)
_OPERATION = (
    Row("State", STRING, "SILENT, READY, RUN, HOLD, STOP; UNKNOWN without a loop"),
    Row("Text", STRING, "The state in words"),
    Row("Next", STRING, "What a person can do now"),
    Row("Running", BOOLEAN, "The loop runs"),
    Row("Stands", BOOLEAN, "In RUN, and no set-point has moved for as long as a verdict asks for"),
    Row("Saturated", BOOLEAN, "A torque or its rate is at its limit"),
    Row("Events", STRING, "The last ones, the newest at the end", array=True),
    Row("Recipes", STRING, "For SelectRecipe", array=True),
)
_LIMITS = (
    Row("TensionMin", DOUBLE, "Of every span", NEWTON, (0.0, 1e4)),
    Row("TensionMax", DOUBLE, "Of every span", NEWTON, (0.0, 1e4)),
    Row("Torque", DOUBLE, "Of every drive, either direction", NEWTON_METRE, (0.0, 1e4)),
    Row("Speed", DOUBLE, "Of the web", METRE_PER_SECOND, (0.0, 100.0)),
)
_CONTROLLER = (
    Row("InService", STRING, "SHA-256 of the configuration in service"),
    Row("LastKnownGood", STRING, "SHA-256 of the configuration that a roll-back goes to"),
    Row("Revision", UINT32, "Counts up with every deployment; Decide asks for it as base_revision"),
    Row("Model", STRING, "SHA-256 of the model by which proposals are judged; empty: the line's file"),
    Row("Kind", STRING, "PID, LQR, LQI, LQG or MPC; and scheduled, where its gains go with the speed"),
    Row("Phase", STRING, "commissioning, or operation: a baseline was set for the line as it is"),
    Row("Mode", STRING, "off, in service, deploying, on probation, keeping, or experiment"),
    Row("Stage", STRING, "Of a change that is on its way, on probation, or an experiment; empty: there is none"),
    Row("StageText", STRING, "What is still missing to its end"),
    Row("Changing", STRING, "SHA-256 of the proposal of that change"),
    Row("Health", STRING, "In words"),
    Row("Doubts", STRING, "Why proposals are blocked; empty: they are not", array=True),
    Row("CycleP99", DOUBLE, "Of the loop's cycles in the last ten seconds", SECOND, (0.0, 0.1)),
    Row("LatenessP99", DOUBLE, "Of the loop in the last ten seconds", SECOND, (0.0, 0.1)),
    Row("Missed", UINT32, "Periods skipped in the last ten seconds"),
    Row("AuditHead", STRING, "NUMBER:HASH of the audit's last record: for `r2rgate audit verify --against`"),
)
_PERFORMANCE = (
    Row("Value", DOUBLE, "RMSE of the tensions, over all spans", NEWTON, (0.0, 1e3)),
    Row("Baseline", DOUBLE, "The same of the line's baseline", NEWTON, (0.0, 1e3)),
    Row("Scenario", STRING, "In which both were measured"),
    Row("Measured", STRING, "RFC 3339, when Value was"),
)
_CONNECTION = (
    Row("Fresh", BOOLEAN, "The gateway tells, and what is told here is no older than two seconds"),
    Row("Trouble", STRING, "Why the gateway does not tell; empty: it does"),
    Row("PageTrouble", STRING, "Why the page is not served; empty: it is"),
)
