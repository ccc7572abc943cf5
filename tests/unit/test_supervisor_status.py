"""The status and the service behind it, on an in-process mailbox with a clock of the test's own."""

import asyncio
import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from pydantic import ValidationError

from gateway.core.alarms import BY_NAME, AlarmStatus
from gateway.core.finding import Finding, finding
from gateway.core.messages import Arm, Command, Event, Reply
from gateway.core.proof import Introduction, Proof
from gateway.core.signals import DriveState, Quality
from gateway.core.states import LoopState, Phase
from gateway.core.status import BusStatus, GatewayStatus
from gateway.core.telemetry import VERSION
from gateway.core.topics import GATEWAY_COMMAND, GATEWAY_STATUS, LOOP_COMMAND, LOOP_EVENT, LOOP_HELLO, LOOP_TELEMETRY
from gateway.mailbox.inprocess import Hub, InProcessMailbox
from gateway.mailbox.port import MAX_PAYLOAD, PEER, Counters, Peer
from gateway.supervisor.historian import Health, Historian
from gateway.supervisor.service import EVENTS_SHOWN, SAID_SHOWN, TEXT_SHOWN, Gateway, nothing_found
from gateway.supervisor.status import LOST_S, WORDS
from gateway.tasks.supervisor import TaskFault
from tests.support.gateway_key import door_of, to_loop_over
from tests.unit.supervisor_support import frame_of, line_of

DOCS = Path(__file__).parents[2] / "docs"
WALL_AHEAD_S = 1_700_000_000.0


class KeptHistory(Historian):
    """A historian without a thread that shows what it was given."""

    def __init__(self, spans: int) -> None:
        super().__init__(Path("/var/lib/r2rgate/demo"), "demo", "line", spans)
        self.frames: list[bytes] = []
        self.events: list[Event] = []
        self.told = Health(True, "storing", frames_stored=1000, last_stored_s=99.5)

    def frame(self, payload: bytes) -> None:
        self.frames.append(payload)

    def event(self, event: Event) -> None:
        self.events.append(event)

    def health(self) -> Health:
        return self.told


class Behind:
    """A loop behind its door, which always says the same."""

    def __init__(self, reply: Reply) -> None:
        self.reply = reply
        self.heard: list[Command] = []

    async def submit(self, command: Command, proof: Proof | None = None) -> Reply:
        self.heard.append(command)
        return self.reply

    def refused(self, text: str, reasons: Sequence[object] = ()) -> Reply:
        return Reply(ok=False, state="SILENT", text=text)


class Bench:
    """A gateway at a hub, and the loop's side of it."""

    def __init__(self, spans: int = 6) -> None:
        hub = Hub()
        self.now_s = 100.0
        self.wall_ahead_s = WALL_AHEAD_S
        self.loop = InProcessMailbox(hub)
        self.historian = KeptHistory(spans)
        self.gateway = Gateway(
            line_of(spans),
            InProcessMailbox(hub),
            to_loop_over(InProcessMailbox(hub), line_of(spans), lambda: self.now_s),
            self.historian,
            Counters(),
            clock=lambda: self.now_s,
            wall_clock=lambda: self.now_s + self.wall_ahead_s,
        )

    def say(self, kind: str, text: str) -> None:
        event = Event(time_s=self.now_s, kind=kind, text=text, data={"torque_nm": 3.0})
        assert self.loop.publish(LOOP_EVENT, event.model_dump_json().encode())

    def run_loop(self, cycles: int, first: int = 0, **changes: Any) -> None:
        for k in range(first, first + cycles):
            self.now_s = round(self.now_s + 0.01, 6)
            assert self.loop.publish(LOOP_TELEMETRY, frame_of(k, self.now_s, **changes))

    def command(self, payload: bytes) -> Reply:
        answer = asyncio.run(self.loop.request(GATEWAY_COMMAND, payload, 1.0))
        return Reply.model_validate_json(answer)


def of(pid: int, payload: bytes, bench: Bench) -> Reply:
    """As a local process says it."""
    token = PEER.set(Peer(1000, pid))
    try:
        return bench.command(payload)
    finally:
        PEER.reset(token)


