"""What the gateway does with its messages: telemetry and events into history and status, status to whoever asks,
commands on to the loop, with who gave them, into the events.
"""

import time
from collections import deque
from collections.abc import Callable
from math import isfinite
from typing import Any

from pydantic import ValidationError

from gateway.core.alarms import AlarmStatus
from gateway.core.audit_record import Who
from gateway.core.line import Line
from gateway.core.messages import (
    BUS_REPORTS,
    Arm,
    BusReport,
    Deploying,
    Event,
    MalformedMessage,
    Reply,
    RunExperiment,
    in_words,
    parse_command,
)
from gateway.core.status import (
    BusStatus,
    ChangeStatus,
    EventStatus,
    GatewayStatus,
    HistorianStatus,
    LimitsStatus,
    LinkStatus,
    TaskFaultStatus,
)
from gateway.core.telemetry import Frame
from gateway.core.topics import GATEWAY_COMMAND, GATEWAY_STATUS, LOOP_BUSES, LOOP_COMMAND, LOOP_EVENT, LOOP_TELEMETRY
from gateway.mailbox.port import PEER, Counters, Mailbox, NotSent, Unreachable
from gateway.supervisor.historian import Historian
from gateway.supervisor.peers import who_of
from gateway.supervisor.recent import Recent
from gateway.supervisor.status import known, loop_status, span_statuses, timing_status
from gateway.supervisor.telemetry_sink import TelemetrySink
from gateway.tasks.supervisor import TaskFault

LOOP_TIME_S = 2.5  #: for the loop to answer a command
ARM_TIME_S = 14.0  #: arming configures every drive and reads its watchdog back
WALL_CLOCK_JUMP_S = 0.5  #: between two looks; less is a clock that is being disciplined
EVENTS_SHOWN = 20
NO_BUS = BusStatus(open=False, text="it is about to be opened", agents=[], refused=0)
FINDINGS_SHOWN = 8  #: of an event in the status
TEXT_SHOWN = 300  #: characters of an event's text in the status; the history keeps all


