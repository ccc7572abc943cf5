"""Alarms: each comes of what it says, once, is seen and shelved by people on record, and none chatters."""

import asyncio
import json
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from gateway.core.alarms import (
    ALARM_SAID,
    ALARMS,
    BY_NAME,
    LONGEST_SHELVED_S,
    MOST_ALARMS,
    AcknowledgeAlarm,
    AlarmSaid,
    AlarmStatus,
    ShelveAlarm,
)
from gateway.core.audit_record import BEFORE_FIRST, AuditRecord, Who
from gateway.core.doubts import WORDS, Doubt
from gateway.core.finding import finding
from gateway.core.messages import Reply
from gateway.core.people import LEAST, ForPerson, Person
from gateway.core.status import GatewayStatus, TaskFaultStatus
from gateway.core.topics import GATEWAY_ALARM, GATEWAY_FOR_PERSON
from gateway.mailbox.unix import UnixMailbox
from gateway.supervisor.alarm_conditions import OF_THE_LINE, Conditions
from gateway.supervisor.alarm_states import RESTORED_S, TOGETHER_S, AlarmStates, Kept
from gateway.supervisor.alarms import FILE_NAME, Alarms
from gateway.supervisor.audit import AuditState
from gateway.supervisor.audit_anchor import NOTHING_YET
from gateway.supervisor.audit_file import AuditUnavailable
from gateway.supervisor.operated import Operated
from gateway.supervisor.persons_desk import PersonsDesk
from gateway.supervisor.said_inbox import OF_DECISIONS
from gateway.supervisor.store import boot_id
from tests.unit.alarm_support import RECORDING, bus, span, state_event, status
from tests.unit.supervisor_support import short_folder

ANNA = Who(name="anna", uid=1000, pid=7)
FULL = AuditState(False, "the disk is full", NOTHING_YET)
LOST = {"running": False, "state": "UNKNOWN", "age_s": 1.5}

#: By alarm a status in which its condition holds and no other's does, and a word of what is then told.
CASES: dict[str, tuple[GatewayStatus, str]] = {
    "device-absent": (status(buses=[bus(["drive-3"], "no heartbeat")]), "drive-3 on can0: no heartbeat"),
    "drive-fault": (status(spans=[span(1), span(2, drive="STO")]), "drive of roller-2: STO"),
    "load-cell": (status(spans=[span(1, quality="STALE")]), "span 1 zone-1: STALE"),
    "loop-lost": (status(LOST), "no telemetry for 1.5 s"),
    "false-loop": (
        status({"false_loop": [finding("false-loop-answered", command="stop")]}), "what answered is not the line's loop"
    ),
    "torque-at-limit": (status({"saturated": True}), "roller-1 at 5.0 Nm; allowed: 20 Nm"),
    "tension-out-of-band": (
        status(spans=[span(1), span(2, tension_n=61.0, setpoint_n=55.0)]),
        "span 2 zone-2: 61.0 N; allowed: 5 to 60 N",
    ),
    "tension-off": (status(spans=[span(1, tension_n=23.9)]), "span 1 zone-1: 23.9 N, set to 30.0 N"),
    "cycles-late": (
        status(timing=status().timing.model_copy(update={"missed": 11})), "11 periods missed in the last 1000"
    ),
    "line-stopped": (
        status({"state": "STOP"}, events=[state_event("RUNNING to SLOWING: roller 3 slips")]), "roller 3 slips"
    ),
    "history-not-stored": (
        status(historian=status().historian.model_copy(update={"storing": False, "text": "not storing: disk full"})),
        "disk full",
    ),
    "gateway-task": (
        status(task_faults=[TaskFaultStatus(
            task="gate", error="KeyError", text="'x'", since_wall_s=1.0, times=3, in_a_row=3,
        )]),
        "gate: KeyError: 'x'",
    ),
    "unexplained-change": (
        status(unexplained=[finding("configuration-unexplained", configuration="c0ffee", epoch=7)]),
        "the loop runs configuration c0ffee, epoch 7",
    ),
}  # fmt: skip


