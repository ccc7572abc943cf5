"""What people may say through OPC UA and the page: by role, held against the same table at the gateway, on record."""

import asyncio

import pytest

from gateway.core.alarms import AcknowledgeAlarm, ShelveAlarm
from gateway.core.audit_record import Who
from gateway.core.decisions import Archive, Confirm, Decide, LineChanged, RollBackNow
from gateway.core.messages import (
    AbortExperiment,
    Arm,
    Hold,
    Reply,
    SelectRecipe,
    SetSpeed,
    SetTension,
    Start,
    Stop,
    parse_command,
)
from gateway.core.people import FOR_PERSON, LEAST, ROLES, ForPerson, Person, may
from gateway.core.topics import GATEWAY_FOR_PERSON
from gateway.mailbox.inprocess import Hub, InProcessMailbox
from gateway.supervisor.audit_file import AuditUnavailable
from gateway.supervisor.bounded import AT_ONCE, EVERY_S
from gateway.supervisor.operated import MOST_SAID, SAID_EVERY_S, Operated
from gateway.supervisor.persons_desk import PersonsDesk

HASH = "a" * 64
COMMANDS = [
    Arm(), Start(), Hold(), Stop(), SetTension(span=1, tension_n=20.0), SetSpeed(speed_m_per_s=0.05),
    SelectRecipe(name="a"), AbortExperiment(),
]  # fmt: skip
DECISIONS = [
    Decide(proposal=HASH, shown=HASH, approve=True), RollBackNow(comment="it squeals"),
    Confirm(configuration=HASH, because="it followed"),
    AcknowledgeAlarm(alarm="load-cell"), ShelveAlarm(alarm="load-cell", for_s=60.0, because="being mended"),
]  # fmt: skip
FOR_ENGINEERS = [
    Archive(configuration="1", name="phi_stable", because="it held"), LineChanged(because="a thinner web"),
]  # fmt: skip


class Desk:
    """A gateway that does whatever it is told, and what it has been told."""

    def __init__(self) -> None:
        hub = Hub()
        self.mailbox, self.asking = InProcessMailbox(hub), InProcessMailbox(hub)
        self.commands, self.decisions, self.records = [], [], []
        self.audit_open = True
        self.now_s = 0.0
        self.operated = Operated(self.note, lambda: self.now_s)
        PersonsDesk(self.mailbox, self.command, self.decide, self.alarm, self.operated, lambda: self.now_s)

    async def command(self, payload, who):
        self.commands.append((parse_command(payload), who))
        return Reply(ok=True, state="RUN", text="done")

    async def decide(self, decision, who, left_out):
        self.left_out = left_out
        return await self.alarm(decision, who)

    async def alarm(self, said, who):
        self.decisions.append((said, who))
        return Reply(ok=True, state="", text="decided")

    async def note(self, kind, who, what):
        if not self.audit_open:
            raise AuditUnavailable("the disk is full")
        self.records.append((kind, who.name, what))

    async def _asked(self, payload):
        return Reply.model_validate_json(await self.asking.request(GATEWAY_FOR_PERSON, payload, 1.0))

    def ask(self, role, said, certificate=None):
        person = Person(name="anna", role=role, through="opc-ua", certificate=certificate)
        return self.send(ForPerson(person=person, said=said).model_dump_json().encode())

    def send(self, payload):
        return asyncio.run(self._asked(payload))


@pytest.fixture
def desk():
    return Desk()


@pytest.mark.parametrize("said", [*COMMANDS, *DECISIONS, *FOR_ENGINEERS], ids=lambda said: said.command)
def test_a_viewer_says_nothing_that_changes_anything(desk, said):
    reply = desk.ask("viewer", said)
    assert not reply.ok and "anna is a viewer" in reply.text
    assert not desk.commands and not desk.decisions
    assert [(kind, what["command"]) for kind, _, what in desk.records] == [("refused-person", said.command)]


@pytest.mark.parametrize("said", COMMANDS, ids=lambda said: said.command)
def test_what_an_operator_commands_is_done_and_recorded_with_who_and_from_which_certificate(desk, said):
    reply = desk.ask("operator", said, certificate=HASH)
    assert reply.ok
    ((command, who),) = desk.commands
    assert command == said and who.name == "anna (operator, opc-ua)" and who.certificate == HASH
    ((kind, name, what),) = desk.records
    assert kind == "operated" and name == who.name and what["done"] and what["command"].startswith(said.command)


@pytest.mark.parametrize("said", DECISIONS, ids=lambda said: said.command)
def test_what_an_operator_decides_is_decided_in_their_name(desk, said):
    assert desk.ask("operator", said).text == "decided"
    ((decision, who),) = desk.decisions
    assert decision == said and who.name == "anna (operator, opc-ua)"


def test_nobody_takes_the_decision_of_a_program_for_a_persons(desk):
    decide = DECISIONS[0]
    for name, script in (("script-panel", "a program"), ("scripter", "")):
        person = Person(name=name, role="operator", through="opc-ua", certificate=HASH)
        assert desk.send(ForPerson(person=person, said=decide).model_dump_json().encode()).ok
        decision, who = desk.decisions.pop()
        assert decision == decide.model_copy(update={"script": script})
        assert who.name == f"{name} (operator, opc-ua)" and who.certificate == HASH