class Gateway:
    """Handlers on a mailbox, and what they remember. Sockets, signals and threads are its owner's."""

    def __init__(
        self,
        line: Line,
        mailbox: Mailbox,
        historian: Historian,
        counters: Counters,
        clock: Callable[[], float] = time.monotonic,
        wall_clock: Callable[[], float] = time.time,
    ) -> None:
        self._line = line
        self._mailbox = mailbox
        self._historian = historian
        self._counters = counters
        self._clock = clock
        self._wall_clock = wall_clock
        self._started_s = clock()
        self._wall_ahead_s = wall_clock() - clock()
        self.recent = Recent(line.n, line.control.period_s)
        self._sink = TelemetrySink(line.n, self._frame)
        self.on_event: Callable[[Event], None] | None = None  #: who else wants to know what the loop tells
        self.change: Callable[[], ChangeStatus | None] = lambda: None  #: what the gate does to the line now
        self.agents_bus: Callable[[], BusStatus] = lambda: NO_BUS
        self.alarms: Callable[[], list[AlarmStatus]] = list
        self.task_faults: Callable[[], list[TaskFault]] = list
        self._events: deque[EventStatus] = deque(maxlen=EVENTS_SHOWN)
        self._buses: list[BusReport] = []
        self._malformed_events = 0
        self._loop_was_running = False
        self._was_storing = True
        mailbox.subscribe(LOOP_TELEMETRY, self._sink.take)
        mailbox.subscribe(LOOP_EVENT, self._loop_event)
        mailbox.subscribe(LOOP_BUSES, self._loop_buses)
        mailbox.serve(GATEWAY_STATUS, self._answer_status)
        mailbox.serve(GATEWAY_COMMAND, self._answer_command)

    def newest(self) -> Frame | None:
        """The last frame of a loop that runs."""
        running = loop_status(self._line, self._sink, self._clock()).running
        return self._sink.newest() if running else None

    def note(self, kind: str, text: str, **data: Any) -> None:
        """An event of the gateway itself."""
        self._keep(Event(time_s=self._clock(), kind=kind, text=text, data=data))

    def watch(self) -> None:
        """Called a few times a second: notes a loop or a historian that comes or goes."""
        loop = loop_status(self._line, self._sink, self._clock())
        if loop.running != self._loop_was_running:
            self._loop_was_running = loop.running
            if loop.running:
                self.note("loop-up", f"the loop runs, state {loop.state}")
            else:
                self.note("loop-lost", f"no telemetry of the loop for {loop.age_s} s: {loop.next}")
        self._watch_wall_clock()
        health = self._historian.health()
        if health.storing != self._was_storing and health.text != "starting":
            self._was_storing = health.storing
            self.note("historian", f"the historian is {health.text}")

    def _watch_wall_clock(self) -> None:
        """Nothing here goes by the wall clock, but people's records do: a clock that was set is noted."""
        ahead_s = self._wall_clock() - self._clock()
        moved_s, self._wall_ahead_s = ahead_s - self._wall_ahead_s, ahead_s
        if abs(moved_s) >= WALL_CLOCK_JUMP_S:
            way = "forward" if moved_s > 0 else "back"
            text = f"the wall clock was set {way} by {abs(moved_s):.1f} s; control goes by the monotonic clock alone"
            self.note("wall-clock", text, moved_s=moved_s)

    def status(self) -> GatewayStatus:
        now_s = self._clock()
        loop = loop_status(self._line, self._sink, now_s)
        frame = self._sink.newest()
        limits = self._line.limits
        return GatewayStatus(
            format=1,
            site=self._line.site,
            line=self._line.line,
            wall_s=self._wall_clock(),
            uptime_s=round(now_s - self._started_s, 3),
            loop=loop,
            unwind_speed_m_per_s=known(frame.unwind_speed_m_per_s) if frame is not None else None,
            speed_setpoint_m_per_s=known(frame.speed_setpoint_m_per_s) if frame is not None else None,
            stands=loop.running and self.recent.stands(),
            change=self.change(),
            limits=LimitsStatus(
                tension_min_n=limits.tension_min_n, tension_max_n=limits.tension_max_n, torque_nm=limits.torque_nm
            ),
            spans=span_statuses(self._line, frame, loop.running),
            timing=timing_status(self._sink.cycles if loop.running else ()),
            link=LinkStatus(
                frames=self._sink.frames,
                dropped_frames=self._sink.dropped,
                malformed=self._sink.malformed + self._malformed_events + self._counters.malformed,
                refused=self._counters.refused,
            ),
            buses=self._buses if loop.running else [],
            agents_bus=self.agents_bus(),
            historian=self._historian_status(now_s),
            events=list(self._events),
            alarms=self.alarms(),
            task_faults=[self._fault_status(fault) for fault in self.task_faults()],
        )

    def _historian_status(self, now_s: float) -> HistorianStatus:
        health = self._historian.health()
        return HistorianStatus(
            storing=health.storing,
            text=health.text,
            path=str(self._historian.path),
            frames_stored=health.frames_stored,
            frames_lost=health.frames_lost,
            events_lost=health.events_lost,
            last_stored_age_s=None if health.last_stored_s is None else round(now_s - health.last_stored_s, 3),
            moved_aside=health.moved_aside,
        )

    def _fault_status(self, fault: TaskFault) -> TaskFaultStatus:
        since_wall_s = round(fault.since_s + self._wall_clock() - self._clock(), 3)
        return TaskFaultStatus(
            task=fault.task, error=fault.error, text=fault.text, since_wall_s=since_wall_s, times=fault.times,
            in_a_row=fault.in_a_row,
        )  # fmt: skip

    def _frame(self, payload: bytes) -> None:
        self._historian.frame(payload)
        self.recent.take(payload)

    def _loop_buses(self, payload: bytes) -> None:
        try:
            self._buses = BUS_REPORTS.validate_json(payload)
        except ValidationError:
            self._malformed_events += 1

    def _loop_event(self, payload: bytes) -> None:
        try:
            event = Event.model_validate_json(payload)
        except ValidationError:
            self._malformed_events += 1
            return
        self._keep(event)
        if self.on_event is not None:
            self.on_event(event)

    def _keep(self, event: Event) -> None:
        self._historian.event(event)
        wall_s = event.time_s + self._wall_clock() - self._clock()
        if isfinite(wall_s):
            shown = event.findings[:FINDINGS_SHOWN]
            self._events.append(
                EventStatus(wall_s=round(wall_s, 3), kind=event.kind, text=event.text[:TEXT_SHOWN], findings=shown)
            )

    async def _answer_status(self, _: bytes) -> bytes:
        return self.status().model_dump_json().encode()

    async def _answer_command(self, payload: bytes) -> bytes:
        return (await self.command(payload, who_of(PEER.get()))).model_dump_json().encode()

    async def command(self, payload: bytes, who: Who) -> Reply:
        """Hand a command on to the loop, and note who gave it."""
        reply = await self._pass_on(payload)
        said = payload[:1000].decode("utf-8", "replace")
        answered = "done" if reply.ok else "refused" if reply.known else "not known"
        self.note(
            "command",
            f"{who.name}: {_in_words(payload)}: {answered}: {reply.text}",
            command=said,
            reply=reply.model_dump(),
            uid=who.uid,
            pid=who.pid,
        )
        return reply

    async def _pass_on(self, payload: bytes) -> Reply:
        state = loop_status(self._line, self._sink, self._clock()).state
        try:
            command = parse_command(payload)
            if isinstance(command, Deploying) or (isinstance(command, RunExperiment) and command.proposal is not None):
                text = f"{in_words(command)}: only a proposal that was judged and approved changes the controller"
                return Reply(ok=False, state=state, text=text, reasons=[text])
            time_s = ARM_TIME_S if isinstance(command, Arm) else LOOP_TIME_S
            answer = await self._mailbox.request(LOOP_COMMAND, payload, time_s)
            return Reply.model_validate_json(answer)
        except MalformedMessage as error:
            return Reply(ok=False, state=state, text=f"not understood: {error}", reasons=[str(error)])
        except Unreachable as error:
            return Reply(ok=False, state=state, text=str(error), reasons=[str(error)], known=isinstance(error, NotSent))
        except ValidationError as error:
            text = "the loop answered what is no reply; see `r2rgate status` for what it did"
            return Reply(ok=False, state=state, text=text, reasons=[str(error)], known=False)


def _in_words(payload: bytes) -> str:
    try:
        return in_words(parse_command(payload))
    except MalformedMessage:
        return payload[:80].decode("utf-8", "replace")
