"""What people need is never blinded: whatever the loop and agents tell, the status lives, is bounded, and plays with
no terminal and no page.
"""

import asyncio
import io
import json
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from rich.console import Console

from gateway.cli.alarms_commands import clock_time
from gateway.cli.proposal_view import print_shown
from gateway.cli.status_commands import parse_status
from gateway.cli.status_view import render
from gateway.core.clean_text import clean, clean_texts, clean_value
from gateway.core.finding import Finding
from gateway.core.messages import BUS_REPORTS, BusReport, Event
from gateway.core.status import GatewayStatus
from gateway.core.telemetry import frame_dtype
from gateway.core.topics import GATEWAY_STATUS, LOOP_BUSES, LOOP_EVENT, LOOP_TELEMETRY
from gateway.mailbox.inprocess import Hub, InProcessMailbox
from gateway.mailbox.port import MAX_PAYLOAD, Counters
from gateway.operator.page.answer import JSONResponse
from gateway.operator.page.tick import tick_of
from gateway.operator.page.told import proposal_told
from gateway.supervisor.historian import Historian
from gateway.supervisor.service import EVENTS_SHOWN, Gateway
from gateway.supervisor.status_payload import status_payload
from gateway.tasks.supervisor import TaskFault
from tests.support.gateway_key import to_loop_over
from tests.unit.alarm_support import status as good_status
from tests.unit.chain_support import shown as proposed
from tests.unit.supervisor_support import frame_of, line_of

PROPOSED = proposed("waiting")

#: What plays with a terminal or a page: escapes of both kinds, bells, marks of direction, halves of a pair.
PLAYS = [
    "\x1b[2J\x1b[31m",
    "\x9b2J",
    "\x07\x08\r",
    "\x00",
    "\u202eliated\u202c",
    "\u200f",
    "\ud800",
    "\udcff",
    "\u2028",
]
TEXTS = st.one_of(st.text(max_size=40), st.sampled_from(PLAYS), st.sampled_from(PLAYS).map(lambda text: 700 * text))
NUMBERS = st.one_of(
    st.floats(), st.integers(), st.sampled_from([10**400, -(10**4000), 2**63, float("nan"), float("inf"), 1e300])
)
VALUES = st.recursive(
    st.none() | st.booleans() | NUMBERS | TEXTS,
    lambda inner: st.lists(inner, max_size=4) | st.dictionaries(TEXTS, inner, max_size=4),
    max_leaves=12,
)
KINDS = st.sampled_from(["state", "alarm", "command", "loop-up"]) | TEXTS
EVENTS = st.fixed_dictionaries(
    {"time_s": NUMBERS, "kind": KINDS, "text": TEXTS, "data": st.dictionaries(TEXTS, VALUES, max_size=4)},
    optional={"findings": st.lists(st.fixed_dictionaries({"code": st.just("x"), "parameters": VALUES}), max_size=3)},
)
REPORT = st.fixed_dictionaries(
    {
        "name": TEXTS, "absent": st.lists(TEXTS, max_size=4), "timeouts": NUMBERS, "malformed": NUMBERS,
        "reconnects": NUMBERS, "last_error": TEXTS,
    }
)  # fmt: skip


class Bench:
    """A gateway at a hub whose historian has no thread, and the loop's side of it."""

    def __init__(self, spans: int = 2) -> None:
        hub = Hub()
        self.now_s = 100.0
        self.loop = InProcessMailbox(hub)
        self.historian = Historian(Path("/var/lib/r2rgate/demo"), "demo", "line", spans)
        line, mailbox = line_of(spans), InProcessMailbox(hub)
        self.gateway = Gateway(
            line, mailbox, to_loop_over(mailbox, line), self.historian, Counters(),
            clock=lambda: self.now_s, wall_clock=lambda: self.now_s + 1_700_000_000.0,
        )  # fmt: skip

    def status(self) -> GatewayStatus:
        """As a command asks for it, and as terminal and page show it: none of that raises, or plays with anything."""
        payload = asyncio.run(self.loop.request(GATEWAY_STATUS, b"", 1.0))
        assert len(payload) <= MAX_PAYLOAD
        found = parse_status(payload)
        require_quiet(shown(found))
        require_quiet(json.dumps(json.loads(JSONResponse(tick_of(found, None, 0)).body), ensure_ascii=False))
        return found


def shown(found: GatewayStatus) -> str:
    screen = io.StringIO()
    Console(file=screen, width=120, color_system=None).print(render(found, 120), render(found, 80, 24))
    return screen.getvalue()


def require_quiet(text: str) -> None:
    assert [c for c in text if not (c.isprintable() or c in "\n\t")] == []


def as_json(value: Any) -> bytes:
    return json.dumps(value).encode()  # with NaN and Infinity, as a hostile sender has it


@pytest.mark.slow
@given(st.lists(EVENTS, max_size=6))
@settings(max_examples=120, deadline=None)
def test_no_event_of_the_loop_blinds_the_status(events: list[dict[str, Any]]) -> None:
    bench = Bench()
    for event in events:
        assert bench.loop.publish(LOOP_EVENT, as_json(event))
    bench.loop.publish(LOOP_EVENT, Event(time_s=100.0, kind="state", text="RUN to STOP").model_dump_json().encode())
    found = bench.status()
    assert found.events[-1].text == "RUN to STOP" and len(found.events) + found.link.malformed == len(events) + 1
    assert all(abs(event.wall_s - found.wall_s) < 40 * 86_400.0 for event in found.events)


