"""An arming, or a release, that is cancelled at any point and again: nothing of it is left, on Modbus and on OPC UA."""

import asyncio
from collections.abc import Iterator

import pytest

from drivers.modbus.link import ModbusLink
from gateway.core.signals import DriveRequest, DriveState, Inputs
from tests.protocol.driver_opcua_support import DeviceServer, Rig, device_server, line, link_in_process
from tests.protocol.driver_support import Registers, cycle
from tests.protocol.modbus_support import ModbusDrive, drive_bench, enabled, torques
from tests.support.cutting import cut, release_cut

TURNS = (0, 1, 2, 3, 5, 8, 13, 21, 34, 55)  #: of the loop, from the beginning of a release to its cancellation
CANCELLATIONS = pytest.mark.parametrize("cancellations", [0, 1, 3], ids=["never", "once", "three times"])


# Modbus


@CANCELLATIONS
def test_wherever_an_arming_on_modbus_is_cut_its_registers_are_left_as_it_found_them(cancellations: int) -> None:
    async def body(link: ModbusLink, drives: list[ModbusDrive], peer: Registers) -> None:
        def standing() -> list[list[int]]:
            return [list(drive.registers) for drive in drives] + [list(peer.plc)]

        inputs = Inputs(2)
        await cycle(link, inputs)
        before, cuts = standing(), 0
        while await cut(link.prepare(), cuts + 1):
            cuts += 1
            await release_cut(link, TURNS[cuts % len(TURNS)], cancellations)
            assert standing() == before, f"cut at {cuts}"
            commands = [len(drive.power.commands) for drive in drives]
            link.write(torques(DriveRequest.ENABLE, 8.0, 8.0))
            await cycle(link, inputs)
            assert [len(drive.power.commands) for drive in drives] == commands, "a link that was released is silent"
            assert not link.health.malformed
        assert cuts > 20 and standing() != before
        await release_cut(link, 0, cancellations)
        assert standing() == before
        await enabled(link, inputs)

    drive_bench(body)


@pytest.mark.parametrize("turns", range(0, 60, 3))
def test_a_release_on_modbus_that_is_cut_takes_torque_off_and_ends_every_watchdog(turns: int) -> None:
    async def body(link: ModbusLink, drives: list[ModbusDrive], peer: Registers) -> None:
        inputs = Inputs(2)
        await enabled(link, inputs)
        fed = [len(drive.power.commands) for drive in drives]
        await release_cut(link, turns, 3)
        for drive, count in zip(drives, fed, strict=True):
            assert set(drive.power.commands[count:]) == {(0x00, 0)} and drive.power.torque == 0
            assert drive.registers[23] == 0, "its watchdog waits for nobody"
        await enabled(link, inputs)

    drive_bench(body)


def test_a_unit_that_is_silent_already_is_told_to_rest_all_the_same() -> None:
    async def body(link: ModbusLink, drives: list[ModbusDrive], peer: Registers) -> None:
        await enabled(link, Inputs(2))
        link.silence()
        fed = len(drives[0].power.commands)
        await link.release()
        assert drives[0].power.commands[fed:] == [(0x00, 0)] * 2, "at rest, and with the watchdog off"
        assert drives[0].registers[23] == 0
        await link.release()
        assert len(drives[0].power.commands) == fed + 2, "once"

    drive_bench(body)


def test_a_unit_that_was_lost_is_not_written_to_though_the_link_was_silent_first() -> None:
    async def body(link: ModbusLink, drives: list[ModbusDrive], peer: Registers) -> None:
        inputs = Inputs(2)
        await enabled(link, inputs)
        drives[0].silent = True
        while inputs.drive_state[0] != DriveState.ABSENT:
            link.write(torques(DriveRequest.ENABLE, 8.0, 8.0))
            await cycle(link, inputs, 0.05)
        drives[0].silent = False
        writes = len(drives[0].writes)
        link.silence()
        await link.release()
        assert len(drives[0].writes) == writes, "its watchdog fires"
        assert drives[1].registers[23] == 0 and drives[1].power.torque == 0

    drive_bench(body)


# OPC UA


@pytest.fixture(scope="module")
def shared_server() -> Iterator[DeviceServer]:
    with device_server() as server:
        yield server


@pytest.fixture
def server(shared_server: DeviceServer) -> DeviceServer:
    shared_server.reset()
    return shared_server


WATCHDOGS = ("Axis1.Watchdog", "Axis2.Watchdog", "Line.Watchdog")


@pytest.mark.wires
@CANCELLATIONS
def test_wherever_an_arming_on_opcua_is_cut_its_watchdogs_are_left_as_it_found_them(
    server: DeviceServer, cancellations: int
) -> None:
    devices = server.devices

    async def story() -> None:
        link = link_in_process(line(server.endpoint))
        await link.open()
        try:
            cuts = 0
            while await cut(link.prepare(), cuts + 1):
                cuts += 1
                await release_cut(link, TURNS[cuts % len(TURNS)], cancellations)
                assert [devices.value(watchdog) for watchdog in WATCHDOGS] == [0] * 3, f"cut at {cuts}"
                devices.writes.clear()
                rig = Rig(link)
                rig.outputs.drive_request[:] = DriveRequest.ENABLE
                await rig.cycle()
                await rig.cycle()
                assert devices.writes == [], "a link that was released is silent"
            assert cuts > 10 and 0 not in [devices.value(watchdog) for watchdog in WATCHDOGS]
            await release_cut(link, 0, cancellations)
            await Rig(link).enable()
        finally:
            await link.close()

    asyncio.run(story())


@pytest.mark.wires
@pytest.mark.parametrize("turns", range(0, 60, 3))
def test_a_release_on_opcua_that_is_cut_takes_torque_off_and_ends_supervision(server: DeviceServer, turns: int) -> None:
    devices = server.devices

    async def story() -> None:
        link = link_in_process(line(server.endpoint))
        await link.open()
        try:
            await Rig(link).enable()
            devices.writes.clear()
            await release_cut(link, turns, 3)
            assert [devices.value(f"Axis{k}.Statusword") for k in (1, 2)] == [0x0250] * 2
            assert devices.written("Axis1.Watchdog") == devices.written("Axis2.Watchdog") == [0, 100]
            await Rig(link).enable()
        finally:
            await link.close()

    asyncio.run(story())


@pytest.mark.wires
def test_drives_on_opcua_are_left_in_order_though_the_link_was_silent_first(server: DeviceServer) -> None:
    devices = server.devices

    async def story() -> None:
        link = link_in_process(line(server.endpoint))
        await link.open()
        try:
            rig = Rig(link)
            await rig.enable()
            link.silence()
            devices.writes.clear()
            await rig.cycle()
            assert devices.writes == []
            await link.release()
            assert devices.written("Axis1.Controlword") == [0, 0] and devices.written("Axis1.Watchdog") == [0, 100]
            devices.writes.clear()
            await link.release()
            assert devices.writes == [], "once"
        finally:
            await link.close()

    asyncio.run(story())
