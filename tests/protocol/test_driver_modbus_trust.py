"""When a Modbus drive must not be given torque any more: lost while arming, deaf, changed by others, another device."""

import asyncio
import struct

import pytest

from drivers.modbus.client import ModbusConnection, ModbusFailed, ModbusTimeout
from drivers.modbus.link import ModbusLink
from drivers.port import PrepareRefused
from gateway.core.finding import finding
from gateway.core.signals import DriveRequest, DriveState, Inputs, Outputs, Quality
from tests.protocol.driver_support import Registers, cycle, frame, until
from tests.protocol.modbus_support import ModbusDrive, bench, command, drive_bench, enabled, interrupt, torques

ENABLE, OFF = DriveRequest.ENABLE, DriveRequest.OFF


async def cycles(link: ModbusLink, inputs: Inputs, count: int, outputs: Outputs) -> None:
    for _ in range(count):
        link.write(outputs)
        await cycle(link, inputs)


@pytest.mark.parametrize("function", [3, 16], ids=["while the others are checked", "while the others are configured"])
def test_a_drive_whose_connection_was_lost_while_arming_is_not_armed(function: int) -> None:
    async def body(link: ModbusLink, drives: list[ModbusDrive], peer: Registers) -> None:
        inputs = Inputs(2)
        await cycle(link, inputs)
        play, restarted = peer.script, asyncio.Event()
        assert play is not None

        async def cuts(head: bytes, unit: int, pdu: bytes) -> list[bytes] | None:
            proof = pdu[0] == function and pdu[1:3] in (b"\0\0", b"\0\x17")  # device id; watchdog
            if unit == 12 and proof and not restarted.is_set():
                restarted.set()  # drive-1, which is proven already, goes off and on
                drives[0].registers[23] = 0
                await until(lambda: link.health.reconnects > 0)
            if unit == 11 and restarted.is_set() and not link.health.reconnects:
                raise ConnectionResetError
            return await play(head, unit, pdu)

        peer.script = cuts
        arming = asyncio.create_task(link.prepare())
        while not arming.done():
            await cycle(link, inputs, 0.02)
            await asyncio.sleep(0)
        with pytest.raises(PrepareRefused) as refused:
            await arming
        assert refused.value.reasons == [finding("connection-lost-meanwhile", device="drive-1")]
        await cycles(link, inputs, 3, torques(ENABLE, 8.0, 8.0))
        assert not drives[0].power.commands and not drives[1].power.commands
        assert drives[1].registers[23] == 0, "nobody waits for a command"
        await enabled(link, inputs)

    drive_bench(body)


def test_an_identity_read_on_an_earlier_connection_confirms_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    read, lost = ModbusConnection.read, list[int]()

    async def loses(
        self: ModbusConnection, function: int, unit: int, address: int, count: int, deadline_s: float
    ) -> list[int]:
        registers = await read(self, function, unit, address, count, deadline_s)
        if (unit, address, count) == (11, 1, 1) and not lost:  # the statusword: the last proof
            lost.append(unit)
            await self.connect()
        return registers

    async def body(link: ModbusLink, drives: list[ModbusDrive], peer: Registers) -> None:
        monkeypatch.setattr(ModbusConnection, "read", loses)
        with pytest.raises(PrepareRefused, match="connection-lost-meanwhile"):
            await link.prepare()
        assert lost
        peer.requests.clear()
        await cycle(link, Inputs(2))
        assert (11, struct.pack(">BHH", 3, 0, 1)) in peer.requests, "it is asked again who it is"

    drive_bench(body)


def test_a_drive_that_ignores_orders_to_take_torque_off_is_fed_no_longer() -> None:
    async def body(link: ModbusLink, drives: list[ModbusDrive], peer: Registers) -> None:
        inputs = Inputs(2)
        await enabled(link, inputs)
        drives[0].power.obeys = False
        fed = len(drives[0].power.commands)
        await cycles(link, inputs, 20, torques(OFF, 0.0, 0.0))
        assert drives[0].power.commands[fed:] == [(0x00, 0)] * 6, "its watchdog has the last word"
        assert "drive-1: ignored 5 orders" in link.health.last_error
        assert list(inputs.drive_state) == [DriveState.ENABLED, DriveState.OFF], "what gives torque is shown to"
        assert len(drives[1].power.commands) == len(drives[0].power.commands) + 14
        drives[0].power.obeys = True
        await cycles(link, inputs, 3, torques(OFF, 0.0, 0.0))
        assert len(drives[0].power.commands) == fed + 6, "not before it is armed again"

    drive_bench(body)


def test_a_drive_whose_watchdog_is_changed_while_it_runs_loses_torque() -> None:
    async def body(link: ModbusLink, drives: list[ModbusDrive], peer: Registers) -> None:
        inputs = Inputs(2)
        await enabled(link, inputs)
        drives[0].registers[23] = 0
        fed = len(drives[0].power.commands)
        await cycles(link, inputs, 12, torques(ENABLE, 8.0, 8.0))
        # The first is that with whose answer it was seen. Without a watchdog silence would keep its torque on.
        assert drives[0].power.commands[fed:] == [(0x0F, 100)] + [(0x00, 0)] * 5
        assert list(inputs.drive_state) == [DriveState.FAULT, DriveState.ENABLED]
        assert "drive-1: watchdog reads 0, 100 was set" in link.health.last_error
        drives[0].registers[23] = 100
        await cycles(link, inputs, 3, torques(ENABLE, 8.0, 8.0))
        assert len(drives[0].power.commands) == fed + 6, "it does not come back by itself"

    drive_bench(body)


