"""What the gateway does with its messages: telemetry and events into history and status, status to whoever asks,
commands on to the loop, with who gave them, into the events.
"""

import asyncio
import time
from collections import deque
from collections.abc import Awaitable, Callable, Sequence
from itertools import islice
from math import isfinite
from operator import itemgetter
from typing import Any

from gateway.core.alarms import AlarmStatus
from gateway.core.audit_record import Who
from gateway.core.deployment import WiringStatus
from gateway.core.finding import Finding, finding
from gateway.core.line import Line
from gateway.core.messages import (
    PACKED,
    Arm,
    BusReport,
    Command,
    Deploying,
    Drill,
    Event,
    MalformedMessage,
    Reply,
    RunExperiment,
    Start,
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
from gateway.core.topics import GATEWAY_COMMAND, GATEWAY_STATUS, LOOP_BUSES, LOOP_EVENT, LOOP_TELEMETRY
from gateway.mailbox.port import PEER, Counters, Mailbox, NotSent, Unreachable
from gateway.mailbox.rights import OVERTAKES
from gateway.mailbox.to_loop import ToLoop
from gateway.supervisor.bounded import Bounded
from gateway.supervisor.historian import Historian
from gateway.supervisor.intake import bounded_event, bus_reports_of, event_of
from gateway.supervisor.peers import who_at_once, who_of
from gateway.supervisor.recent import Recent
from gateway.supervisor.said_inbox import (
    CAUSED_BY_ANYBODY,
    COMMAND_EVENT,
    OF_COMMANDS,
    SaidInbox,
    is_never_held_back,
    is_stop,
)
from gateway.supervisor.status import known, loop_status, span_statuses, timing_status
from gateway.supervisor.status_payload import status_payload
from gateway.supervisor.telemetry_sink import TelemetrySink
from gateway.supervisor.true_loop import TrueLoop, is_shown, names_of
from gateway.tasks.supervisor import TaskFault
from gateway.wording.catalogue import sentence

LOOP_TIME_S = 2.5  #: for the loop to answer a command
SAFE_TIME_S, SAFE_SHOWN_S = 0.75, 0.6  #: for it to answer stop and hold, and of that to show it: `topics.SAFE_S` in all
ARM_TIME_S = 14.0  #: arming configures every drive and reads its watchdog back
DRILL_MOST_S = 8.0  #: of the drill itself, beside the warning
EARLY_PERIODS = (
    5.0  #: by which a frame may be due after this process's clock: one clock for both, and a timer's earliness
)
SHOWN_S, SHOWN_TURNS = (
    1.0,
    20,
)  #: within which the loop's frames show what it has answered, and turns for them to come in
WALL_CLOCK_JUMP_S = 0.5  #: between two looks; less is a clock that is being disciplined
EVENTS_SHOWN = 20
SAID_SHOWN = 8  #: of these, at most, of what any local process can cause
REPEATS = (3, 10.0)  #: events of one thing said again and again: in a row, and then one every so many seconds
NO_BUS = BusStatus(open=False, text="it is about to be opened", agents=[], refused=0)
BY_PROPOSAL = "only a proposal that was judged and approved changes the controller"
FINDINGS_SHOWN = 8  #: of an event in the status
TEXT_SHOWN = 300  #: characters of an event's text in the status; the history keeps all


async def nothing_found() -> list[Finding]:
    """Where there are no records."""
    return []


async def on_no_record(_: Command, reply: Reply, __: Who) -> Reply:
    """Where there is no audit."""
    return reply


class Gateway:
    """Handlers on a mailbox, and what they remember. Sockets, signals and threads are its owner's."""

    def __init__(
        self,
        line: Line,
        mailbox: Mailbox,
        to_loop: ToLoop,
        historian: Historian,
        counters: Counters,
        clock: Callable[[], float] = time.monotonic,
        wall_clock: Callable[[], float] = time.time,
        true_loop: TrueLoop | None = None,
    ) -> None:
        """`true_loop` says what the line's loop is; None: whatever is on the mailbox, as within one process."""
        self._line = line
        self._to_loop = to_loop
        self._historian = historian
        self._counters = counters
        self._clock = clock
        self._wall_clock = wall_clock
        self._started_s = clock()
        self._wall_ahead_s = wall_clock() - clock()
        self.recent = Recent(line.n, line.control.period_s)
        early_s = EARLY_PERIODS * line.control.period_s
        self._sink = TelemetrySink(line.n, self._frame, clock, early_s)
        self.true_loop = true_loop
        self._confirming: list[set[tuple[int, int]]] = []  #: states and phases since each command that waits to be seen
        self.on_event: Callable[[Event], None] | None = None  #: who else wants to know what the loop tells
        self.change: Callable[[], ChangeStatus | None] = lambda: None  #: what the gate does to the line now
        self.agents_bus: Callable[[], BusStatus] = lambda: NO_BUS
        self.audit_head: Callable[[], str] = str  #: NUMBER:HASH; empty: none is known
        self.alarms: Callable[[], list[AlarmStatus]] = list
        self.not_to_be_armed: Callable[[], list[Finding]] = list  #: why the line must not be armed
        #: Why it is not known yet what the line runs. May raise Unreachable.
        self.hold_against_records: Callable[[], Awaitable[list[Finding]]] = nothing_found
        self.unconfirmed: Callable[[], list[Finding]] = list  #: a first configuration that nobody has confirmed
        self.wiring: Callable[[], WiringStatus | None] = lambda: None  #: whether it is as it was proved to be
        self.unexplained: Callable[[], list[Finding]] = list  #: what was changed or tried at the loop
        self.task_faults: Callable[[], list[TaskFault]] = list
        #: Puts on record what a local process has said, and what the line has answered.
        self.on_record: Callable[[Command, Reply, Who], Awaitable[Reply]] = on_no_record
        self.stop_asked: Who | None = None  #: who asked for the last stop that was handed on
        #: With their number, in which order they came.
        self._events: deque[tuple[int, EventStatus]] = deque(maxlen=EVENTS_SHOWN)
        self._said: deque[tuple[int, EventStatus]] = deque(maxlen=SAID_SHOWN)  #: those that any local process can cause
        self._events_kept = 0
        self._inbox = SaidInbox(COMMAND_EVENT, OF_COMMANDS, clock, self.note)
        self._repeats = Bounded(clock, *REPEATS)
        self._buses: list[BusReport] = []
        self._malformed_events = 0
        self._loop_was_running = False
        self._was_storing = True
        published = {
            LOOP_TELEMETRY: self._take_frame, LOOP_EVENT: self._loop_event, LOOP_BUSES: self._loop_buses,
        }  # fmt: skip
        for topic, handler in published.items():
            mailbox.subscribe(topic, handler if true_loop is None else true_loop.taken(handler))
        mailbox.serve(GATEWAY_STATUS, self._answer_status)
        mailbox.serve(GATEWAY_COMMAND, self._answer_command)

    def loop_begins(self) -> None:
        """What comes next is of another start of the loop."""
        self._sink.begin_anew()

    def newest(self) -> Frame | None:
        """The last frame of a loop that runs."""
        running = loop_status(self._line, self._sink, self._clock()).running
        return self._sink.newest() if running else None

    def note(self, kind: str, text: str, *, findings: Sequence[Finding] = (), **data: Any) -> None:
        """An event of the gateway itself."""
        now_s = self._clock()
        coded = list(findings)
        event = Event.model_construct(time_s=now_s, kind=kind, text=text, findings=coded, data=data)
        self._keep(bounded_event(event, now_s))

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
        true_loop = self.true_loop
        if true_loop is not None:
            loop = loop.model_copy(update={"false_loop": true_loop.false_loop()})
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
                untaken=self._sink.refused + (0 if true_loop is None else true_loop.untaken),
            ),
            buses=self._buses if loop.running else [],
            agents_bus=self.agents_bus(),
            historian=self._historian_status(now_s),
            events=self._events_shown(),
            audit_head=self.audit_head(),
            alarms=self.alarms(),
            unexplained=self.unexplained(),
            unconfirmed=self.unconfirmed(),
            wiring=self.wiring() if loop.running else None,
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

    def _take_frame(self, payload: bytes) -> None:
        before = self._sink.refused
        self._sink.take(payload)
        why = self._sink.why_refused
        if self._sink.refused != before and why is not None and self.true_loop is not None:
            self.true_loop.found_false(why)

    def _frame(self, payload: bytes) -> None:
        self._historian.frame(payload)
        self.recent.take(payload)
        if self._confirming and (frame := self._sink.newest()) is not None:
            for seen in self._confirming:
                seen.add((frame.state, frame.phase))

    def _loop_buses(self, payload: bytes) -> None:
        reports = bus_reports_of(payload)
        if reports is None:
            self._malformed_events += 1
        else:
            self._buses = reports

    def _loop_event(self, payload: bytes) -> None:
        event = event_of(payload, self._clock())
        if event is None:
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
            events = self._said if event.kind in CAUSED_BY_ANYBODY else self._events
            self._events_kept += 1
            told = EventStatus(wall_s=round(wall_s, 3), kind=event.kind, text=event.text[:TEXT_SHOWN], findings=shown)
            events.append((self._events_kept, told))

    def _events_shown(self) -> list[EventStatus]:
        """The newest last; whoever says much puts nothing out of it but what was said."""
        others = islice(reversed(self._events), EVENTS_SHOWN - len(self._said))
        return [told for _, told in sorted([*others, *self._said], key=itemgetter(0))]

    async def _answer_status(self, _: bytes) -> bytes:
        return status_payload(self.status())

    async def _answer_command(self, payload: bytes) -> bytes:
        if is_never_held_back(payload):
            who, refusal = who_at_once(PEER.get()), None
        else:
            who = await who_of(PEER.get())
            refusal = self._inbox.refuse(who, len(payload))
        if refusal is not None:
            return refusal.model_dump_json().encode()
        reply, said = await self.command(payload, who), _command_of(payload)
        if said is not None:
            reply = await self.on_record(said, reply, who)
        return reply.model_dump_json().encode()

    async def command(self, payload: bytes, who: Who) -> Reply:
        """Hand a command on to the loop, and note who gave it; what is said again and again is counted."""
        if is_stop(payload):
            self.stop_asked = who
        reply = await self._pass_on(payload)
        said = payload[:1000].decode("utf-8", "replace")
        answered = "done" if reply.ok else "refused" if reply.known else "not known"
        text = f"{who.name}: {_in_words(payload)}: {answered}: {reply.text}"
        if (left_out := self._repeats.left_out(f"{who.uid}: {text}")) is not None:
            more: dict[str, Any] = {"left_out": left_out} if left_out else {}
            text += f" ({left_out} times more before)" if left_out else ""
            self.note(
                COMMAND_EVENT, text, command=said, reply=reply.model_dump(), uid=who.uid, pid=who.pid, **more
            )  # fmt: skip
        return reply

    async def _pass_on(self, payload: bytes) -> Reply:
        state = loop_status(self._line, self._sink, self._clock()).state
        try:
            if payload[:1] == PACKED:  # nothing that may be said here is: it is not even unpacked
                text = f"{_in_words(payload)}: {BY_PROPOSAL}"
                return Reply(ok=False, state=state, text=text, reasons=[text])
            command = parse_command(payload)
            if isinstance(command, Deploying) or (isinstance(command, RunExperiment) and command.proposal is not None):
                text = f"{in_words(command)}: {BY_PROPOSAL}"
                return Reply(ok=False, state=state, text=text, reasons=[text])
            if isinstance(command, Arm | Start) and (
                found := await self.hold_against_records() or self.not_to_be_armed()
            ):
                reasons = [sentence(one) for one in found]
                text = f"not {command.command}ed: {reasons[0]}"
                return Reply(ok=False, state=state, text=text, reasons=reasons, findings=found)
            if command.command in OVERTAKES:
                return await self._safe(command, state)
            return await self._answered(command, self._answer_time_s(command), SHOWN_S)
        except MalformedMessage as error:
            findings = list(error.findings)
            return Reply(
                ok=False, state=state, text=f"not understood: {error}", reasons=[str(error)], findings=findings
            )
        except Unreachable as error:
            return Reply(ok=False, state=state, text=str(error), reasons=[str(error)], known=isinstance(error, NotSent))

    async def _safe(self, command: Command, state: str) -> Reply:
        """A stop or a hold: what the loop answers, or what to press instead, before whoever said it stops waiting."""
        try:
            async with asyncio.timeout(SAFE_TIME_S):
                return await self._answered(command, SAFE_TIME_S, SAFE_SHOWN_S)
        except (Unreachable, TimeoutError) as error:
            because = str(error) or f"no answer within {SAFE_TIME_S:g} s"
            found = finding("loop-unanswered", command=in_words(command), because=because)
            text, known = sentence(found), isinstance(error, NotSent)
            return Reply(ok=False, state=state, text=text, reasons=[because], findings=[found], known=known)

    def _answer_time_s(self, command: Command) -> float:
        if isinstance(command, Drill):
            return ARM_TIME_S + DRILL_MOST_S + self._line.stages.start_warning_s
        return ARM_TIME_S if isinstance(command, Arm) else LOOP_TIME_S

    async def _answered(self, command: Command, time_s: float, shown_s: float) -> Reply:
        """What the loop answers within `time_s`, once its frames show it, within `shown_s`. Raises Unreachable."""
        seen: set[tuple[int, int]] = set()
        self._confirming.append(seen)
        try:
            reply = await self._to_loop.tell(command, time_s)
            if self.true_loop is None:
                return reply
            if not await self.true_loop.has_answered():
                return self._not_believed(finding("false-loop-answered", command=in_words(command)))
            if not reply.ok or await self._is_shown(command, reply, seen, shown_s):
                return reply
            shown = ", ".join(names_of(seen)) or "-"
            found = finding("reply-contradicted", command=in_words(command), answered=reply.state, shown=shown)
            return self._not_believed(found)
        finally:
            self._confirming.remove(seen)

    async def _is_shown(self, command: Command, reply: Reply, seen: set[tuple[int, int]], within_s: float) -> bool:
        """Whether frames that came since the command was given show what the reply says, within a little while."""
        until_s, turns = self._clock() + within_s, 0
        while not is_shown(command, reply, seen):
            if self._clock() >= until_s and turns >= SHOWN_TURNS:
                return False
            turns += 1
            await asyncio.sleep(self._line.control.period_s / 2.0)
        return True

    def _not_believed(self, found: Finding) -> Reply:
        """A reply that is none of the loop's, or that contradicts it: a fault, told as one, and no success."""
        assert self.true_loop is not None
        self.true_loop.found_false(found)
        text = sentence(found)
        state = loop_status(self._line, self._sink, self._clock()).state
        return Reply(ok=False, state=state, text=text, reasons=[text], findings=[found], known=False)


def _in_words(payload: bytes) -> str:
    if payload[:1] == PACKED:
        return "a packed command"
    said = _command_of(payload)
    return payload[:80].decode("utf-8", "replace") if said is None else in_words(said)


def _command_of(payload: bytes) -> Command | None:
    """None: it is none, or packed, which nothing is that may be said here."""
    if payload[:1] == PACKED:
        return None
    try:
        return parse_command(payload)
    except MalformedMessage:
        return None
