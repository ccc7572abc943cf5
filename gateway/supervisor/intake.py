"""What the loop tells, taken in: bounded in length, count, time and letters, whatever it is. Nothing here raises.

What is taken here goes to the history, to the status, to pages and terminals. A value that cannot be shown must not
keep a person from seeing the others.
"""

from collections.abc import Sequence
from math import isfinite

from pydantic import ValidationError

from gateway.core.clean_text import LARGEST_INTEGER, clean, clean_value
from gateway.core.finding import MOST_PARAMETERS, Finding
from gateway.core.messages import BUS_REPORTS, BusReport, Event

LONGEST_KIND, LONGEST_TEXT, LONGEST_NAME = 60, 4000, 100  #: characters
LONGEST_DATA = 65_536  #: bytes of an event's numbers, as JSON
MOST_FINDINGS, MOST_BUSES, MOST_ABSENT = 64, 64, 200
AHEAD_S = 60.0  #: an event may be so far ahead of this process' clock
BEHIND_S = 30 * 86_400.0  #: and so far behind


def event_of(payload: bytes, now_s: float) -> Event | None:
    """The event in `payload`, bounded; None: it is none."""
    try:
        return bounded_event(Event.model_validate_json(payload), now_s)
    except (ValidationError, RecursionError, UnicodeError):
        return None


def bounded_event(event: Event, now_s: float) -> Event:
    """`event` within the bounds. One of an impossible time gets `now_s`, and says what it was told."""
    data = clean_value(event.data)
    time_s = event.time_s
    if not (isfinite(time_s) and now_s - BEHIND_S <= time_s <= now_s + AHEAD_S):
        time_s, data = now_s, {**data, "told_time_s": str(event.time_s)}
    bounded = Event.model_construct(
        time_s=time_s, kind=clean(event.kind, LONGEST_KIND), text=clean(event.text, LONGEST_TEXT),
        findings=_bounded_findings(event.findings), data=data,
    )  # fmt: skip
    if event.data and len(bounded.model_dump_json(include={"data"})) > LONGEST_DATA:
        bounded = bounded.model_copy(update={"data": {"left_out": f"more than {LONGEST_DATA} bytes"}})
    return bounded


def bus_reports_of(payload: bytes) -> list[BusReport] | None:
    """The reports in `payload`, bounded; None: there are none."""
    try:
        reports = BUS_REPORTS.validate_json(payload)
    except (ValidationError, RecursionError, UnicodeError):
        return None
    return [_bounded_report(report) for report in reports[:MOST_BUSES]]


def _bounded_report(report: BusReport) -> BusReport:
    absent = [clean(name, LONGEST_NAME) for name in report.absent[:MOST_ABSENT]]
    if (more := len(report.absent) - MOST_ABSENT) > 0:
        absent.append(f"and {more} more")
    return BusReport.model_construct(
        name=clean(report.name, LONGEST_NAME), absent=absent, timeouts=_count(report.timeouts),
        malformed=_count(report.malformed), reconnects=_count(report.reconnects),
        last_error=clean(report.last_error, LONGEST_TEXT),
    )  # fmt: skip


def _bounded_findings(findings: Sequence[Finding]) -> list[Finding]:
    """Codes have their form already; of the parameters names and texts are bounded here."""
    found: list[Finding] = []
    for one in findings[:MOST_FINDINGS]:
        some = list(one.parameters.items())[:MOST_PARAMETERS]
        parameters = {clean(name, LONGEST_NAME): clean_value(value) for name, value in some}
        found.append(Finding.model_construct(code=one.code, parameters=parameters))
    return found


def _count(value: int) -> int:
    """A count that is shown, never used: at least none, at most what a page still tells exactly."""
    return min(max(value, 0), LARGEST_INTEGER)
