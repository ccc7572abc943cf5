"""What the loop says to the gateway: a frame a period, events, and how its buses fare. Never blocks, never waits."""

from collections import deque
from collections.abc import Callable, Sequence

from drivers.port import Link
from gateway.core.messages import BUS_REPORTS, BusReport, Event
from gateway.core.states import LoopState, Phase
from gateway.core.telemetry import Frame, pack
from gateway.core.topics import LOOP_BUSES, LOOP_EVENT, LOOP_TELEMETRY
from gateway.loop.machine import Machine
from gateway.loop.pacer import monotonic
from gateway.mailbox.port import Mailbox, Peer
from safety.actions import Action, Finding, most_severe

REPORT_EVERY_S = 1.0
MOST_UNHEARD = 64  #: events of a start and stops: some of each bus, file and finding
#: What leaves these for STOP stops the line, whoever or whatever wants it.
_MOVING = frozenset((Phase.ENABLING, Phase.TENSIONING, Phase.RUNNING, Phase.HOLDING))


class Voice:
    def __init__(self, mailbox: Mailbox, links: list[Link], period_s: float) -> None:
        self.stopper: Callable[[], Peer | None] = lambda: None  #: who asks for the stop that is being carried out
        self._mailbox = mailbox
        self._links = links
        self._report_every = max(1, round(REPORT_EVERY_S / period_s))  # periods
        self._led_here: Sequence[Finding] = ()  #: what led to the state that the loop is in
        self._unheard: deque[bytes] = deque(maxlen=MOST_UNHEARD)  #: until there is a gateway

    def record(self, frame: Frame) -> None:
        """A period's telemetry, and now and then the buses."""
        self._mailbox.publish(LOOP_TELEMETRY, pack(frame))
        if self._unheard and frame.sequence % self._report_every == 0:
            self._tell_unheard()
        if frame.sequence % self._report_every == 0:
            self._mailbox.publish(LOOP_BUSES, BUS_REPORTS.dump_json([_report(link) for link in self._links]))

    def tell(self, kind: str, text: str, *, findings: Sequence[Finding] = (), **data: object) -> None:
        """An event."""
        self._mailbox.publish(LOOP_EVENT, _event(kind, text, findings, data))

    def tell_start(self, kind: str, text: str, *, findings: Sequence[Finding] = (), **data: object) -> None:
        """An event of the start, or a stop: told again once a second until there is a gateway that takes it."""
        self._unheard.append(_event(kind, text, findings, data))
        self._tell_unheard()

    def _tell_unheard(self) -> None:
        """In their order."""
        while self._unheard and self._mailbox.publish(LOOP_EVENT, self._unheard[0]):
            self._unheard.popleft()

    def announce(self, before: Machine, after: Machine, findings: list[Finding]) -> None:
        """A change of phase with what led to it and what the buses say; or an alarm within a phase.

        On the way of a stop to its end every event has what led to it: who looks later reads the newest.
        """
        rules = [finding.rule for finding in findings]
        if after.phase is before.phase:
            self.tell("alarm", "; ".join(finding.text for finding in findings), findings=findings, rules=rules)
            return
        text = f"{before.phase.name} to {after.phase.name}" + (f": {after.reason}" if after.reason else "")
        troubles = [f"{link.name}: {link.health.last_error}" for link in self._links if link.health.last_error]
        if findings and troubles:
            text += f" [{'; '.join(troubles)}]"
        if after.state is not before.state:
            self._led_here = findings
        state = after.state.name
        if (stopped := self._stopped(before, after, findings)) is not None:  # for the records: not lost meanwhile
            self.tell_start("state", text, findings=findings, state=state, rules=rules, stopped=stopped)
            return
        self.tell("state", text, findings=findings or self._led_here, state=state, rules=rules)

    def _stopped(self, before: Machine, after: Machine, findings: list[Finding]) -> dict[str, object] | None:
        """That the line is being stopped from now on, from where, and who wanted it; None: it is not."""
        if after.state is not LoopState.STOP or before.state is LoopState.STOP:
            return None
        asked = after.by_person
        if not asked and most_severe(findings) < Action.STOP and before.phase not in _MOVING:
            return None  # a drill or a proof that is over, an arming that came to nothing
        peer = self.stopper() if asked else None
        who = {} if peer is None else {"uid": peer.uid, "pid": peer.pid}
        return {"state": before.state.name, "phase": before.phase.name, "by_person": asked, **who}


def _event(kind: str, text: str, findings: Sequence[Finding], data: dict[str, object]) -> bytes:
    coded = [finding.as_data() for finding in findings]
    return Event(time_s=monotonic(), kind=kind, text=text, findings=coded, data=data).model_dump_json().encode()


def _report(link: Link) -> BusReport:
    health = link.health
    return BusReport(
        name=link.name,
        absent=health.absent,
        timeouts=health.timeouts,
        malformed=health.malformed,
        reconnects=health.reconnects,
        last_error=health.last_error,
    )
