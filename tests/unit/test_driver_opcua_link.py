"""The OPC UA link on a scripted channel: what it asks when, and what an answer at the wrong moment does. No server."""

import asyncio
from collections.abc import Awaitable, Callable, Sequence
from typing import cast

from asyncua import ua
from asyncua.ua.ua_binary import struct_to_binary

from drivers.device_map import MAPS, load_map
from drivers.opcua.build import build_on
from drivers.opcua.engine import Engine
from drivers.opcua.link import ANSWER_TIMEOUT_S, HUNG_S, OpcUaLink
from drivers.opcua.messages import Answer, Outcome, Plan, Question
from drivers.opcua.nodes import Node, Reading
from drivers.opcua.services import Request, Services
from drivers.opcua.session import Session
from drivers.opcua.status import BAD_TRANSACTION_FAILED
from drivers.wiring import Wired
from gateway.core.signals import DriveRequest, DriveState, Inputs, Outputs, Quality
from tests.protocol.driver_opcua_support import Devices, line

REFUSED = 0x803B0000  #: BadNotWritable


class ScriptedChannel:
    """Answers from `devices` at once, unless it is told to wait."""

    def __init__(self, plan: Plan) -> None:
        self.up = asyncio.Event()
        self.devices = Devices()
        self.connection = 7
        self.waits = False
        self.questions: list[Question] = []
        self.given_up: list[str] = []
        self._heard: tuple[str, Callable[[], object]] | None = None
        self._later: tuple[int, Callable[[], object]] | None = None
        self._nodes = [node.identifier for node in plan.nodes]
        self._on_answer: Callable[[Answer], None] = lambda answer: None
        self._on_lost: Callable[[str], None] = lambda why: None

    def start(self, on_answer: Callable[[Answer], None], on_lost: Callable[[str], None]) -> None:
        self._on_answer, self._on_lost = on_answer, on_lost
        self.up.set()

    def tend(self, now_s: float) -> None: ...

    def ask(self, question: Question) -> bool:
        self.questions.append(question)
        if self._heard is not None and self._heard[0] in self.names(question)[0]:
            self._heard[1]()
        if not self.waits:
            asyncio.get_running_loop().call_soon(self.answer, question)
        return True

    def give_up(self, why: str) -> None:
        self.given_up.append(why)
        self._on_lost(why)

    async def close(self) -> None: ...

    def names(self, question: Question) -> tuple[set[str], set[str]]:
        """What a question writes and reads."""
        return {self._nodes[place] for place, _ in question.writes}, {self._nodes[place] for place in question.reads}

    def names_of(self, place: int) -> list[str]:
        return [self._nodes[place]]

    def on_write(self, node: str, act: Callable[[], object]) -> None:
        """Do `act` when a question comes that writes `node`."""
        self._heard = (node, act)

    def after_reads(self, count: int, act: Callable[[], object]) -> None:
        """Do `act` when so many questions from now on have been answered."""
        self._later = (len(self.questions) + count, act)

    def answer(self, question: Question, outcome: Outcome = Outcome.DONE) -> None:
        if outcome is not Outcome.DONE:
            self._on_answer(Answer(question.number, outcome, self.connection, text="scripted"))
            return
        writes = [(self._nodes[place], number) for place, number in question.writes]
        written = [self.devices.refuses.get(node, 0) for node, _ in writes]
        for node, number in writes:
            self.devices.act(node, number)
        self.devices.begin_read()
        nodes = [self._nodes[place] for place in question.reads]
        readings = tuple(
            Reading(
                self.devices.status.get(node, 0),
                0.0 if "Serial" in node else float(self.devices.value(node)),
                self.devices.source_us(node),
            )
            for node in nodes
        )
        self._on_answer(Answer(question.number, outcome, self.connection, tuple(written), readings))
        if self._later is not None and len(self.questions) >= self._later[0]:
            self._later[1]()
            self._later = None


