"""What the loop tells of a stop: each event on the way has what led to it, as data."""

from gateway.core.messages import Event
from gateway.core.states import Phase
from gateway.loop.machine import Machine
from gateway.loop.voice import Voice
from safety.actions import Action, Finding, found

WHY = found("part-failed", Action.STOP, part="the lease", error="ValueError: 1.5")
IN_WORDS = Finding("slack", Action.TORQUE_OFF, "tension 1 is 0.5 N")


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


def test_what_a_person_wanted_and_what_is_in_words_only_has_no_code():
    assert told((Phase.SLOWING, []), (Phase.OFF, [])) == [[], []]
    assert told((Phase.SLOWING, [IN_WORDS, WHY])) == [["part-failed"]]