@pytest.mark.slow
def test_whoever_floods_the_gateway_with_commands_puts_no_other_event_out_of_the_status_and_history() -> None:
    bench = Bench()
    bench.say("state", "RUN to STOP: tension 3 is beyond its limit")
    replies = [of(4000 + k % 3, b'{"command":"speed","speed_m_per_s":0.%d}' % k, bench) for k in range(1000)]
    codes = {one.code for reply in replies for one in reply.findings}
    assert "inbox-rate" in codes and len([one for one in bench.historian.events if one.kind == "command"]) < 140
    shown = bench.gateway.status().events
    assert shown[0].kind == "state" and sum(one.kind == "command" for one in shown) == SAID_SHOWN
    for k in range(EVENTS_SHOWN):
        bench.say("state", f"change {k}")
    shown = bench.gateway.status().events
    assert len(shown) == EVENTS_SHOWN and shown[-1].text == f"change {EVENTS_SHOWN - 1}"
    bench.now_s += 1.0
    assert not of(4000, b'{"command":"arm"}', bench).findings  # its share comes back


@pytest.mark.parametrize("safe", [b'{"command":"stop"}', b'{"command":"hold"}'])
def test_stop_and_hold_are_never_held_back_and_are_counted_where_they_are_said_without_end(safe: bytes) -> None:
    bench = Bench()
    for k in range(300):
        of(4000, b'{"command":"speed","speed_m_per_s":0.%d}' % k, bench)
    noted = len(bench.historian.events)
    answers = [of(4000 + k, safe, bench) for k in range(300)]
    assert not any(one.code == "inbox-rate" for reply in answers for one in reply.findings)
    assert len({reply.text for reply in answers}) == 1
    assert len(bench.historian.events) - noted <= 4  # one event tells of many
    bench.now_s += 60.0
    of(5000, safe, bench)
    assert bench.historian.events[-1].data["left_out"] > 290


def test_without_a_loop_it_says_so_and_what_to_do() -> None:
    status = Bench().gateway.status()
    assert not status.loop.running
    assert status.loop.state == "UNKNOWN"
    assert "loop not running" in status.loop.text
    assert "r2rgate loop" in status.loop.next
    assert status.loop.age_s is None
    assert [span.tension_n for span in status.spans] == [None] * 6
    assert {span.quality for span in status.spans} == {"MISSING"}
    assert status.timing.cycle is None


def test_a_loop_of_another_version_is_none_that_is_gone() -> None:
    bench = Bench()
    older = bytearray(frame_of(0, 0.01))
    older[:2] = (VERSION - 1).to_bytes(2, "little")
    for payload in (bytes(older), bytes(older[:-3])):
        assert bench.loop.publish(LOOP_TELEMETRY, payload)
        told = bench.gateway.status().loop
        assert not told.running and told.state == told.phase == "UNKNOWN"
        assert f"of version {VERSION - 1}, this program reads {VERSION}: it may run" in told.text
        assert "start the loop anew" in told.next
    bench.run_loop(1, phase=Phase.OFF, by_person=True, standstill=True)
    told = bench.gateway.status().loop
    assert (told.running, told.phase, told.by_person, told.standstill) == (True, "OFF", True, True)


def test_what_the_loop_says_is_what_the_status_says() -> None:
    bench = Bench()
    bench.run_loop(50, state=LoopState.HOLD, held=2, saturated=True)
    bench.run_loop(
        1,
        first=50,
        tension_n=np.array([21.5, 22, 23, 24, 25, 26]),
        tension_setpoint_n=np.full(6, 20.0),
        torque_nm=np.arange(6) + 0.5,
        torque_actual_nm=np.arange(6) + 0.25,
        drive_state=np.array([3, 3, 5, 6, 1, 3], np.int8),
        tension_quality=np.array([0, 0, 1, 2, 3, 0], np.int8),
    )
    status = bench.gateway.status()
    span = status.spans[0]
    assert (status.loop.running, status.loop.state, status.loop.age_s) == (True, "RUN", 0.0)
    assert (span.number, span.tension_n, span.setpoint_n, span.error_n) == (1, 21.5, 20.0, 1.5)
    assert (span.torque_nm, span.torque_actual_nm) == (0.5, 0.25)
    assert [span.drive for span in status.spans] == ["ENABLED", "ENABLED", "FAULT", "STO", "OFF", "ENABLED"]
    assert [span.quality for span in status.spans] == ["GOOD", "GOOD", "STALE", "BAD", "MISSING", "GOOD"]
    assert status.link.frames == len(bench.historian.frames) == 51


