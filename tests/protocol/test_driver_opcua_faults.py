"""The OPC UA link when the server stops, dies, comes back, or is another one; the engine is in the same event loop."""

import asyncio
from collections.abc import Awaitable, Callable, Iterator

import pytest

from drivers.opcua.engine import Engine
from drivers.opcua.messages import Outcome, Plan, Question
from drivers.opcua.nodes import Node
from drivers.port import PrepareRefused
from gateway.core.signals import DriveState, Quality
from tests.protocol.driver_opcua_support import NAMESPACE, DeviceServer, Rig, device_server, line, link_in_process
from tests.protocol.driver_support import until

pytestmark = pytest.mark.wires

LIFE = Node(NAMESPACE, "Axis1.Life", "u16")


@pytest.fixture(scope="module")
def shared_server() -> Iterator[DeviceServer]:
    with device_server() as server:
        yield server


@pytest.fixture
def server(shared_server: DeviceServer) -> Iterator[DeviceServer]:
    shared_server.reset()
    yield shared_server
    shared_server.reset()


def run(server: DeviceServer, scene: Callable[[Rig], Awaitable[None]]) -> None:
    async def play() -> None:
        link = link_in_process(line(server.endpoint))
        try:
            await link.open()
            await scene(Rig(link))
        finally:
            await link.close()

    asyncio.run(play())


def test_a_server_that_freezes_is_missed_and_what_it_missed_never_acts(server: DeviceServer) -> None:
    devices = server.devices

    async def scene(rig: Rig) -> None:
        await rig.enable()
        server.freeze()
        await rig.cycle(0.05)
        last = len(devices.writes)
        await rig.until(lambda: len(rig.link.health.absent) == 4)
        assert list(rig.inputs.drive_state) == [DriveState.ABSENT] * 2
        assert list(rig.inputs.tension.quality) == [Quality.STALE] * 2
        assert rig.inputs.plc.quality == Quality.STALE
        assert list(rig.inputs.tension.value) == [10.0, 20.0]
        await rig.until(lambda: "no answer in time" in rig.link.health.last_error)
        reads = devices.reads
        server.thaw()
        await rig.until(lambda: rig.inputs.tension.good() and rig.inputs.plc.quality == Quality.GOOD)
        await rig.until(lambda: devices.reads > reads + 3)
        # One command was with the server when it stopped; the drives, given up meanwhile, got none after it.
        assert len([write for write in devices.writes[last:] if "Axis1.Life" in write]) <= 1
        assert list(rig.inputs.drive_state) == [DriveState.FAULT] * 2
        assert rig.link.health.reconnects >= 1

    run(server, scene)


def test_an_answer_after_its_cycle_is_counted_and_not_used(server: DeviceServer) -> None:
    async def scene(rig: Rig) -> None:
        await rig.until(rig.inputs.tension.good)
        server.freeze()
        await rig.cycle(0.02)
        assert list(rig.inputs.tension.quality) == [Quality.STALE] * 2
        server.devices.set("Cell1.Tension", 33.0)
        server.thaw()
        late = rig.link.health.malformed
        await until(lambda: rig.link.health.malformed > late)
        assert "after its cycle" in rig.link.health.last_error
        assert rig.inputs.tension.value[0] == 10.0
        await rig.cycle()
        assert rig.inputs.tension.value[0] == 33.0

    run(server, scene)


def test_after_a_restart_nothing_is_written_before_the_watchdogs_are_read_back(server: DeviceServer) -> None:
    devices = server.devices

    async def scene(rig: Rig) -> None:
        await rig.enable()
        server.crash()
        await rig.until(lambda: len(rig.link.health.absent) == 4)
        devices.reset()  # a server that starts anew knows of no watchdog
        server.listen()
        await rig.until(lambda: rig.inputs.tension.good())
        for _ in range(5):
            await rig.cycle()
        assert devices.writes == []
        assert rig.inputs.plc.quality == Quality.STALE
        assert "plc: watchdog reads 0, 100 was set" in rig.link.health.last_error
        assert list(rig.inputs.drive_state) == [DriveState.FAULT] * 2
        await rig.enable()  # a person arms again

    run(server, scene)


