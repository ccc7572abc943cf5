"""The status of a line on a terminal, for the technician who stands before it. Pure: a status in, a renderable out."""

import textwrap
import time

from rich.console import Group, RenderableType
from rich.table import Table
from rich.text import Text

from gateway.core.line_problem import printable
from gateway.core.messages import BusReport
from gateway.core.status import ChangeStatus, GatewayStatus, LimitsStatus, SpanStatus, Spread, band_n
from gateway.wording.catalogue import sentence

STATE_STYLE = {
    "SILENT": "bold",
    "READY": "bold cyan",
    "RUN": "bold green",
    "HOLD": "bold yellow",
    "STOP": "bold red",
    "UNKNOWN": "bold red",
}
DRIVE_STYLE = {"ENABLED": "green", "READY": "cyan", "OFF": "", "STOPPING": "yellow"}  # all others: red
GOOD_ERROR, POOR_ERROR = 0.05, 0.20  # of the set-point: where a tension is shown green, and where red
FIXED_LINES = 12  # everything but spans and events
LEAST_EVENTS = 3
SHORT = 12  #: letters of a hash
_CLOCK_WIDTH = 8


def render(status: GatewayStatus, width: int, height: int | None = None) -> RenderableType:
    """With a `height` (lines), spans that need no attention and old events give way so that it fits."""
    spans, events = status.spans, len(status.events)
    if height is not None:
        height -= (status.change is not None) + bool(_agents(status)) + bool(status.alarms) + bool(status.unconfirmed)
        height -= bool(_wiring(status)) + bool(status.audit_head)
        room = max(1, height - FIXED_LINES - LEAST_EVENTS)
        if len(spans) > room:
            spans = _urgent(spans, max(1, room - 1), status.limits)
        hidden_line = len(spans) < len(status.spans)
        events = max(0, height - FIXED_LINES - len(spans) - hidden_line)
    parts: list[RenderableType] = [_head(status), Text(), _spans(spans, status.limits, width)]
    if len(spans) < len(status.spans):
        parts.append(Text(f"  and {len(status.spans) - len(spans)} more spans, none in greater need", style="dim"))
    parts += [Text(), _health(status), Text(), _events(status, events, width, height is None)]
    return Group(*parts)


def _head(status: GatewayStatus) -> RenderableType:
    loop = status.loop
    head = Table.grid(expand=True, padding=(0, 1))
    head.add_column()
    head.add_column(justify="right", no_wrap=True)
    title = Text(f"{status.site} / {status.line}", "bold")
    title = Text.assemble(title, "  ", (loop.state, STATE_STYLE.get(loop.state, "")), f"  {loop.text}")
    if loop.held:
        title.append(f"  signal missing for {loop.held} periods", style="bold yellow")
    if loop.saturated:
        title.append("  torque at its limit", style="bold yellow")
    head.add_row(title, clock_time(status.wall_s))
    if status.alarms:
        head.add_row(_alarms(status), "")
    if wiring := _wiring(status):
        head.add_row(Text(wiring, "yellow", no_wrap=True, overflow="ellipsis"), "")
    for one in status.unconfirmed:
        head.add_row(Text(f"Unconfirmed: {sentence(one)}", "yellow", no_wrap=True, overflow="ellipsis"), "")
    for doubt in loop.doubts:
        head.add_row(Text(f"Proposals are blocked: {doubt}", "bold yellow"), "")
    if status.change is not None:
        head.add_row(Text(_change(status.change, status.wall_s), "bold cyan", no_wrap=True, overflow="ellipsis"), "")
    head.add_row(Text(f"Next: {loop.next}", style="italic"), "")
    speed, setpoint = (_number(value, ".4f") for value in (status.unwind_speed_m_per_s, status.speed_setpoint_m_per_s))
    head.add_row(Text(f"Web {speed} m/s, set-point {setpoint} m/s", "" if loop.running else "dim"), "")
    return head


def _wiring(status: GatewayStatus) -> str:
    """Empty where the devices are those that were proved."""
    if status.wiring is None:
        return ""
    if unproved := status.wiring.unproved:
        more = f" and {len(unproved) - 1} more" if unproved[1:] else ""
        return f"Not proved{more}: {sentence(unproved[0])}"
    return "Proved; arming reads whether the devices are still the same" if status.wiring.not_read else ""