def test_every_state_has_words_and_a_next_step() -> None:
    assert set(WORDS) == {state.name for state in LoopState} | {"UNKNOWN"}
    bench = Bench()
    for k, state in enumerate(LoopState):
        bench.run_loop(1, first=k, state=state)
        assert bench.gateway.status().loop.state == state.name


def test_values_that_are_none_and_codes_that_are_unknown_are_told_as_such() -> None:
    bench = Bench()
    bench.run_loop(
        1,
        state=77,
        tension_n=np.array([np.nan, np.inf, 1, 2, 3, 4]),
        drive_state=np.full(6, 99, np.int8),
        tension_quality=np.full(6, -1, np.int8),
        unwind_speed_m_per_s=np.nan,
        lateness_s=np.nan,
    )
    status = bench.gateway.status()
    assert [status.spans[k].tension_n for k in (0, 1, 2)] == [None, None, 1.0]
    assert status.spans[0].error_n is None
    assert status.loop.state == status.spans[0].drive == status.spans[0].quality == "UNKNOWN"
    assert status.unwind_speed_m_per_s is None
    assert status.timing.lateness is None
    assert "NaN" not in status.model_dump_json()


def test_a_loop_that_stops_is_noticed_after_a_second_and_its_values_become_stale() -> None:
    bench = Bench()
    bench.run_loop(10)
    bench.gateway.watch()
    bench.now_s += LOST_S
    assert bench.gateway.status().loop.running
    bench.now_s += 0.01
    bench.gateway.watch()
    bench.gateway.watch()
    status = bench.gateway.status()
    assert not status.loop.running
    assert {span.quality for span in status.spans} == {Quality.STALE.name}
    assert {span.drive for span in status.spans} == {DriveState.ABSENT.name}
    assert status.spans[0].tension_n is not None
    assert status.timing.frames == 0
    assert [event.kind for event in bench.historian.events] == ["loop-up", "loop-lost"]


def test_gaps_are_dropped_frames_and_a_new_count_is_a_restart() -> None:
    bench = Bench()
    bench.run_loop(5)
    bench.run_loop(5, first=8)
    assert bench.gateway.status().link.dropped_frames == 3
    bench.run_loop(5, first=0)
    status = bench.gateway.status()
    assert (status.link.dropped_frames, status.loop.restarts, status.timing.frames) == (3, 1, 5)
    bench.run_loop(2, first=2**32 - 1)  # the counter's end is no gap
    assert bench.gateway.status().loop.restarts == 2
    assert bench.gateway.status().link.dropped_frames == 3


def test_percentiles_are_those_of_the_last_ten_seconds() -> None:
    bench = Bench()
    bench.run_loop(500, cycle_s=0.5, missed=4)
    for k in range(1001):
        bench.run_loop(1, first=500 + k, cycle_s=k * 1e-6, lateness_s=1e-4, missed=4 + (k >= 900))
    timing = bench.gateway.status().timing
    assert timing.frames == 1001
    assert timing.cycle is not None
    assert timing.lateness is not None
    assert timing.cycle.p50_s == pytest.approx(500e-6, abs=1e-9)
    assert timing.cycle.p99_s == pytest.approx(990e-6, abs=1e-9)
    assert timing.cycle.max_s == pytest.approx(1000e-6, abs=1e-9)
    assert timing.lateness.p50_s == pytest.approx(1e-4, abs=1e-7)
    assert (timing.missed, timing.missed_total) == (1, 5)


@pytest.mark.parametrize(
    "payload",
    [
        b"",
        b"rubbish",
        frame_of(1, 1.0)[:-1],
        frame_of(1, 1.0, spans=5),
        frame_of(1, float("nan")),
        b"\xff\x00" + frame_of(1, 1.0)[2:],
        frame_of(1, 1.0)[:2] + b"\x05\x00" + frame_of(1, 1.0)[4:],
    ],
)
def test_a_malformed_frame_is_counted_and_not_kept(payload: bytes) -> None:
    bench = Bench()
    bench.loop.publish(LOOP_TELEMETRY, payload)
    assert bench.gateway.status().link.malformed == 1
    assert bench.historian.frames == []