def test_a_plc_whose_watchdog_survived_is_commanded_again(server: DeviceServer) -> None:
    devices = server.devices

    async def scene(rig: Rig) -> None:
        await rig.enable()
        server.crash()
        await rig.until(lambda: len(rig.link.health.absent) == 4)
        devices.writes.clear()
        server.listen()
        await rig.until(lambda: devices.written("Line.Life") != [])
        assert devices.written("Axis1.Life") == []  # drives that were lost are not

    run(server, scene)


def test_another_device_behind_the_same_address_is_not_believed(server: DeviceServer) -> None:
    devices = server.devices

    async def scene(rig: Rig) -> None:
        await rig.until(rig.inputs.tension.good)
        server.crash()
        await rig.until(lambda: len(rig.link.health.absent) == 4)
        devices.set("Amplifier.DeviceId", 0x9999)
        devices.set("Axis1.DeviceId", 0x9999)
        server.listen()
        await rig.until(lambda: rig.inputs.plc.quality == Quality.GOOD)
        await rig.cycle()
        assert list(rig.inputs.tension.quality) == [Quality.BAD] * 2
        assert list(rig.inputs.drive_state) == [DriveState.ABSENT, DriveState.OFF]

    run(server, scene)


def test_no_server_is_said_with_the_reason(server: DeviceServer) -> None:
    async def scene() -> None:
        server.crash()
        link = link_in_process(line(server.endpoint))
        rig = Rig(link)
        with pytest.raises(OSError, match=f"bus server: no connection to {server.endpoint}"):
            await link.open()
        with pytest.raises(PrepareRefused, match="server-not-connected"):
            await link.prepare()
        await rig.cycle()
        assert rig.inputs.plc.quality == Quality.MISSING
        server.listen()
        await rig.until(rig.inputs.tension.good)
        await link.close()
        await link.close()

    asyncio.run(scene())


def test_a_server_without_the_namespace_is_refused_by_name(server: DeviceServer) -> None:
    async def scene() -> None:
        engine = Engine(Plan(server.endpoint, "none", "", "", "", [Node("urn:other", "x", "u16")]), 1)
        deadline_s = asyncio.get_running_loop().time() + 5.0
        answer = await engine.answer(Question(1, 0, deadline_s, deadline_s, True, (), ()))
        assert answer.outcome is Outcome.NO_CONNECTION
        assert "no namespace 'urn:other'" in answer.text and NAMESPACE in answer.text
        await engine.close()

    asyncio.run(scene())


def test_what_came_too_late_or_was_meant_for_another_connection_is_not_written(server: DeviceServer) -> None:
    async def scene() -> None:
        engine = Engine(Plan(server.endpoint, "none", "", "", "", [LIFE]), 1)
        now_s = asyncio.get_running_loop().time()
        connected = await engine.answer(Question(1, 0, now_s + 5.0, now_s + 5.0, True, (), ()))
        assert connected.outcome is Outcome.DONE
        here = connected.connection
        for number, (connection, write_by_s, outcome) in enumerate(
            [(here, now_s, Outcome.TOO_LATE), (here + 1, now_s + 5.0, Outcome.OTHER_CONNECTION)], 2
        ):
            question = Question(number, connection, write_by_s, now_s + 5.0, False, ((0, 7.0),), (0,))
            assert (await engine.answer(question)).outcome is outcome
        assert server.devices.writes == []
        question = Question(4, here, now_s + 5.0, now_s + 5.0, False, ((0, 7.0),), (0,))
        assert (await engine.answer(question)).readings[0][:2] == (0, 7.0)
        await engine.close()

    asyncio.run(scene())


def test_security_without_files_connects_nothing(server: DeviceServer) -> None:
    async def scene() -> None:
        for files in (("", "", ""), ("/c.der", "/k.der", "")):
            engine = Engine(Plan(server.endpoint, "Basic256Sha256", *files, [LIFE]), 1)
            deadline_s = asyncio.get_running_loop().time() + 5.0
            answer = await engine.answer(Question(1, 0, deadline_s, deadline_s, True, (), ()))
            assert answer.outcome is Outcome.NO_CONNECTION
            assert "without certificates of both sides" in answer.text
            await engine.close()

    asyncio.run(scene())
