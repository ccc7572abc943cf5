"""Faults on the wires of a whole simulated line: asked for by name, felt by a client."""

import asyncio
from collections.abc import Awaitable, Callable
from pathlib import Path

import can
import pytest
from pymodbus.client import AsyncModbusTcpClient
from pymodbus.exceptions import ModbusIOException

from sim_plant.faults.control import SOCKET_FILE, ask
from sim_plant.faults.parse import parse_fault
from sim_plant.plant import load_plant
from sim_plant.wired import Settings, WiredLine
from tests.support.ports import free_port

CHANNEL = "239.74.163.2"
PLANT = load_plant("sim_plant/plants/s_real.toml")
SYNC = can.Message(arbitration_id=0x80, is_extended_id=False)


class Rig:
    def __init__(self, folder: Path) -> None:
        self.port = free_port()
        control = folder / SOCKET_FILE
        self.line = WiredLine(PLANT, Settings(folder / "record", can_port=self.port, modbus_port=0, control=control))
        self.control = control

    async def __aenter__(self) -> "Rig":
        await self.line.open()
        self.bus = can.Bus(interface="udp_multicast", channel=CHANNEL, port=self.port, hop_limit=0, fd=False)
        self.stop = asyncio.Event()
        self.life = asyncio.create_task(self.line.run(self.stop))
        self.modbus = AsyncModbusTcpClient("127.0.0.1", port=self.line.modbus_port, retries=0, timeout=0.3)
        assert await self.modbus.connect()
        self.send(0x000, b"\1\0")
        return self

    async def __aexit__(self, *error: object) -> None:
        self.modbus.close()
        self.stop.set()
        await self.life
        await self.line.close()
        self.bus.shutdown()

    def send(self, can_id: int, data: bytes) -> None:
        self.bus.send(can.Message(arbitration_id=can_id, is_extended_id=False, data=data))

    async def heard(self, for_s: float = 0.05) -> set[int]:
        """The identifiers on the bus within that time, but for those sent here."""
        end_s = asyncio.get_running_loop().time() + for_s
        ids: set[int] = set()
        while asyncio.get_running_loop().time() < end_s:
            while message := self.bus.recv(timeout=0):
                ids.add(message.arbitration_id)
            await asyncio.sleep(0.001)
        return ids - {0x80}

    async def answers(self) -> set[int]:
        self.send(0x80, b"")
        return {can_id for can_id in await self.heard() if 0x180 < can_id < 0x200}

    async def inject(self, text: str) -> int:
        answer = await asyncio.to_thread(ask, self.control, {"do": "inject", "fault": text})
        assert answer["ok"], answer
        return answer["number"]

    async def clear(self) -> None:
        assert (await asyncio.to_thread(ask, self.control, {"do": "clear"}))["ok"]


@pytest.fixture
def run(tmp_path) -> Callable[[Callable[[Rig], Awaitable[None]]], None]:
    def runs(test: Callable[[Rig], Awaitable[None]]) -> None:
        async def whole() -> None:
            async with Rig(tmp_path) as rig:
                await test(rig)

        asyncio.run(whole())

    return runs


def test_a_drive_is_mute_for_its_node_alone(run):
    async def test(rig: Rig) -> None:
        everybody = {0x181 + k for k in range(PLANT.spans)}
        assert await rig.answers() == everybody
        await rig.inject("drive 3 mute")
        assert await rig.answers() == everybody - {0x183}
        await rig.clear()
        assert await rig.answers() == everybody

    run(test)


@pytest.mark.wires
def test_a_heartbeat_is_lost_and_a_restart_boots(run):
    async def test(rig: Rig) -> None:
        await rig.inject("drive 2 heartbeat-lost")
        await rig.heard(0.12)
        heard = await rig.heard(0.25)
        assert 0x701 in heard and 0x702 not in heard
        await rig.inject("drive 2 restart")
        assert 0x702 in await rig.heard(0.05)  # the boot-up message is no heartbeat
        assert 0x182 not in await rig.answers()  # pre-operational

    run(test)


def test_an_sdo_request_is_aborted_and_changes_nothing(run):
    async def test(rig: Rig) -> None:
        await rig.inject("drive 1 sdo-abort index=0x1017 count=1")
        await rig.heard(0.01)
        for expected in (b"\x80\x17\x10\0\x22\0\0\x08", b"\x60\x17\x10\0\0\0\0\0"):
            rig.send(0x601, b"\x2b\x17\x10\0\x32\0\0\0")
            answer = None
            while answer is None:
                message = rig.bus.recv(timeout=0)
                if message and message.arbitration_id == 0x581:
                    answer = bytes(message.data)
                await asyncio.sleep(0.001)
            assert answer == expected

    run(test)


def test_late_frames_come(run):
    async def test(rig: Rig) -> None:
        await rig.inject("drive 1 delay delay_s=0.1")
        assert 0x181 not in await rig.answers()
        assert 0x181 in await rig.heard(0.2)

    run(test)


def test_a_frozen_plc_shows_an_old_echo_and_a_mute_unit_nothing(run):
    async def test(rig: Rig) -> None:
        async def echo(life: int) -> int:
            answer = await rig.modbus.readwrite_registers(
                read_address=0, read_count=5, write_address=10, values=[0, 0, 0, life], device_id=2
            )
            return answer.registers[4]

        assert await echo(7) == 7
        await rig.inject("plc plc-freeze")
        assert await echo(8) == 7
        await rig.clear()
        assert await echo(9) == 9
        await rig.inject("plc freeze")
        assert [await echo(10), await echo(11)] == [10, 10]
        await rig.clear()
        await rig.inject("plc mute")
        with pytest.raises(ModbusIOException):
            await echo(12)
        assert (await rig.modbus.read_input_registers(0, count=1, device_id=1)).registers == [0x5201]

    run(test)


def test_a_disconnected_wire_comes_back(run):
    async def test(rig: Rig) -> None:
        await rig.inject("modbus-tcp disconnect")
        await asyncio.sleep(0.02)
        assert not rig.modbus.connected
        reader, writer = await asyncio.open_connection("127.0.0.1", rig.line.modbus_port)
        assert await reader.read() == b""
        writer.close()
        await rig.clear()
        assert await rig.modbus.connect()
        assert (await rig.modbus.read_input_registers(0, count=1, device_id=1)).registers == [0x5201]

    run(test)


@pytest.mark.wires
def test_faults_from_the_start_come_at_their_time_and_are_recorded(tmp_path):
    from sim_plant.recorder import read_recording

    async def whole() -> None:
        faults = (parse_fault("load-cell 3 nan at 0.02 for 0.05"),)
        line = WiredLine(PLANT, Settings(tmp_path / "r", can_port=free_port(), modbus_port=0, faults=faults))
        await line.open()
        stop = asyncio.Event()
        asyncio.get_running_loop().call_later(0.2, stop.set)
        await line.run(stop)
        await line.close()

    asyncio.run(whole())
    recording = read_recording(tmp_path / "r")
    noted = [(e["kind"], round(e["time_s"], 6)) for e in recording.events if e["kind"].startswith("fault-")]
    assert noted == [("fault-injected", 0.02), ("fault-cleared", 0.07)]