@pytest.mark.slow
@given(st.lists(REPORT, max_size=4))
@settings(max_examples=120, deadline=None)
def test_no_report_of_a_bus_blinds_the_status(reports: list[dict[str, Any]]) -> None:
    bench = Bench()
    bench.loop.publish(LOOP_TELEMETRY, frame_of(1, 100.0, 2))
    bench.loop.publish(LOOP_BUSES, as_json(reports))
    found = bench.status()
    assert found.loop.running and (found.link.malformed == 1 or len(found.buses) == len(reports))
    assert all(0 <= one.timeouts <= 2**53 for one in found.buses)


@pytest.mark.slow
@given(st.binary(min_size=frame_dtype(2).itemsize - 2, max_size=frame_dtype(2).itemsize - 2))
@settings(max_examples=150, deadline=None)
def test_no_frame_blinds_the_status(body: bytes) -> None:
    bench = Bench()
    whole = frame_of(1, 100.0, 2)
    for payload in (whole[:2] + body, whole[:12] + body[10:], whole, body):
        bench.loop.publish(LOOP_TELEMETRY, payload)
        bench.status()
    assert bench.gateway.status().link.malformed >= 1


@pytest.mark.slow
def test_frames_of_times_that_never_grow_old_are_bounded() -> None:
    bench = Bench()
    for sequence in range(30_000):
        bench.loop.publish(LOOP_TELEMETRY, frame_of(sequence, 1e300 if sequence == 0 else 100.0, 2))
    assert bench.status().timing.frames <= 20_000


@pytest.mark.slow
@given(VALUES, TEXTS)
@settings(max_examples=150, deadline=None)
def test_what_the_gateway_notes_itself_is_bounded_too(value: Any, text: str) -> None:
    bench = Bench()
    bench.gateway.note("note", text, value=value)
    bench.gateway.task_faults = lambda: [TaskFault("gate", text, text, 1.0, 2.0, 3, 1)]
    assert bench.status().events[-1].kind == "note"


def test_a_status_that_grows_too_long_sheds_its_oldest_events_and_says_how_many() -> None:
    bench = Bench()
    parameters = {f"p{k}": 199 * "\u20ac" for k in range(16)}
    findings = [Finding(code="x", parameters=parameters) for _ in range(8)]
    for number in range(EVENTS_SHOWN):
        event = Event(time_s=100.0, kind="alarm", text=f"number {number}", findings=findings)
        assert bench.loop.publish(LOOP_EVENT, event.model_dump_json().encode())
    found = bench.status()
    assert 0 < len(found.events) < EVENTS_SHOWN and found.events_left_out == EVENTS_SHOWN - len(found.events)
    assert found.events[-1].text == f"number {EVENTS_SHOWN - 1}"


def test_a_status_without_an_event_that_is_too_long_sheds_what_is_told_of_buses_tasks_and_alarms() -> None:
    buses = [
        BusReport(name=f"bus-{k}", absent=200 * [100 * "x"], timeouts=0, malformed=0, reconnects=0, last_error="x")
        for k in range(64)
    ]  # fmt: skip
    status = good_status(buses=buses)
    payload = status_payload(status)
    assert len(payload) < MAX_PAYLOAD and len(GatewayStatus.model_validate_json(payload).buses) == 64


def test_the_most_that_a_loop_may_tell_of_its_buses_fits() -> None:
    bench = Bench()
    bench.loop.publish(LOOP_TELEMETRY, frame_of(1, 100.0, 2))
    report = BusReport(name="b", absent=["d"] * 5000, timeouts=0, malformed=0, reconnects=0, last_error=9000 * "x")
    bench.loop.publish(LOOP_BUSES, BUS_REPORTS.dump_json([report] * 3))
    found = bench.status()
    assert [len(one.absent) for one in found.buses] == [201, 201, 201] and found.buses[0].absent[-1] == "and 4800 more"


@pytest.mark.slow
@given(TEXTS, TEXTS, TEXTS)
@settings(max_examples=60, deadline=None)
def test_a_proposal_of_an_agent_plays_with_no_terminal_and_no_page(author: str, why: str, reason: str) -> None:
    proposal = PROPOSED.proposal.model_copy(update={"author": author, "reason": reason})
    found = PROPOSED.model_copy(update={"proposal": proposal, "why": why, "difference": [reason]})
    screen = io.StringIO()
    print_shown(found, Console(file=screen, width=100, color_system=None))
    require_quiet(screen.getvalue())
    require_quiet(json.dumps(json.loads(JSONResponse(proposal_told(found)).body), ensure_ascii=False))


@given(VALUES)
@settings(max_examples=200, deadline=None)
def test_a_cleaned_value_is_json_and_quiet(value: Any) -> None:
    for found in (clean_value(value), clean_texts(value)):
        require_quiet(json.dumps(found, ensure_ascii=False, allow_nan=False).encode().decode())


@given(TEXTS, st.integers(min_value=0, max_value=50))
def test_a_cleaned_text_is_bounded_and_harmless_texts_stay(text: str, most: int) -> None:
    assert len(clean(text, most)) <= 6 * most + 40
    if text.isprintable() and len(text) <= most:
        assert clean(text, most) == text


@pytest.mark.parametrize("wall_s", [1e300, -1e300, 1e18, float("inf"), float("nan")])
def test_a_time_of_another_age_is_no_traceback(wall_s: float) -> None:
    assert clock_time(wall_s) == "--:--:--"
