"""What the loop tells of a stop: each event on the way has what led to it, as data."""

from gateway.core.messages import Event
from gateway.core.states import Phase
from gateway.core.telemetry import Frame, unpack
from gateway.core.topics import LOOP_EVENT
from gateway.loop.machine import Machine
from gateway.loop.voice import Voice
from safety.actions import Action, Finding, found
from tests.unit.supervisor_support import frame_of

WHY = found("part-failed", Action.STOP, part="the lease", error="ValueError: 1.5")


class Heard:
    """A mailbox that keeps what is published."""

    def __init__(self) -> None:
        self.events: list[Event] = []

    def publish(self, topic: object, payload: bytes) -> None:
        self.events.append(Event.model_validate_json(payload))


def told(*steps: tuple[Phase, list[Finding]]) -> list[list[str]]:
    """Codes of each event, of changes from RUNNING on."""
    heard = Heard()
    voice = Voice(heard, [], 0.01)
    before = Machine(Phase.RUNNING)
    for phase, findings in steps:
        after = Machine(phase, 0.0, "why")
        voice.announce(before, after, findings)
        before = after
    return [[one.code for one in event.findings] for event in heard.events]


def test_what_led_to_a_stop_is_told_until_the_line_is_armed_again():
    way = (Phase.SLOWING, [WHY]), (Phase.UNLOADING, []), (Phase.OFF, []), (Phase.ARMING, []), (Phase.READY, [])
    assert told(*way) == [["part-failed"]] * 3 + [[], []]


def test_what_a_person_wanted_has_no_code():
    assert told((Phase.SLOWING, []), (Phase.OFF, [])) == [[], []]


def stopped(before: Phase, after: Machine, findings: list[Finding]) -> object:
    """What the event says of a stop that begins; None: it is none."""
    heard = Heard()
    Voice(heard, [], 0.01).announce(Machine(before), after, findings)
    (event,) = heard.events
    return event.data.get("stopped")


def test_a_stop_is_a_persons_where_a_person_wants_it_and_the_end_of_a_proof_is_none() -> None:
    by_person = stopped(Phase.RUNNING, Machine(Phase.SLOWING, by_person=True), [])
    assert by_person == {"state": "RUN", "phase": "RUNNING", "by_person": True}
    by_itself = stopped(Phase.RUNNING, Machine(Phase.SLOWING, 0.0, WHY.text), [WHY])
    assert by_itself == {"state": "RUN", "phase": "RUNNING", "by_person": False}
    assert stopped(Phase.PROVING, Machine(Phase.UNLOADING, proved=True), []) is None
    assert stopped(Phase.SLOWING, Machine(Phase.UNLOADING, by_person=True), []) is None


class Deaf(Heard):
    """Where no gateway is, until there is one."""

    def __init__(self) -> None:
        super().__init__()
        self.is_there = False

    def publish(self, topic: object, payload: bytes) -> bool:
        if self.is_there and topic is LOOP_EVENT:
            super().publish(topic, payload)
        return self.is_there


def test_what_was_found_at_the_start_is_told_once_there_is_a_gateway_and_then_no_more():
    mailbox = Deaf()
    voice = Voice(mailbox, [], 0.1)
    voice.tell_start("configuration-set-aside", "not signed", findings=[WHY])
    voice.tell_start("start", "loop of demo/line")
    frames = [frame(k) for k in range(40)]
    for one in frames[:20]:
        voice.record(one)
    assert not mailbox.events
    mailbox.is_there = True
    for one in frames[20:]:
        voice.record(one)
    assert [event.kind for event in mailbox.events] == ["configuration-set-aside", "start"]
    assert [one.code for one in mailbox.events[0].findings] == ["part-failed"]


def test_where_a_gateway_is_there_it_is_told_at_once():
    mailbox = Deaf()
    mailbox.is_there = True
    Voice(mailbox, [], 0.1).tell_start("start", "loop of demo/line")
    assert [event.kind for event in mailbox.events] == ["start"]


def frame(sequence: int) -> Frame:
    return unpack(frame_of(sequence, 1.0 + sequence, spans=2))