def holding(found: GatewayStatus, audit: AuditState = RECORDING) -> dict[str, str]:
    return Conditions().look(found, audit)


# ---- the table


def test_the_table_is_short_complete_and_each_row_says_what_to_do() -> None:
    assert 0 < len(ALARMS) <= MOST_ALARMS and len(BY_NAME) == len(ALARMS)
    assert set(CASES) | {"audit-unavailable"} == set(BY_NAME)
    assert set(OF_THE_LINE) <= set(BY_NAME)
    for alarm in ALARMS:
        assert all((alarm.means, alarm.cause, alarm.consequence, alarm.action)), alarm.name
        assert alarm.after_s >= 0.0 and alarm.gone_s >= 0.0


def test_the_page_is_the_table() -> None:
    from gateway.supervisor.alarms_page import PAGE, text

    assert PAGE.read_text(encoding="utf-8") == text(), "python -m gateway.supervisor.alarms_page writes it anew"


# ---- conditions


def test_a_line_that_runs_as_it_should_has_no_alarm() -> None:
    assert holding(status()) == {}


@pytest.mark.parametrize("name", CASES)
def test_each_condition_is_told_with_its_values_and_no_other_with_it(name: str) -> None:
    found, said = CASES[name]
    told = holding(found)
    assert set(told) == {name} and said in told[name]


def test_an_audit_that_takes_nothing_is_an_alarm_whatever_the_line_does() -> None:
    assert holding(status(), FULL) == {"audit-unavailable": "the disk is full"}
    assert set(holding(status(LOST), FULL)) == {"audit-unavailable", "loop-lost"}


@pytest.mark.parametrize(
    "found",
    [
        status({"running": False, "state": "UNKNOWN", "age_s": None}),  # no loop has been started yet
        status({"state": "SILENT"}, spans=[span(1, drive="ABSENT", quality="MISSING", tension_n=None)]),
        status({"state": "READY"}, spans=[span(1, drive="STO", tension_n=0.1)]),
        status(spans=[span(1, tension_n=1.0, setpoint_n=1.1)]),  # being tensioned
        status(spans=[span(1, tension_n=25.0)]),
        status(spans=[span(1, control="draw", quality="MISSING", tension_n=None)]),
        status(timing=status().timing.model_copy(update={"missed": 10})),
        status(spans=[span(1, tension_n=60.0, setpoint_n=60.0), span(2, tension_n=5.0, setpoint_n=5.0)]),
        status({"state": "STOP", "by_person": True}, events=[state_event("RUNNING to SLOWING: wanted")]),
        status({"state": "STOP", "by_person": True}),  # to a gateway that was not there
    ],
)
def test_what_is_as_it_should_be_is_no_alarm(found: GatewayStatus) -> None:
    assert holding(found) == {}


def test_what_is_known_no_more_is_no_alarm_of_the_line() -> None:
    stale = [span(1, tension_n=99.0, drive="FAULT")]
    assert set(holding(status(LOST, spans=stale, buses=[bus(["x"])]))) == {"loop-lost"}


@pytest.mark.parametrize("doubt", [Doubt.CELL_STUCK, Doubt.CELL_DRIFTS])
def test_a_doubted_load_cell_is_an_alarm(doubt: Doubt) -> None:
    assert holding(status({"doubts": [WORDS[doubt]]})) == {"load-cell": WORDS[doubt]}


def test_why_the_line_stopped_is_remembered_when_its_event_is_told_no_more() -> None:
    conditions = Conditions()
    broken = status({"state": "STOP"}, events=[state_event("SLOWING to UNLOADING: operator's stop of a web break")])
    for one in (broken, status({"state": "STOP"})):  # whatever its words are: no person wanted it
        assert conditions.look(one, RECORDING) == {"line-stopped": "operator's stop of a web break"}
    assert Conditions().look(status({"state": "STOP"}), RECORDING) != {}  # by a gateway that was not there