class Rig:
    """A link that has been prepared and commands its drives. `now_s` is the loop's clock, put forward by hand."""

    def __init__(self) -> None:
        of_line = line("opc.tcp://127.0.0.1:4840")
        items = [*of_line.drives, *of_line.load_cells, of_line.plc]
        wired = [Wired(item, of_line.buses[0], load_map(MAPS / f"{item.map}.toml")) for item in items]
        made: list[ScriptedChannel] = []

        def channel(plan: Plan) -> ScriptedChannel:
            made.append(ScriptedChannel(plan))
            return made[0]

        links, reasons = build_on(of_line, wired, channel)
        link = links[0]
        assert not reasons and isinstance(link, OpcUaLink)
        self.link, self.channel = link, made[0]
        self.inputs, self.outputs = Inputs(2), Outputs(2)
        self.outputs.drive_request[:] = DriveRequest.READY

    async def arm(self) -> None:
        await self.link.open()
        await self.link.prepare()
        for _ in range(3):
            await self.cycle()
        assert self.channel.names(self.question)[0] >= {"Axis1.Life", "Axis2.Life", "Line.Life"}
        assert list(self.inputs.drive_state) == [DriveState.READY] * 2

    async def cycle(self, now_s: float | None = None) -> None:
        now_s = asyncio.get_running_loop().time() if now_s is None else now_s
        self.link.trigger(now_s)
        await asyncio.sleep(0)
        await self.link.collect(self.inputs, 0.0)
        self.link.write(self.outputs)

    @property
    def question(self) -> Question:
        """The last one."""
        return self.channel.questions[-1]


def run(scene: Callable[[Rig], Awaitable[None]]) -> None:
    async def play() -> None:
        rig = Rig()
        await rig.arm()
        await scene(rig)

    asyncio.run(play())


def test_a_connection_that_was_made_anew_between_two_cycles_has_to_prove_itself() -> None:
    async def scene(rig: Rig) -> None:
        rig.channel.connection += 1
        await rig.cycle()  # its writes were for the old one; what is read cannot be told from another device's
        assert list(rig.inputs.drive_state) == [DriveState.READY] * 2
        assert list(rig.inputs.speed.quality) == [Quality.STALE] * 2
        await rig.cycle()
        writes, reads = rig.channel.names(rig.question)
        assert writes == set()
        assert reads >= {"Axis1.DeviceId", "Axis1.Watchdog", "Axis2.Watchdog", "Line.DeviceId", "Line.Watchdog"}
        await rig.cycle()
        writes, reads = rig.channel.names(rig.question)
        assert {"Axis1.Life", "Line.Life"} <= writes and "Axis1.Watchdog" not in reads
        assert rig.link.health.reconnects == 1

    run(scene)


def test_a_watchdog_that_is_another_after_that_is_the_end_of_writing() -> None:
    async def scene(rig: Rig) -> None:
        rig.channel.connection += 1
        rig.channel.devices.set("Axis1.Watchdog", 0)
        for _ in range(4):
            await rig.cycle()
        writes, _ = rig.channel.names(rig.question)
        assert "Axis1.Life" not in writes and {"Axis2.Life", "Line.Life"} <= writes
        assert list(rig.inputs.drive_state) == [DriveState.FAULT, DriveState.READY]

    run(scene)


def test_a_lost_connection_is_doubted_before_there_is_another() -> None:
    async def scene(rig: Rig) -> None:
        for outcome in (Outcome.NO_CONNECTION, Outcome.FAILED):
            rig.channel.waits = True
            await rig.cycle()
            rig.channel.answer(rig.question, outcome)
            rig.channel.waits = False
            await rig.cycle()
            writes, reads = rig.channel.names(rig.question)
            assert writes == set() and "Line.Watchdog" in reads
            assert rig.inputs.tension.good()
            await rig.cycle()
            assert "Line.Life" in rig.channel.names(rig.question)[0]

    run(scene)


def test_a_refusal_that_comes_late_stops_the_command_that_waits() -> None:
    async def scene(rig: Rig) -> None:
        rig.channel.devices.refuses["Axis1.Life"] = REFUSED
        rig.channel.waits = True
        await rig.cycle()
        rig.channel.answer(rig.question)
        rig.channel.waits = False
        await rig.cycle()
        assert "Axis1.Life" not in rig.channel.names(rig.question)[0]
        assert rig.inputs.drive_state[0] == DriveState.FAULT

    run(scene)


def test_a_transaction_that_failed_for_no_ones_fault_is_everybodys() -> None:
    async def scene(rig: Rig) -> None:
        rig.channel.devices.refuses |= dict.fromkeys(("Axis1.Life", "Axis2.Life", "Line.Life"), BAD_TRANSACTION_FAILED)
        await rig.cycle()
        assert list(rig.inputs.drive_state) == [DriveState.FAULT] * 2
        assert rig.inputs.plc.quality == Quality.STALE

    run(scene)