def test_events_are_kept_all_and_shown_the_last() -> None:
    bench = Bench()
    for k in range(30):
        bench.say("state", f"event {k}")
    bench.loop.publish(LOOP_EVENT, b'{"time_s": NaN, "kind": "x", "text": "y"}')
    bench.loop.publish(LOOP_EVENT, b"rubbish")
    status = bench.gateway.status()
    assert len(bench.historian.events) == 30
    assert [event.text for event in status.events] == [f"event {k}" for k in range(30 - EVENTS_SHOWN, 30)]
    assert status.events[0].wall_s == 100.0 + WALL_AHEAD_S
    assert status.link.malformed == 2


def test_a_command_is_passed_on_and_remembered_with_who_gave_it() -> None:
    bench = Bench()
    loop = Behind(Reply(ok=False, state="SILENT", text="no permissive", reasons=["permissive"]))
    door = door_of(loop, line_of(), lambda: bench.now_s)
    bench.loop.serve(LOOP_COMMAND, door.command)
    bench.loop.serve(LOOP_HELLO, door.introduce)
    payload = Arm().model_dump_json().encode()
    token = PEER.set(Peer(uid=0, pid=4711))
    try:
        reply = bench.command(payload)
    finally:
        PEER.reset(token)
    door.close()
    assert loop.heard == [Arm()]
    assert (reply.ok, reply.text, reply.reasons) == (False, "no permissive", ["permissive"])
    (event,) = bench.historian.events
    assert event.kind == "command"
    assert event.text.startswith("root: ")
    assert "refused: no permissive" in event.text
    assert event.data["uid"] == 0
    assert event.data["pid"] == 4711
    assert event.data["reply"] == reply.model_dump()
    assert json.loads(event.data["command"]) == {"command": "arm"}


def test_nothing_is_armed_or_started_on_what_no_record_explains_and_all_else_is_passed_on() -> None:
    bench = Bench()
    loop = Behind(Reply(ok=True, state="SILENT", text="done"))
    door = door_of(loop, line_of(), lambda: bench.now_s)
    bench.loop.serve(LOOP_COMMAND, door.command)
    bench.loop.serve(LOOP_HELLO, door.introduce)
    strange = [finding("configuration-unexplained", configuration="c0ffee", epoch=7)]
    bench.gateway.not_to_be_armed = lambda: strange
    for command in ("arm", "start"):
        reply = bench.command(b'{"command": "%s"}' % command.encode())
        assert not reply.ok and reply.findings == strange and "r2rgate confirm c0ffee" in reply.text
    assert bench.command(b'{"command": "stop"}').ok and bench.command(b'{"command": "hold"}').ok
    bench.gateway.not_to_be_armed = list
    unknown = [finding("configuration-not-looked-at", because="the disk is full")]

    async def not_yet() -> list[Finding]:
        return unknown

    bench.gateway.hold_against_records = not_yet
    for command in ("arm", "start"):
        reply = bench.command(b'{"command": "%s"}' % command.encode())
        assert not reply.ok and reply.findings == unknown
    bench.gateway.hold_against_records = nothing_found
    assert bench.command(b'{"command": "arm"}').ok
    door.close()
    assert [one.command for one in loop.heard] == ["stop", "hold", "arm"]


def test_a_command_that_is_none_never_reaches_the_loop_and_one_without_a_loop_says_what_to_start() -> None:
    bench = Bench()
    reply = bench.command(b'{"command": "arm"}')
    assert not reply.ok
    assert "loop not running: start it with `r2rgate loop" in reply.text

    async def loop(_: bytes) -> bytes:
        return b"no reply at all"

    async def introduce(_: bytes) -> bytes:
        return Introduction(loop="0" * 32, pid=1).model_dump_json().encode()

    bench.loop.serve(LOOP_COMMAND, loop)
    bench.loop.serve(LOOP_HELLO, introduce)
    for payload in (b"", b"\xff", b'{"command": "fly"}', b'{"command": "arm", "command": "stop"}', b"[" * 5000):
        assert not bench.command(payload).ok
        assert "not understood" in bench.command(payload).text
    assert "no reply" in bench.command(b'{"command": "arm"}').text
    assert {event.kind for event in bench.historian.events} == {"command"}