def test_a_text_without_end_is_cut() -> None:
    assert len(holding(status(buses=[bus(["x" * 10_000])]))["device-absent"]) <= 400


# ---- what becomes of them


class Alone:
    """The states without their desk, looked at four times a second."""

    def __init__(self, kept: Kept | None = None) -> None:
        self.now_s = 1000.0
        self.states = AlarmStates(self.now_s, kept or Kept())
        self.told = list[str]()

    def pass_s(self, seconds: float, *names: str) -> "Alone":
        for _ in range(round(4 * seconds)):
            self.now_s += 0.25
            for kind, text in self.states.look({name: f"{name} now" for name in names}, self.now_s):
                self.told.append(f"{kind} {text.partition(':')[0]}")
        return self

    @property
    def active(self) -> set[str]:
        return {name for name, live in self.states.live.items() if live.ended_s is None}


def test_it_comes_is_seen_and_ends() -> None:
    one = Alone().pass_s(0.25, "device-absent")
    assert one.active == {"device-absent"} and one.told == ["alarm device-absent"]
    assert one.states.acknowledge("device-absent", "anna") == ""
    assert "anna has acknowledged" in one.states.acknowledge("device-absent", "bert")
    one.pass_s(60.0, "device-absent")
    assert one.active == {"device-absent"} and len(one.told) == 1
    one.pass_s(6.0)
    assert one.states.live == {} and one.told[1:] == ["alarm-ended device-absent"]
    assert "not active" in one.states.acknowledge("device-absent", "anna")


def test_what_ends_unseen_stays_until_somebody_has_seen_it() -> None:
    one = Alone().pass_s(1.0, "device-absent").pass_s(600.0)
    assert one.states.live["device-absent"].ended_s is not None
    assert one.states.acknowledge("device-absent", "anna") == "" and one.states.live == {}


def test_what_comes_again_is_to_be_seen_again() -> None:
    one = Alone().pass_s(1.0, "device-absent")
    one.states.acknowledge("device-absent", "anna")
    one.pass_s(10.0).pass_s(1.0, "device-absent")
    assert one.states.live["device-absent"].acknowledged_by == ""


@pytest.mark.parametrize("alarm", ALARMS, ids=lambda alarm: alarm.name)
def test_it_neither_comes_nor_goes_too_soon(alarm: Any) -> None:
    one = Alone()
    if alarm.after_s:
        one.pass_s(alarm.after_s, alarm.name)  # seen for one look less
        assert one.active == set()
        one.pass_s(0.25).pass_s(alarm.after_s, alarm.name)
        assert one.active == set()
    one.pass_s(alarm.after_s + 0.25, alarm.name)
    assert one.active == {alarm.name}
    if alarm.gone_s:
        one.pass_s(alarm.gone_s - 0.25)
        assert one.active == {alarm.name}
    one.pass_s(0.25)
    assert one.active == set()


def test_what_flickers_is_told_once() -> None:
    one = Alone().pass_s(1.0, "device-absent")
    for _ in range(100):
        one.pass_s(0.5).pass_s(0.5, "device-absent")
    assert one.told == ["alarm device-absent"]


def test_the_first_of_those_that_came_together_is_marked_and_stays_so() -> None:
    one = Alone().pass_s(1.0, "drive-fault")
    assert not one.states.first_out("drive-fault")  # it is alone
    one.pass_s(0.75, "drive-fault", "tension-out-of-band")
    assert one.states.first_out("drive-fault") and not one.states.first_out("tension-out-of-band")
    one.pass_s(TOGETHER_S + 1.0, "drive-fault", "tension-out-of-band")
    one.pass_s(1.0, "drive-fault", "tension-out-of-band", "device-absent")  # of another cause
    assert not one.states.first_out("device-absent") and one.states.first_out("drive-fault")
    one.states.acknowledge("drive-fault", "anna")
    one.pass_s(10.0, "tension-out-of-band", "device-absent")
    assert [name for name in one.states.live if one.states.first_out(name)] == []