def _alarms(status: GatewayStatus) -> Text:
    """One line: `r2rgate alarms` has the rest."""
    shown = [one for one in status.alarms if one.shelved_until_wall_s is None]
    words = [f"{one.means}{'' if one.acknowledged else ' (!)'}" for one in shown]
    if shelved := len(status.alarms) - len(shown):
        words.append(f"{shelved} shelved")
    high = any(one.priority == "high" and one.active for one in shown)
    style = "bold red" if high else "bold yellow" if shown else "dim"
    return Text(f"Alarms: {'; '.join(words)}", style, no_wrap=True, overflow="ellipsis")


def _change(change: ChangeStatus, now_s: float) -> str:
    """What is being done to the line, since when, and what is missing before it is kept."""
    since = "" if change.since_wall_s is None else f" since {max(0.0, now_s - change.since_wall_s):.0f} s"
    what = "on probation" if change.stage == "probation" else change.stage
    missing = f": {printable(change.text)}" if change.text else ""
    return f"{change.kind.capitalize()} {change.proposal[:SHORT]} {what}{since}{missing}"


def _spans(spans: list[SpanStatus], limits: LimitsStatus, width: int) -> RenderableType:
    bar = min(40, max(10, width - 73))
    band = f"{limits.tension_min_n:g}".ljust(bar - len(f"{limits.tension_max_n:g} N")) + f"{limits.tension_max_n:g} N"
    table = Table(box=None, padding=(0, 1, 0, 0), pad_edge=False, header_style="dim")
    table.add_column("span", no_wrap=True, max_width=16)
    table.add_column("tension N", justify="right", no_wrap=True)
    table.add_column("set", justify="right", no_wrap=True)
    table.add_column("error", justify="right", no_wrap=True)
    table.add_column(band, no_wrap=True, width=bar)
    table.add_column("m/s", justify="right", no_wrap=True)
    table.add_column("Nm", justify="right", no_wrap=True)
    table.add_column("given", justify="right", no_wrap=True)  # as the drive reports it; before it: as asked
    table.add_column("drive", no_wrap=True)
    for span in spans:
        style = _span_style(span, limits)
        error = _number(span.error_n, "+.2f") if span.quality == "GOOD" else span.quality
        table.add_row(
            f"{span.number} {span.name}",
            Text(_number(span.tension_n, ".2f"), style),
            _number(span.setpoint_n, ".2f"),
            Text(error, style),
            Text(_bar(span, limits, bar), style),
            _number(span.speed_m_per_s, ".4f"),
            _number(span.torque_nm, ".2f"),
            _number(span.torque_actual_nm, ".2f"),
            Text(span.drive, DRIVE_STYLE.get(span.drive, "red")),
        )
    return table


def _bar(span: SpanStatus, limits: LimitsStatus, width: int) -> str:
    """The band of permitted tension, the set-point in it as a stroke and the tension as a dot."""
    cells = ["\u2500"] * width
    if span.setpoint_n is not None:
        cells[_cell(span.setpoint_n, limits, width)] = "\u2502"
    if span.tension_n is not None:
        least, most = band_n(span, limits)
        beyond = "<" if span.tension_n < least else ">" if span.tension_n > most else ""
        cells[_cell(span.tension_n, limits, width)] = beyond or "\u25cf"
    return "".join(cells)


def _cell(tension_n: float, limits: LimitsStatus, width: int) -> int:
    share = (tension_n - limits.tension_min_n) / (limits.tension_max_n - limits.tension_min_n)
    return round(min(1.0, max(0.0, share)) * (width - 1))


def _span_style(span: SpanStatus, limits: LimitsStatus) -> str:
    if span.quality != "GOOD" or span.tension_n is None or span.error_n is None or not span.setpoint_n:
        return "dim" if span.quality in ("STALE", "MISSING") else "red"
    error = abs(span.error_n) / span.setpoint_n
    least, most = band_n(span, limits)
    if not least <= span.tension_n <= most or error > POOR_ERROR:
        return "red"
    return "green" if error <= GOOD_ERROR else "yellow"


def _urgent(spans: list[SpanStatus], room: int, limits: LimitsStatus) -> list[SpanStatus]:
    """The `room` spans that most need a look, in the line's order. Ranked by class, so that rows do not hop."""
    styles = ("green", "yellow", "dim", "red")
    ranked = sorted(
        spans,
        key=lambda span: (span.drive in DRIVE_STYLE, -styles.index(_span_style(span, limits))),
    )
    return sorted(ranked[:room], key=lambda span: span.number)