def test_one_question_at_a_time_and_a_command_that_waited_is_dropped() -> None:
    async def scene(rig: Rig) -> None:
        rig.channel.waits = True
        await rig.cycle()
        asked = len(rig.channel.questions)
        rig.outputs.torque_nm[:] = 1.0
        for _ in range(2):
            await rig.cycle()
        assert len(rig.channel.questions) == asked
        assert rig.link.health.timeouts > 0
        rig.channel.answer(rig.question)
        assert rig.link.health.malformed == 1
        now_s = asyncio.get_running_loop().time()
        rig.link.trigger(now_s)  # takes the newest command
        rig.channel.answer(rig.question)
        rig.link.trigger(now_s)  # nothing was handed over since
        assert rig.channel.names(rig.question)[0] == set()

    run(scene)


def test_an_engine_that_says_nothing_is_ended_in_time_and_not_before() -> None:
    async def scene(rig: Rig) -> None:
        rig.channel.waits = True
        await rig.cycle()
        limit_s = rig.question.write_by_s - 0.1 + ANSWER_TIMEOUT_S + HUNG_S
        await rig.cycle(limit_s - 0.01)
        assert rig.channel.given_up == []
        await rig.cycle(limit_s + 0.01)
        assert len(rig.channel.given_up) == 1
        assert rig.link.health.absent == ["cell-1, cell-2", "drive-1", "drive-2", "plc"]

    run(scene)


def test_an_answer_to_no_question_is_counted_and_nothing_else() -> None:
    async def scene(rig: Rig) -> None:
        rig.channel.answer(rig.question)
        assert rig.link.health.malformed == 1
        assert rig.link.health.last_error == "an answer to no question"

    run(scene)


def test_a_cancelled_prepare_leaves_the_link_usable() -> None:
    async def scene(rig: Rig) -> None:
        rig.channel.waits = True
        arming = asyncio.create_task(rig.link.prepare())
        await asyncio.sleep(0)
        arming.cancel()
        await asyncio.gather(arming, return_exceptions=True)
        rig.channel.answer(rig.question)
        rig.channel.waits = False
        await rig.cycle()
        assert rig.channel.names(rig.question)[0] == set()
        await rig.link.prepare()

    run(scene)


class ScriptedSession:
    """Answers the requests of an engine, in order; those beyond are not answered."""

    is_open = True

    def __init__(self, *answers: bytes) -> None:
        self._answers = answers
        self.dropped = False
        self.asked: list[asyncio.Future[bytes]] = []

    def ask(self, requests: Sequence[Request]) -> list[asyncio.Future[bytes]]:
        self.asked = [asyncio.get_running_loop().create_future() for _ in requests]
        for future, answer in zip(self.asked, self._answers, strict=False):
            future.set_result(answer)
        return self.asked

    async def drop(self) -> None:
        self.dropped = True


async def ask_engine(session: ScriptedSession, writes: tuple[tuple[int, float], ...]) -> Answer:
    """The answer to a question that also reads a node."""
    engine = Engine(Plan("opc.tcp://h:1", "none", "", "", "", [Node("urn:x", "A", "u16")]), 0)
    engine._session, engine._services = cast(Session, session), Services([b"\0\1"], ["u16"])  # noqa: SLF001
    deadline_s = asyncio.get_running_loop().time() + 0.05
    return await engine.answer(Question(1, 0, deadline_s, deadline_s, False, writes, (0,)))


READ = struct_to_binary(ua.ReadResponse(Results=[ua.DataValue(ua.Variant(7, ua.VariantType.UInt16), StatusCode=None)]))
WRITTEN = struct_to_binary(ua.WriteResponse(Results=[ua.StatusCode(REFUSED)]))


def test_an_answer_of_another_service_is_no_answer() -> None:
    async def scene() -> None:
        session = ScriptedSession(WRITTEN)
        answer = await ask_engine(session, ())
        assert (answer.outcome, session.dropped) == (Outcome.FAILED, True)
        assert "not ReadResponse" in answer.text

    asyncio.run(scene())


def test_write_and_read_are_sent_at_once_and_both_answered() -> None:
    async def scene() -> None:
        session = ScriptedSession(WRITTEN, READ)
        answer = await ask_engine(session, ((0, 1.0),))
        assert answer == Answer(1, Outcome.DONE, 0, (REFUSED,), (Reading(0, 7.0),))
        assert len(session.asked) == 2

    asyncio.run(scene())


def test_what_was_written_is_told_though_the_read_is_not_answered() -> None:
    async def scene() -> None:
        session = ScriptedSession(WRITTEN)
        answer = await ask_engine(session, ((0, 1.0),))
        assert answer == Answer(1, Outcome.FAILED, 0, (REFUSED,), text="no answer in time")
        assert session.dropped and session.asked[1].cancelled()

    asyncio.run(scene())