def test_what_began_first_is_first_though_it_was_told_later() -> None:
    one = Alone().pass_s(1.0, "torque-at-limit").pass_s(1.5, "torque-at-limit", "drive-fault")
    assert set(one.states.live) == {"torque-at-limit", "drive-fault"}
    assert one.states.first_out("torque-at-limit") and not one.states.first_out("drive-fault")


def test_a_stop_is_never_the_first_of_several() -> None:
    one = Alone().pass_s(1.0, "line-stopped").pass_s(0.5, "line-stopped", "device-absent")
    assert one.states.first_out("device-absent") and not one.states.first_out("line-stopped")


@given(st.lists(st.sets(st.sampled_from(sorted(BY_NAME))), max_size=60))
def test_whatever_comes_in_whatever_order_there_is_one_first_of_a_group(course: list[set[str]]) -> None:
    one = Alone()
    for names in course:
        one.pass_s(0.25, *names)
        groups = dict[str, list[str]]()
        for name, live in one.states.live.items():
            if live.together:
                groups.setdefault(live.first, []).append(name)
        for first, members in groups.items():
            assert [name for name in members if one.states.first_out(name)] in ([], [first])
            assert all(one.states.live[name].first == first for name in members)


def test_shelved_it_is_back_by_itself_and_never_later_than_a_shift() -> None:
    one = Alone().pass_s(1.0, "device-absent")
    one.states.shelve("device-absent", 60.0, one.now_s)
    one.pass_s(59.0, "device-absent")
    assert "device-absent" in one.states.shelved and one.active == {"device-absent"}
    one.pass_s(2.0, "device-absent")
    assert one.states.shelved == {} and one.states.live["device-absent"].acknowledged_by == ""
    one.states.shelve("device-absent", 1e9, one.now_s)
    assert one.states.shelved["device-absent"].until_s <= one.now_s + LONGEST_SHELVED_S


def test_a_restart_forgets_neither_who_has_seen_it_nor_what_is_shelved() -> None:
    before = Alone().pass_s(1.0, "device-absent", "load-cell")
    before.states.acknowledge("device-absent", "anna")
    before.states.shelve("load-cell", 600.0, before.now_s)
    after = Alone(before.states.kept(before.now_s))
    assert set(after.states.shelved) == {"load-cell"}
    after.pass_s(5.0).pass_s(1.0, "device-absent", "load-cell")  # the loop has to be heard first
    assert after.states.live["device-absent"].acknowledged_by == "anna"
    assert after.states.live["load-cell"].acknowledged_by == ""
    twice = Alone(after.states.kept(after.now_s))
    assert twice.states.kept(twice.now_s).acknowledged == {"device-absent": "anna"}


def test_what_comes_long_after_a_restart_is_to_be_seen_anew() -> None:
    one = Alone(Kept(acknowledged={"device-absent": "anna"})).pass_s(RESTORED_S + 1.0).pass_s(1.0, "device-absent")
    assert one.states.live["device-absent"].acknowledged_by == ""


# ---- the desk