def test_a_historian_that_stops_and_goes_on_is_an_event() -> None:
    bench = Bench()
    bench.gateway.watch()
    assert bench.historian.events == []
    bench.historian.told = Health(False, "not storing: the disk is full")
    bench.gateway.watch()
    bench.gateway.watch()
    status = bench.gateway.status()
    assert not status.historian.storing
    assert status.historian.text == "not storing: the disk is full"
    bench.historian.told = Health(True, "storing")
    bench.gateway.watch()
    assert [event.text for event in bench.historian.events] == [
        "the historian is not storing: the disk is full",
        "the historian is storing",
    ]


def test_the_largest_status_fits_a_message() -> None:
    bench = Bench(60)
    bench.run_loop(3, spans=60)
    for _ in range(EVENTS_SHOWN):
        bench.say("state", "\u20ac" * (2 * TEXT_SHOWN))
    answer = asyncio.run(bench.loop.request(GATEWAY_STATUS, b"", 1.0))
    assert len(answer) < 0.8 * MAX_PAYLOAD
    assert len(GatewayStatus.model_validate_json(answer).spans) == 60


def example() -> GatewayStatus:
    bench = Bench()
    bench.gateway.note("gateway-up", "the gateway has started")
    bench.say("state", "TENSIONING to RUNNING")
    bench.run_loop(100)
    bench.gateway.watch()
    bench.gateway.agents_bus = lambda: BusStatus(open=True, text="", agents=["sysid"], refused=0)
    row = BY_NAME["load-cell"]
    bench.gateway.alarms = lambda: [
        AlarmStatus(
            name=row.name, priority=row.priority, means=row.means, text="span 3 nip: STALE", cause=row.cause,
            consequence=row.consequence, action=row.action, active=True, acknowledged=True, first_out=False,
            since_wall_s=WALL_AHEAD_S + 98.0, ended_wall_s=None, acknowledged_by="anna (operator, page)",
            shelved_until_wall_s=None,
        )
    ]  # fmt: skip
    bench.gateway.task_faults = lambda: [TaskFault("gate", "KeyError", "'x'", 97.0, 99.0, 8, 1)]
    return bench.gateway.status()


def test_schema_and_example_are_those_of_the_code() -> None:
    schema = json.loads((DOCS / "schemas" / "status.schema.json").read_text())
    assert schema == GatewayStatus.model_json_schema()
    shown = (DOCS / "examples" / "status.json").read_text()
    assert GatewayStatus.model_validate_json(shown) == example()


@pytest.mark.parametrize(
    ("path", "value"),
    [(("format",), 2), (("format",), True), (("surprise",), 1), (("loop", "age_s"), "1"), (("wall_s",), float("nan"))],
)
def test_a_status_that_is_not_quite_one_is_refused(path: tuple[str, ...], value: object) -> None:
    document = json.loads(example().model_dump_json())
    part = document
    for key in path[:-1]:
        part = part[key]
    part[path[-1]] = value
    with pytest.raises(ValidationError):
        GatewayStatus.model_validate_json(json.dumps(document))


def test_a_wall_clock_that_is_set_is_noted_once_and_changes_nothing() -> None:
    bench = Bench()
    bench.gateway.watch()
    assert not [event for event in bench.historian.events if event.kind == "wall-clock"]
    bench.wall_ahead_s -= 3600.0
    for _ in range(3):
        bench.now_s += 0.2
        bench.gateway.watch()
    (noted,) = [event for event in bench.historian.events if event.kind == "wall-clock"]
    assert "back by 3600.0 s" in noted.text and noted.data == {"moved_s": pytest.approx(-3600.0)}
    bench.wall_ahead_s += 0.4
    bench.gateway.watch()
    assert len([event for event in bench.historian.events if event.kind == "wall-clock"]) == 1


if __name__ == "__main__":  # writes the two documents anew
    (DOCS / "schemas" / "status.schema.json").write_text(json.dumps(GatewayStatus.model_json_schema(), indent=2) + "\n")
    (DOCS / "examples" / "status.json").write_text(example().model_dump_json(indent=2) + "\n")