@pytest.mark.parametrize("said", FOR_ENGINEERS, ids=lambda said: said.command)
def test_what_takes_an_engineer_takes_one(desk, said):
    assert desk.ask("operator", said).text == f"anna is an operator; {said.command} takes an engineer"
    assert not desk.decisions
    assert desk.ask("engineer", said).ok


def test_who_tries_again_and_again_what_they_may_not_is_counted_and_fills_no_disk(desk):
    for _ in range(500):
        assert not desk.ask("viewer", Stop()).ok
    assert len(desk.records) == AT_ONCE
    assert not desk.send(
        ForPerson(person=Person(name="bert", role="viewer", through="page"), said=Stop()).model_dump_json().encode()
    ).ok
    assert len(desk.records) == AT_ONCE + 1  # others are on record as ever
    desk.now_s += EVERY_S
    desk.ask("viewer", Stop())
    assert desk.records[-1][2]["left_out"] == 500 - AT_ONCE


def test_who_says_more_than_any_hand_does_is_still_heard_and_fills_no_disk(desk):
    for _ in range(MOST_SAID + 50):
        assert desk.ask("operator", Hold()).ok
    assert len(desk.commands) == MOST_SAID + 50 and len(desk.records) == MOST_SAID
    reply = desk.ask("operator", AcknowledgeAlarm(alarm="load-cell"))
    assert not reply.ok and "too much at once" in reply.text and not desk.decisions
    assert desk.ask("operator", RollBackNow()).ok and desk.ask("operator", Stop()).ok
    assert desk.left_out is None  # done, and recorded no more
    desk.now_s += SAID_EVERY_S
    assert desk.ask("operator", Hold()).ok
    assert desk.records[-1][2]["left_out"] == 50 + 3
    desk.now_s += SAID_EVERY_S
    assert desk.ask("operator", AcknowledgeAlarm(alarm="load-cell")).ok


def test_what_a_local_process_says_is_on_record_as_a_persons_and_fills_no_disk(desk):
    answered, who = Reply(ok=True, state="RUN", text="done"), Who(name="otto", uid=1000, pid=7)

    def say(*commands):
        return [asyncio.run(desk.operated.keep_local(one, answered, who)) for one in commands]

    say(*COMMANDS)
    recorded = [one for one in COMMANDS if not isinstance(one, Stop)]  # which has a record of its own
    assert [(kind, name, what["done"]) for kind, name, what in desk.records] == [("operated", "otto", True)] * 7
    assert all(
        what["command"].startswith(one.command) for (_, _, what), one in zip(desk.records, recorded, strict=True)
    )
    say(*[Arm()] * (MOST_SAID + 50))
    assert len(desk.records) == MOST_SAID
    desk.now_s += SAID_EVERY_S
    say(Arm())
    assert desk.records[-1][2]["left_out"] == 50 + 7
    desk.now_s, desk.audit_open = desk.now_s + SAID_EVERY_S, False
    (reply,) = say(Arm())
    assert reply.ok and "could not be recorded: the disk is full" in reply.text


def test_a_stop_is_done_though_nothing_can_be_recorded(desk):
    desk.audit_open = False
    reply = desk.ask("operator", Stop())
    assert reply.ok and "could not be recorded: the disk is full" in reply.text
    assert [command for command, _ in desk.commands] == [Stop()]


@pytest.mark.parametrize(
    "payload",
    [
        b"",
        b"{}",
        b'{"person": {"name": "anna", "role": "root", "through": "page"}, "said": {"command": "stop"}}',
        b'{"person": {"name": "Anna;", "role": "operator", "through": "page"}, "said": {"command": "stop"}}',
        b'{"person": {"name": "anna", "role": "engineer", "through": "page"}, "said": {"command": "deploy"}}',
        b'{"person": {"name": "anna", "role": "engineer", "through": "page"}, "said": {"command": "narrow"}}',
    ],
)  # fmt: skip
def test_what_is_none_of_these_is_not_understood(desk, payload):
    reply = desk.send(payload)
    assert not reply.ok and reply.text == "not understood" and reply.reasons
    assert not desk.commands and not desk.decisions and not desk.records


def test_each_role_may_all_that_the_one_before_may():
    for command in LEAST:
        allowed = [may(role, command) for role in ROLES]
        assert allowed == sorted(allowed), command
    assert not any(may(role, "deploy") for role in ROLES)


def test_a_table_of_rights_for_everything_that_can_be_said():
    schema = FOR_PERSON.json_schema()
    said = set(schema["properties"]["said"]["discriminator"]["mapping"])
    assert said == set(LEAST)


def test_what_could_not_be_recorded_of_refusals_and_commands_is_counted_and_takes_nothing(desk):
    desk.audit_open = False
    for _ in range(2 * AT_ONCE):
        assert not desk.ask("viewer", Stop()).ok
    for _ in range(3):
        assert desk.ask("operator", Hold()).ok
    desk.audit_open = True
    desk.ask("viewer", Stop())
    desk.ask("operator", Hold())
    assert [what["left_out"] for _, _, what in desk.records] == [2 * AT_ONCE, 3]