class Desk:
    """A gateway process's alarms, its mailbox, and whoever speaks to it over its socket."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.now_s, self.wall_ahead_s = 1000.0, 1_700_000_000.0
        self.records = list[tuple[str, str, Mapping[str, Any]]]()
        self.notes = list[tuple[str, str]]()
        self.shelved = list[AuditRecord]()
        self.audit_open = True
        self.begin()

    def begin(self) -> None:
        self.mailbox = UnixMailbox()
        self.alarms = Alarms(
            self.mailbox, self.folder, self.append, self.note,
            lambda: self.now_s, lambda: self.now_s + self.wall_ahead_s, self.shelvings,
        )  # fmt: skip
        operated = Operated(self.append, lambda: 0.0)
        PersonsDesk(self.mailbox, self._none, self._none, self.alarms.say, operated, lambda: 0.0)

    def note(self, kind: str, text: str, **_: object) -> None:
        self.notes.append((kind, text))

    async def _none(self, *_: object) -> Reply:
        raise AssertionError

    async def append(self, kind: str, who: Who, what: Mapping[str, Any]) -> None:
        if not self.audit_open:
            raise AuditUnavailable("the disk is full")
        self.records.append((kind, who.name, what))
        record = AuditRecord(
            sequence=len(self.records), wall_s=self.now_s + self.wall_ahead_s, monotonic_s=self.now_s, boot=boot_id(),
            kind=kind, who=who, what=dict(what), previous=BEFORE_FIRST,
        )  # fmt: skip
        self.shelved += [record] if kind == "shelved" else []

    async def shelvings(self) -> list[AuditRecord] | None:
        return self.shelved if self.audit_open else None

    def keep(self) -> None:
        asyncio.run(self.alarms.keep())

    def look(self, found: GatewayStatus, seconds: float = 0.25) -> None:
        for _ in range(round(4 * seconds)):
            self.now_s += 0.25
            self.alarms.look(found, RECORDING)

    def ask(self, said: AlarmSaid, person: Person | None = None) -> Reply:
        payload = ALARM_SAID.dump_json(said) if person is None else _of(person, said)
        return self.send(payload, GATEWAY_ALARM if person is None else GATEWAY_FOR_PERSON)

    def send(self, payload: bytes, topic: Any = GATEWAY_ALARM) -> Reply:
        async def asked() -> Reply:
            asking = UnixMailbox()
            try:
                await self.mailbox.listen(self.folder / "g.sock")
                asking.connect((topic,), self.folder / "g.sock")
                return Reply.model_validate_json(await asking.request(topic, payload, 5.0))
            finally:
                await asking.close()
                await self.mailbox.close()

        return asyncio.run(asked())

    def listed(self) -> list[AlarmStatus]:
        return self.alarms.status()


def _of(person: Person, said: AlarmSaid) -> bytes:
    return ForPerson(person=person, said=said).model_dump_json().encode()


@pytest.fixture
def desk() -> Iterator[Desk]:
    with short_folder() as folder:
        yield Desk(folder)


ABSENT = CASES["device-absent"][0]


def test_the_status_tells_what_means_what_and_since_when(desk: Desk) -> None:
    desk.look(ABSENT)
    (one,) = desk.listed()
    row = BY_NAME["device-absent"]
    assert (one.name, one.priority, one.action) == (row.name, row.priority, row.action)
    assert one.active and not one.acknowledged and one.text == "drive-3 on can0: no heartbeat"
    assert one.since_wall_s == 1_700_001_000.25 and one.ended_wall_s is None and one.shelved_until_wall_s is None
    assert desk.notes == [("alarm", "device-absent: a device does not answer: drive-3 on can0: no heartbeat")]


def test_what_needs_a_look_first_stands_first(desk: Desk) -> None:
    late = status().timing.model_copy(update={"missed": 50})
    found = status(buses=[bus(["a"])], spans=[span(1, quality="BAD")], timing=late)
    desk.look(found)
    assert [one.name for one in desk.listed()] == ["device-absent", "load-cell", "cycles-late"]
    desk.ask(AcknowledgeAlarm(alarm="device-absent"))
    desk.ask(ShelveAlarm(alarm="load-cell", for_s=60.0, because="being mended"))
    assert [one.name for one in desk.listed()] == ["cycles-late", "device-absent", "load-cell"]


def test_whoever_is_at_the_socket_acknowledges_in_their_own_name_on_record(desk: Desk) -> None:
    desk.look(ABSENT)
    reply = desk.ask(AcknowledgeAlarm(alarm="device-absent", comment="the plug is out"))
    assert reply.ok and reply.text == "device-absent is acknowledged"
    ((kind, who, what),) = desk.records
    assert (kind, what) == ("acknowledged", {"alarm": "device-absent", "comment": "the plug is out"})
    (one,) = desk.listed()
    assert one.acknowledged and one.acknowledged_by == who


def test_a_person_who_came_in_through_opc_ua_is_named_and_a_viewer_is_refused(desk: Desk) -> None:
    desk.look(ABSENT)
    viewer = Person(name="bert", role="viewer", through="page")
    assert "bert is a viewer" in desk.ask(AcknowledgeAlarm(alarm="device-absent"), viewer).text
    assert not desk.listed()[0].acknowledged
    person = Person(name="anna", role="operator", through="opc-ua")
    assert desk.ask(AcknowledgeAlarm(alarm="device-absent"), person).ok
    assert desk.ask(ShelveAlarm(alarm="device-absent", for_s=60.0, because="mended at noon"), person).ok
    assert desk.listed()[0].acknowledged_by == "anna (operator, opc-ua)"
    assert [kind for kind, _, _ in desk.records] == ["refused-person", "acknowledged", "shelved"]
    assert {"acknowledge", "shelve"} <= set(LEAST)


def test_shelved_and_back_at_once(desk: Desk) -> None:
    desk.look(ABSENT)
    assert desk.ask(ShelveAlarm(alarm="device-absent", for_s=3600.0, because="being exchanged")).ok
    assert desk.listed()[0].shelved_until_wall_s == 1_700_000_000.0 + desk.now_s + 3600.0
    assert desk.ask(ShelveAlarm(alarm="device-absent", for_s=0.0, because="done")).ok
    assert desk.listed()[0].shelved_until_wall_s is None
    assert [what["because"] for _, _, what in desk.records] == ["being exchanged", "done"]
    assert "is not shelved" in desk.ask(ShelveAlarm(alarm="device-absent", for_s=0.0, because="again")).reasons[0]


def test_one_that_is_not_active_may_be_shelved_and_is_listed_as_that(desk: Desk) -> None:
    assert desk.ask(ShelveAlarm(alarm="load-cell", for_s=60.0, because="it will be taken out")).ok
    (one,) = desk.listed()
    assert not one.active and one.acknowledged and one.text == "" and one.since_wall_s == 1_700_001_000.0
    desk.look(status(), 61.0)
    assert desk.listed() == []


def test_nothing_is_shelved_off_the_record_but_seen_and_brought_back_it_may_be(desk: Desk) -> None:
    desk.look(ABSENT)
    desk.ask(ShelveAlarm(alarm="device-absent", for_s=60.0, because="x"))
    desk.audit_open = False
    refused = desk.ask(ShelveAlarm(alarm="load-cell", for_s=60.0, because="x"))
    assert not refused.ok and refused.reasons == ["the disk is full"]
    assert desk.ask(ShelveAlarm(alarm="device-absent", for_s=0.0, because="x")).ok
    seen = desk.ask(AcknowledgeAlarm(alarm="device-absent"))
    assert seen.ok and "could not be recorded: the disk is full" in seen.text
    assert [one.name for one in desk.listed() if one.shelved_until_wall_s] == []


@pytest.mark.parametrize(
    ("said", "told"),
    [
        (AcknowledgeAlarm(alarm="device-absent"), "device-absent is not active"),
        (AcknowledgeAlarm(alarm="device-absend"), "did you mean device-absent?"),
        (ShelveAlarm(alarm="nothing", for_s=60.0, because="x"), "alarms are: device-absent, "),
    ],
)
def test_what_cannot_be_is_refused_with_what_can(desk: Desk, said: AlarmSaid, told: str) -> None:
    reply = desk.ask(said)
    assert not reply.ok and told in reply.reasons[0] and desk.records == []


@pytest.mark.parametrize(
    "payload",
    [b"", b'{"command": "shelve", "alarm": "load-cell", "for_s": 28801, "because": "x"}',
     b'{"command": "shelve", "alarm": "load-cell", "for_s": 60, "because": ""}',
     b'{"command": "silence", "alarm": "load-cell"}'],
)  # fmt: skip
def test_what_is_none_of_these_is_not_understood(desk: Desk, payload: bytes) -> None:
    reply = desk.send(payload)
    assert not reply.ok and reply.text == "not understood" and reply.reasons


def test_a_gateway_that_begins_anew_knows_what_was_seen_and_shelved(desk: Desk) -> None:
    desk.look(status(buses=[bus(["a"])], spans=[span(1, quality="BAD")]))
    desk.ask(AcknowledgeAlarm(alarm="device-absent"))
    desk.ask(ShelveAlarm(alarm="load-cell", for_s=600.0, because="being mended"))
    desk.begin()
    desk.keep()
    desk.now_s += 10.0
    desk.look(status(buses=[bus(["a"])], spans=[span(1, quality="BAD")]))
    told = {one.name: one for one in desk.listed()}
    assert told["device-absent"].acknowledged and not told["load-cell"].acknowledged
    assert abs((told["load-cell"].shelved_until_wall_s or 0.0) - 1_700_001_600.0) < 1.0


def written(desk: Desk, **shelved_until_s: float) -> None:
    """As whoever may write the folder can write it."""
    names = {name.replace("_", "-"): at_s for name, at_s in shelved_until_s.items()}
    said = {"format": 1, "acknowledged": {}, "boot": boot_id(), "shelved_until_s": names}
    wall = {name: at_s + desk.wall_ahead_s for name, at_s in names.items()}
    (desk.folder / FILE_NAME).write_text(json.dumps({**said, "shelved_until_wall_s": wall}))


def silent(desk: Desk) -> dict[str, float]:
    """Alarms on the shelf, and until when."""
    return {one.name: one.shelved_until_wall_s - desk.wall_ahead_s for one in desk.listed() if one.shelved_until_wall_s}


def test_what_no_record_has_put_on_the_shelf_is_not_silent_after_a_restart_and_told(desk: Desk) -> None:
    desk.ask(ShelveAlarm(alarm="load-cell", for_s=600.0, because="being mended"))
    desk.ask(ShelveAlarm(alarm="drive-fault", for_s=600.0, because="being mended"))
    desk.ask(ShelveAlarm(alarm="drive-fault", for_s=0.0, because="done"))
    written(desk, load_cell=desk.now_s + 28_000.0, device_absent=desk.now_s + 600.0, drive_fault=desk.now_s + 600.0)
    desk.begin()
    desk.keep()
    assert silent(desk) == pytest.approx({"load-cell": 1600.0})  # for as long as it is on record
    told = [text for kind, text in desk.notes if kind == "alarm-not-shelved"]
    assert len(told) == 3 and all(name in " ".join(told) for name in ("load-cell", "device-absent", "drive-fault"))
    desk.begin()
    desk.keep()  # told once: the file says now what is on record
    assert len([kind for kind, _ in desk.notes if kind == "alarm-not-shelved"]) == 3
    assert silent(desk) == pytest.approx({"load-cell": 1600.0}, abs=1.0)


def test_until_the_records_can_be_read_nothing_is_silent_and_nothing_is_forgotten(desk: Desk) -> None:
    desk.ask(ShelveAlarm(alarm="load-cell", for_s=600.0, because="being mended"))
    desk.audit_open = False
    for _ in range(2):  # and again, before the audit is there
        desk.begin()
        desk.keep()
        desk.now_s += 10.0
        assert not silent(desk)
    desk.audit_open = True
    desk.keep()
    assert silent(desk) == pytest.approx({"load-cell": 1600.0}, abs=1.0) and not desk.notes


@pytest.mark.parametrize("jump_s", [1e9, -1e9, 3600.0, -3600.0])
def test_a_clock_that_is_set_while_the_gateway_is_down_keeps_what_is_shelved_as_long_as_it_was_to_be(
    desk: Desk, jump_s: float
) -> None:
    desk.ask(ShelveAlarm(alarm="load-cell", for_s=600.0, because="being mended"))
    desk.wall_ahead_s += jump_s
    desk.begin()
    desk.keep()
    for passed_s, shelved in ((590.0, True), (20.0, False)):
        desk.now_s += passed_s
        desk.look(status(spans=[span(1, quality="BAD")]))
        assert any(one.shelved_until_wall_s for one in desk.listed()) == shelved


@pytest.mark.parametrize(
    "content",
    [b"", b"\xff", b"{}", b'{"format": 1, "acknowledged": {"x": 1}, "shelved_until_wall_s": {}}', b"[" * 100_000,
     json.dumps({"format": 1, "acknowledged": {}, "shelved_until_wall_s": {"load-cell": 1e300}}).encode()],
)  # fmt: skip
def test_a_file_that_is_none_lets_alarms_come_again_and_none_be_silent_for_long(content: bytes) -> None:
    with short_folder() as folder:
        (folder / FILE_NAME).write_bytes(content)
        desk = Desk(folder)
        desk.keep()
        desk.look(ABSENT)
        told = {one.name: one for one in desk.listed()}
        assert not told.pop("device-absent").acknowledged
        for one in told.values():
            assert (one.shelved_until_wall_s or 0.0) <= 1_700_000_000.0 + 1000.0 + LONGEST_SHELVED_S


def test_whoever_says_without_end_what_is_of_alarms_fills_no_audit(desk: Desk) -> None:
    said = ALARM_SAID.dump_json(ShelveAlarm(alarm="load-cell", for_s=60.0, because="x"))

    async def flood() -> list[Reply]:
        asking = UnixMailbox()
        try:
            await desk.mailbox.listen(desk.folder / "g.sock")
            asking.connect((GATEWAY_ALARM,), desk.folder / "g.sock")
            return [
                Reply.model_validate_json(await asking.request(GATEWAY_ALARM, said, 5.0))
                for _ in range(3 * round(OF_DECISIONS.at_once))
            ]
        finally:
            await asking.close()
            await desk.mailbox.close()

    replies = asyncio.run(flood())
    assert sum(reply.ok for reply in replies) == len(desk.records) == OF_DECISIONS.at_once
    assert {one.code for reply in replies for one in reply.findings} == {"inbox-rate"}
    assert 0 < len([kind for kind, _ in desk.notes if kind == "said-of-alarms"]) <= 10


def test_where_the_file_cannot_be_written_it_is_told(desk: Desk) -> None:
    desk.look(ABSENT)
    (desk.folder / FILE_NAME).with_suffix(".part").mkdir()
    reply = desk.ask(AcknowledgeAlarm(alarm="device-absent"))
    assert reply.ok and "the next start of the gateway will not know" in reply.text
    assert desk.listed()[0].acknowledged


def test_an_alarm_that_came_again_is_not_acknowledged_by_whoever_saw_the_first(desk: Desk) -> None:
    desk.look(ABSENT)
    first = desk.listed()[0].since_wall_s
    desk.ask(AcknowledgeAlarm(alarm="device-absent", since_wall_s=first))
    desk.look(status(), 30.0)
    assert desk.listed() == []
    desk.look(ABSENT, 1.0)
    again = desk.listed()[0].since_wall_s
    assert again > first
    reply = desk.ask(AcknowledgeAlarm(alarm="device-absent", since_wall_s=first))
    assert not reply.ok and "another than the one that was shown" in reply.reasons[0]
    assert not desk.listed()[0].acknowledged
    assert desk.ask(AcknowledgeAlarm(alarm="device-absent", since_wall_s=again)).ok