def test_a_plc_whose_watchdog_is_changed_while_it_runs_is_told_to_rest() -> None:
    async def body(link: ModbusLink, peer: Registers) -> None:
        inputs = Inputs(2)
        await link.prepare()
        await cycles(link, inputs, 3, command(True, 0.1))
        assert inputs.plc.quality == Quality.GOOD and peer.plc[10] == 1
        peer.plc[14] = 0
        await cycles(link, inputs, 2, command(True, 0.1))
        assert peer.plc[10:13] == [0, 0, 0] and inputs.plc.quality == Quality.STALE
        assert "plc: watchdog reads 0" in link.health.last_error

    bench(body)


def test_one_damaged_answer_stops_nothing() -> None:
    async def body(link: ModbusLink, drives: list[ModbusDrive], peer: Registers) -> None:
        inputs = Inputs(2)
        await enabled(link, inputs)
        play, damaged = peer.script, list[int]()
        assert play is not None

        async def damages(head: bytes, unit: int, pdu: bytes) -> list[bytes] | None:
            answer = await play(head, unit, pdu)
            if unit == 11 and pdu[0] == 23 and not damaged and answer is not None:
                damaged.append(unit)
                return [answer[0][:-2] + b"\x01\x64"]
            return answer

        peer.script = damages
        fed = len(drives[0].power.commands)
        await cycles(link, inputs, 3, torques(ENABLE, 8.0, 8.0))
        assert damaged and drives[0].power.commands[fed:] == [(0x0F, 100)] * 3, "proven again before the next command"
        assert (inputs.drive_state == DriveState.ENABLED).all()

    drive_bench(body)


def test_a_command_that_the_proofs_have_made_old_is_not_written() -> None:
    async def body(link: ModbusLink, drives: list[ModbusDrive], peer: Registers) -> None:
        inputs = Inputs(2)
        await enabled(link, inputs)
        await interrupt(link, peer, inputs, lambda: None)
        play = peer.script
        assert play is not None

        async def wakes_up(head: bytes, unit: int, pdu: bytes) -> list[bytes] | None:
            if unit == 11 and pdu == struct.pack(">BHH", 3, 0, 1):
                await asyncio.sleep(0.12)  # longer than a period
            return await play(head, unit, pdu)

        peer.script = wakes_up
        await cycles(link, inputs, 1, torques(ENABLE, 16.0, 16.0))
        assert (0x0F, 200) not in drives[0].power.commands
        assert (0x0F, 200) in drives[1].power.commands

    drive_bench(body)


# settings


@pytest.mark.parametrize(("found", "restored"), [(700, 700), (0, 0), (100, 0)])
def test_what_was_found_is_restored_and_what_a_gateway_left_behind_is_taken_off(found: int, restored: int) -> None:
    async def body(link: ModbusLink, drives: list[ModbusDrive], peer: Registers) -> None:
        drives[0].registers[23] = found
        await enabled(link, Inputs(2))
        await link.release()
        assert drives[0].registers[23] == restored

    drive_bench(body)


def test_a_setting_is_restored_when_arming_was_cancelled_while_it_was_written() -> None:
    async def body(link: ModbusLink, drives: list[ModbusDrive], peer: Registers) -> None:
        drives[0].registers[23] = 700
        play, written = peer.script, asyncio.Event()
        assert play is not None

        async def takes_and_says_nothing(head: bytes, unit: int, pdu: bytes) -> list[bytes] | None:
            answer = await play(head, unit, pdu)
            if pdu[0] != 16:
                return answer
            written.set()
            return []

        peer.script = takes_and_says_nothing
        arming = asyncio.create_task(link.prepare())
        await written.wait()
        arming.cancel()
        await asyncio.gather(arming, return_exceptions=True)
        assert drives[0].registers[23] == 100
        peer.script = play
        await link.release()
        assert drives[0].registers[23] == 700

    drive_bench(body)


@pytest.mark.parametrize("commanded", [True, False])
def test_another_device_in_the_place_of_a_drive_is_left_alone_by_release(commanded: bool) -> None:
    async def body(link: ModbusLink, drives: list[ModbusDrive], peer: Registers) -> None:
        inputs = Inputs(2)
        await (enabled(link, inputs) if commanded else link.prepare())
        await cycle(link, inputs)
        await interrupt(link, peer, inputs, lambda: drives[0].registers.__setitem__(0, 0x7777))
        await cycle(link, inputs)
        before = len(drives[0].writes)
        await link.release()
        assert len(drives[0].writes) == before
        assert "drive-1" in link.health.last_error and "its identity is not proven" in link.health.last_error
        assert drives[1].registers[23] == 0

    drive_bench(body)


def test_a_failure_says_which_exception_it_was() -> None:
    async def run() -> None:
        async with Registers() as peer:
            connection = ModbusConnection("127.0.0.1", peer.port)
            assert await connection.connect()
            deadline_s = asyncio.get_running_loop().time() + 5.0
            with pytest.raises(ModbusFailed) as refused:
                await connection.read(3, 2, 4000, 1, deadline_s)
            assert refused.value.exception_code == 2 and "exception 2" in str(refused.value)

            async def other(head: bytes, unit: int, pdu: bytes) -> list[bytes]:
                return [frame(head, unit, struct.pack(">BBHH", 3, 4, 1, 1))]

            peer.script = other
            with pytest.raises(ModbusFailed) as strange:
                await connection.read(3, 2, 1, 1, deadline_s)
            assert strange.value.exception_code is None
            connection.close()
            with pytest.raises(ModbusTimeout) as lost:
                await connection.read(3, 2, 1, 1, deadline_s)
            assert lost.value.exception_code is None

    asyncio.run(run())