def _health(status: GatewayStatus) -> RenderableType:
    timing, link, historian = status.timing, status.link, status.historian
    grid = Table.grid(padding=(0, 2))
    grid.add_column(style="dim", no_wrap=True)
    grid.add_column()
    missed = Text(f"{timing.missed} missed", "bold yellow" if timing.missed else "")
    grid.add_row("cycle", Text.assemble(_spread(timing.cycle), " of ", f"{status.loop.period_s * 1e3:g} ms; ", missed))
    grid.add_row("lateness", f"{_spread(timing.lateness)} over {timing.frames} cycles")
    age = "no frame yet" if status.loop.age_s is None else f"last frame {_duration(status.loop.age_s)} ago"
    lost = Text(
        f"{link.dropped_frames} dropped, {link.malformed} malformed",
        "yellow" if link.dropped_frames or link.malformed else "",
    )
    grid.add_row("telemetry", Text.assemble(age, "; ", lost))
    grid.add_row("buses", _buses(status.buses))
    stored = historian.text
    if historian.storing and historian.last_stored_age_s is not None:
        stored = f"{historian.frames_stored} frames, the last {_duration(historian.last_stored_age_s)} ago"
    if historian.frames_lost:
        stored += f"; {historian.frames_lost} lost"
    if historian.moved_aside:
        stored += f"; a damaged one is kept as {historian.moved_aside}"
    grid.add_row("history", Text(stored, "" if historian.storing else "bold red"))
    if status.audit_head:
        number, _, hash_ = status.audit_head.partition(":")
        grid.add_row("audit", f"head {number}:{hash_[:SHORT]}... (--json has it whole)")
    if agents := _agents(status):
        style = "" if status.agents_bus.open else "yellow"
        grid.add_row("agents", Text(agents, style, no_wrap=True, overflow="ellipsis"))
    return grid


def _agents(status: GatewayStatus) -> str:
    """Who answers questions, or that nobody can; empty: there is no agent."""
    bus = status.agents_bus
    return ", ".join(bus.agents) if bus.open else printable(f"their bus is closed: {bus.text}")


def _buses(buses: list[BusReport]) -> Text:
    """One line: every bus, who is absent, and the last trouble of a bus that has an absent device."""
    words: list[str] = []
    absent = False
    for bus in buses:
        absent = absent or bool(bus.absent)
        lost = f", absent: {', '.join(bus.absent)} ({bus.last_error})" if bus.absent else ""
        words.append(f"{bus.name} {bus.timeouts} late, {bus.malformed} discarded{lost}")
    return Text("; ".join(words) or "not known", "bold red" if absent else "")


def _events(status: GatewayStatus, room: int, width: int, whole: bool) -> RenderableType:
    """Events on `room` lines, a line each. The newest change of state may say why the line has stopped: it takes the
    lines that it needs, on a screen (not `whole`) as far as the least number of events is seen.
    """
    grid = Table.grid(padding=(0, 2))
    grid.add_column(style="dim", no_wrap=True, min_width=_CLOCK_WIDTH)
    grid.add_column(no_wrap=True, overflow="ellipsis")
    told = next((event for event in reversed(status.events) if event.kind == "state"), None)
    for event in reversed(status.events):
        if room <= 0:
            break
        lines = [event.text]
        if event is told:
            most = None if whole else max(1, room - LEAST_EVENTS + 1)
            lines = textwrap.wrap(event.text, max(20, width - _CLOCK_WIDTH - 2)) or lines
            if most is not None and len(lines) > most:
                lines = [*lines[: most - 1], " ".join(lines[most - 1 :])]
        grid.add_row(clock_time(event.wall_s), Text("\n".join(lines)))
        room -= 1 if whole else len(lines)
    if status.events_left_out and room > 0:
        grid.add_row("", Text(f"and {status.events_left_out} older ones: r2rgate export, or the page", "dim"))
    return grid if status.events else Text("no events yet", style="dim")


def _spread(spread: Spread | None) -> str:
    if spread is None:
        return "-"
    return f"p50 {spread.p50_s * 1e3:.2f}, p99 {spread.p99_s * 1e3:.2f}, max {spread.max_s * 1e3:.2f} ms"


def _number(value: float | None, form: str) -> str:
    return "-" if value is None else format(value, form)


def _duration(time_s: float) -> str:
    if time_s < 120.0:
        return f"{time_s:.1f} s"
    return f"{time_s / 60.0:.0f} min" if time_s < 7200.0 else f"{time_s / 3600.0:.0f} h"


def clock_time(wall_s: float) -> str:
    """Of Unix time, here."""
    try:
        return time.strftime("%H:%M:%S", time.localtime(wall_s))
    except (OverflowError, ValueError, OSError):  # a time of another age
        return "--:--:--"
