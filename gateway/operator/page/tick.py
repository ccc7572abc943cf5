"""What the page shows ten times a second, made once for all who look: the status, compact, and what is abnormal in it.

What counts as abnormal is said here, in one place; the page only paints it.
"""

from typing import Any

from gateway.core.alarms import AlarmStatus
from gateway.core.decisions import ProposalList
from gateway.core.finding import Finding
from gateway.core.line import Line
from gateway.core.line_limits import setpoint_bands_n
from gateway.core.status import EventStatus, GatewayStatus, LimitsStatus, SpanStatus, band_n
from gateway.wording.catalogue import languages, sentence

DRIVES_THAT_FAIL = frozenset({"ABSENT", "STOPPING", "FAULT", "STO"})
IN_MOTION = frozenset({"RUN", "HOLD"})  #: states in which tensions are controlled
OFF_SHARE = 0.2  #: of the set-point: a tension farther off is told. As the alarm has it, without its delay


def line_told(line: Line) -> dict[str, Any]:
    """What never changes while the process runs."""
    low, high = setpoint_bands_n(line)
    return {
        "site": line.site,
        "line": line.line,
        "description": line.description,
        "n": line.n,
        "period_s": line.control.period_s,
        "tension_n": [line.limits.tension_min_n, line.limits.tension_max_n],
        "setpoint_n": [list(band) for band in zip(low.tolist(), high.tolist(), strict=True)],
        "torque_nm": line.limits.torque_nm,
        "speed_max_m_per_s": line.limits.speed_max_m_per_s,
        "spans": [{"name": span.name, "control": span.control} for span in line.spans],
        "rollers": [roller.name for roller in line.rollers],
        "recipes": [recipe.model_dump() for recipe in line.recipes],
    }


def tick_of(status: GatewayStatus, proposals: ProposalList | None, revision: int) -> dict[str, Any]:
    """Of a status, as a JSON object. `revision` is another where the proposals are others than before."""
    loop, moving = status.loop, status.loop.state in IN_MOTION
    return {
        "wall_s": status.wall_s,
        "loop": loop.model_dump(exclude={"next"}),
        "speed": _short(status.unwind_speed_m_per_s),
        "speed_setpoint": _short(status.speed_setpoint_m_per_s),
        "stands": status.stands,
        "before_more": [_in_words(one) for one in _before_more(status)],
        "unconfirmed": bool(status.unconfirmed),
        "wiring_not_read": status.wiring is not None and status.wiring.not_read,
        "proved_wall_s": None if status.wiring is None else status.wiring.proved_wall_s,
        "change": None if status.change is None else status.change.model_dump(),
        "spans": [
            [
                _short(span.tension_n, 2),
                _short(span.setpoint_n, 2),
                _short(span.speed_m_per_s),
                _short(span.torque_nm, 2),
                *abnormal(span, status.limits, moving),
            ]
            for span in status.spans
        ],
        "timing": status.timing.model_dump(),
        "link": status.link.model_dump(),
        "buses": [bus.model_dump() for bus in status.buses],
        "agents": status.agents_bus.model_dump(),
        "historian": status.historian.model_dump(include={"storing", "text", "frames_lost", "events_lost"}),
        "events": [_told(event) for event in status.events[-20:]],
        "alarms": [_told(alarm) for alarm in status.alarms],
        "audit_head": status.audit_head,
        "revision": revision,
        "waiting": [one.proposal for one in proposals.proposals if one.stage == "waiting"] if proposals else [],
    }


def _before_more(status: GatewayStatus) -> list[Finding]:
    """What a person has to do before the line starts, or goes faster."""
    return [*([] if status.wiring is None else status.wiring.unproved), *status.unconfirmed]


def _in_words(one: Finding) -> dict[str, Any]:
    return {"text": sentence(one), "said": {language: sentence(one, language) for language in languages()[1:]}}


def _told(one: EventStatus | AlarmStatus) -> dict[str, Any]:
    """With its text in the other languages, `said`, where what was found stands in it.

    Not all need stand there: what stops the line is told with what was found beside it.
    """
    said = dict[str, str]()
    for language in languages()[1:]:
        text = one.text
        for found in one.findings:
            text = text.replace(sentence(found), sentence(found, language))
        if text != one.text:
            said[language] = text
    return {**one.model_dump(), "said": said}


def abnormal(span: SpanStatus, limits: LimitsStatus, moving: bool) -> tuple[str, str]:
    """(how bad: "", "attention" or "alarm"; which: a word of the catalogue). The worst comes first.

    Where the line does not move, drives may be off and tensions anything; on the way from a slack web, too. A value
    that is not good is told everywhere: at rest somebody may rely on it to reach in. Where only the speed is
    controlled there may be no load cell: that there is no value is said, and nothing is wrong.
    """
    if span.drive == "FAULT" or (moving and span.drive in DRIVES_THAT_FAIL):
        return "alarm", f"drive.{span.drive}"
    if span.quality != "GOOD":
        return _how_bad(span, moving), f"quality.{'MISSING' if span.tension_n is None else span.quality}"
    if span.control != "tension" or not moving:
        return "", ""
    if span.tension_n is None or span.setpoint_n is None:
        return "", ""
    return _off(span.tension_n, span.setpoint_n, band_n(span, limits))


def _how_bad(span: SpanStatus, moving: bool) -> str:
    """A value that is not good."""
    if span.control == "tension":
        return "alarm" if moving else "attention"
    return "" if span.tension_n is None else "attention"


def _off(tension_n: float, setpoint_n: float, band: tuple[float, float]) -> tuple[str, str]:
    least, most = band
    if least <= setpoint_n <= most and not least <= tension_n <= most:
        return "alarm", "span.outside"
    if abs(tension_n - setpoint_n) > OFF_SHARE * setpoint_n > 0.0:
        return "attention", "span.off"
    return "", ""


def _short(value: float | None, digits: int = 4) -> float | None:
    return None if value is None else round(value, digits)
