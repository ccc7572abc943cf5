"""Drives and racks of the simulated line over Modbus TCP: pymodbus's client and bare sockets as peers."""

import asyncio
import math
import struct
from collections.abc import AsyncIterator, Awaitable, Callable, Coroutine
from contextlib import asynccontextmanager
from pathlib import Path
from typing import Any

import pytest
from pymodbus.client import AsyncModbusTcpClient

from sim_plant.devices.amplifier import Amplifier, ChannelStatus
from sim_plant.devices.drive import Drive
from sim_plant.devices.line_plc import LinePlc
from sim_plant.faces.kernel_stamp import Stamp
from sim_plant.faces.modbus import ModbusFace
from sim_plant.faces.modbus_drive import DriveRegisters, ModbusAxis
from sim_plant.faces.modbus_rack import RackRegisters
from sim_plant.faces.modbus_units import AmplifierRegisters, PlcRegisters
from sim_plant.plant import load_plant
from sim_plant.recorder import Recorder
from sim_plant.world import World

PLANT = load_plant(Path(__file__).parents[2] / "sim_plant/plants/s_real.toml")
RATED_NM = PLANT.drives.rated_torque_nm
AMPLIFIER, PLC, RACK, DRIVE, SECOND_DRIVE = 1, 2, 3, 11, 12
SHUTDOWN, SWITCH_ON, ENABLE, QUICK_STOP, RESET = 0x06, 0x07, 0x0F, 0x02, 0x80
SWITCH_ON_DISABLED, READY, SWITCHED_ON, OPERATION_ENABLED, FAULT = 0x40, 0x21, 0x23, 0x27, 0x08
WATCHDOG_ERROR = 0x8250


class Bench:
    """Rollers 1 and 2 on units of their own, rollers 3 and 4 with spans 3 and 4 and the PLC in the rack."""

    def __init__(self) -> None:
        self.now_s = 0.0
        self.world = World(PLANT, 7)
        self.recorder = Recorder(self.world)
        self.drives = [Drive(k, self.world, self.recorder, RATED_NM, PLANT.drives.max_torque_nm) for k in range(4)]
        self.amplifier = Amplifier(self.world)
        self.plc = LinePlc(self.world, self.recorder)
        axes = [ModbusAxis(drive) for drive in self.drives]
        self.rack = RackRegisters(6, {3: axes[2], 4: axes[3]}, self.amplifier, {3, 4}, self.plc)
        units = {
            AMPLIFIER: AmplifierRegisters(self.amplifier, {1, 2}),
            PLC: PlcRegisters(self.plc),
            RACK: self.rack,
            DRIVE: DriveRegisters(axes[0]),
            SECOND_DRIVE: DriveRegisters(axes[1]),
        }
        self.face = ModbusFace(units, lambda: self.now_s)
        self.port = 0
        self.client: AsyncModbusTcpClient

    async def read(self, address: int, count: int, unit: int) -> list[int]:
        answer = await self.client.read_holding_registers(address, count=count, device_id=unit)
        assert not answer.isError(), answer
        return answer.registers

    async def write(self, address: int, *values: int, unit: int) -> int:
        """The exception code, 0 without."""
        answer = await self.client.write_registers(address, list(values), device_id=unit)
        return answer.exception_code if answer.isError() else 0

    async def write_one(self, address: int, value: int, unit: int) -> int:
        answer = await self.client.write_register(address, value, device_id=unit)
        return answer.exception_code if answer.isError() else 0

    async def cycle(self, write: int, values: list[int], count: int, unit: int) -> list[int]:
        """Function 23: write, then read from register 0 on."""
        answer = await self.client.readwrite_registers(
            read_address=0, read_count=count, write_address=write, values=values, device_id=unit
        )
        assert not answer.isError(), answer
        return answer.registers

    async def state(self, unit: int = DRIVE) -> int:
        [word] = await self.read(1, 1, unit)
        return word & 0x6F if word & 0x4F != SWITCH_ON_DISABLED else SWITCH_ON_DISABLED

    async def enable(self, unit: int = DRIVE) -> None:
        for controlword in (SHUTDOWN, SWITCH_ON, ENABLE):
            assert await self.write(10, controlword, 0, unit=unit) == 0
        assert await self.state(unit) == OPERATION_ENABLED

    def wait(self, seconds: float) -> None:
        self.now_s = round(self.now_s + seconds, 6)
        self.world.advance(self.now_s)


Story = Callable[[Bench], Awaitable[None]]


def on_bench(test: Story) -> None:
    async def run() -> None:
        bench = Bench()
        bench.port = await bench.face.open("127.0.0.1", 0)
        try:
            async with _connected(bench.port) as bench.client, asyncio.timeout(20):
                await test(bench)
        finally:
            await bench.face.close()

    asyncio.run(run())


@asynccontextmanager
async def _connected(port: int) -> AsyncIterator[AsyncModbusTcpClient]:
    client = AsyncModbusTcpClient("127.0.0.1", port=port, retries=0, timeout=2)
    assert await client.connect()
    try:
        yield client
    finally:
        client.close()


def signed(word: int) -> int:
    return struct.unpack(">h", struct.pack(">H", word))[0]


def long(high: int, low: int) -> int:
    return struct.unpack(">i", struct.pack(">HH", high, low))[0]


def float32(high: int, low: int) -> float:
    return struct.unpack(">f", struct.pack(">HH", high, low))[0]


# A drive


def test_a_drive_says_who_it_is_and_is_remote() -> None:
    async def test(bench: Bench) -> None:
        registers = await bench.read(0, 24, DRIVE)
        assert registers[0] == 0x5203
        assert registers[1] & 0x4F == SWITCH_ON_DISABLED and registers[1] & 1 << 9
        assert registers[7:10] == [0] * 3 and registers[12:20] == [0x5253, 1] + [0] * 6
        assert long(*registers[20:22]) == round(1000 * RATED_NM)
        assert registers[22:] == [round(1000 * PLANT.drives.max_torque_nm / RATED_NM), 0]

    on_bench(test)


def test_a_write_acts_at_once_and_before_the_read_of_its_transaction() -> None:
    async def test(bench: Bench) -> None:
        bench.world.start_at_equilibrium(bench.world.tension_n + 20.0, 0.1)
        for controlword in (SHUTDOWN, SWITCH_ON):
            await bench.write(10, controlword, 0, unit=DRIVE)
        shown = await bench.cycle(10, [ENABLE, 0x10000 - 250], 7, DRIVE)
        assert shown[1] & 0x6F == OPERATION_ENABLED and shown[1] & 1 << 12
        assert signed(shown[4]) == -250 and shown[5:] == [0, 0]
        assert long(*shown[2:4]) == pytest.approx(bench.world.speed_m_per_s[0] * 1e6, abs=600)
        assert bench.world.torque_nm[0] == pytest.approx(-0.25 * RATED_NM)
        last = bench.recorder.recording().of_kind("torque")[-1]
        assert (last["roller"], last["torque_nm"]) == (1, pytest.approx(-0.25 * RATED_NM))
        assert await bench.read(10, 2, DRIVE) == [ENABLE, 0x10000 - 250]
        assert await bench.state(SECOND_DRIVE) == SWITCH_ON_DISABLED

    on_bench(test)


def test_reading_is_nothing_to_the_recorder_so_that_it_shortens_no_interval() -> None:
    """A ramp at the recorder's rate, 10 Nm in 10 ms, with a read just before each write."""

    async def test(bench: Bench) -> None:
        await bench.enable()
        for k in range(1, 6):
            bench.wait(0.0095)
            await bench.read(0, 7, DRIVE)
            bench.wait(0.0005)
            await bench.write(10, ENABLE, round(k * 10.0 / RATED_NM * 1000), unit=DRIVE)
        assert bench.recorder.unsafe_total == 0
        bench.wait(0.005)
        await bench.write(10, ENABLE, 1000, unit=DRIVE)
        assert bench.recorder.unsafe_events["torque-rate"] == 1, "and half the time is found"

    on_bench(test)


def test_one_step_of_the_state_machine_for_each_write() -> None:
    async def test(bench: Bench) -> None:
        states = []
        for controlword in (0, SHUTDOWN, SWITCH_ON, ENABLE, SWITCH_ON, SHUTDOWN, ENABLE, QUICK_STOP):
            await bench.write(10, controlword, 100, unit=DRIVE)
            states.append(await bench.state())
        enabled, stopping = OPERATION_ENABLED, 0x07
        assert states == [SWITCH_ON_DISABLED, READY, SWITCHED_ON, enabled, SWITCHED_ON, READY, enabled, stopping]

    on_bench(test)


def test_the_watchdog_runs_from_the_first_write_and_reading_does_not_renew_it() -> None:
    async def test(bench: Bench) -> None:
        assert await bench.write_one(23, 100, DRIVE) == 0
        bench.wait(0.3)  # not supervised before the first write
        await bench.enable()
        bench.wait(0.02)
        await bench.write(10, ENABLE, 300, unit=DRIVE)
        commanded_s = bench.now_s
        bench.wait(0.06)
        await bench.read(0, 7, DRIVE)
        bench.wait(0.039)
        assert bench.world.torque_nm[0] == pytest.approx(0.3 * RATED_NM)
        bench.wait(0.002)
        assert bench.world.torque_nm[0] == 0.0
        shown = await bench.read(0, 7, DRIVE)
        assert shown[1] & 0x4F == FAULT and shown[6] == WATCHDOG_ERROR
        [trip] = bench.recorder.recording().of_kind("watchdog")
        assert trip["time_s"] == pytest.approx(commanded_s + 0.1)
        assert bench.recorder.unsafe_total == 0

    on_bench(test)


def test_a_fault_reset_enables_nothing_and_ends_the_supervision_until_the_next_write() -> None:
    async def test(bench: Bench) -> None:
        await bench.write_one(23, 50, DRIVE)
        await bench.enable()
        bench.wait(0.06)
        await bench.write(10, ENABLE, 100, unit=DRIVE)
        assert await bench.state() == FAULT
        await bench.write(10, RESET | ENABLE, 100, unit=DRIVE)
        assert await bench.state() == SWITCH_ON_DISABLED and (await bench.read(6, 1, DRIVE)) == [0]
        bench.wait(1.0)
        assert await bench.state() == SWITCH_ON_DISABLED
        await bench.write(10, SHUTDOWN, 0, unit=DRIVE)
        bench.wait(0.06)
        assert await bench.state() == FAULT and (await bench.read(6, 1, DRIVE)) == [WATCHDOG_ERROR]

    on_bench(test)


def test_safe_torque_off_is_shown_and_refuses_to_enable() -> None:
    async def test(bench: Bench) -> None:
        await bench.enable()
        bench.drives[0].set_sto(True, bench.now_s)
        for controlword in (SHUTDOWN, ENABLE):
            await bench.write(10, controlword, 100, unit=DRIVE)
        shown = await bench.read(0, 7, DRIVE)
        assert shown[1] & 0x4F == SWITCH_ON_DISABLED and not shown[1] & 1 << 4 and shown[5] == 1
        bench.drives[0].set_sto(False, bench.now_s)
        assert (await bench.read(5, 1, DRIVE)) == [0]

    on_bench(test)


def test_what_a_drive_refuses_changes_nothing() -> None:
    async def test(bench: Bench) -> None:
        await bench.enable()
        refusals = [
            (bench.write(10, ENABLE, unit=DRIVE), 3),  # half a command
            (bench.write_one(11, 500, DRIVE), 3),
            (bench.write(9, 0, ENABLE, 500, unit=DRIVE), 2),
            (bench.write(10, ENABLE, 500, 0, unit=DRIVE), 2),
            (bench.write(22, 0, 100, unit=DRIVE), 2),
            (bench.write_one(24, 1, DRIVE), 2),
            (bench.write_one(23, 9, DRIVE), 3),
            (bench.write_one(23, 1001, DRIVE), 3),
        ]
        for request, code in refusals:
            assert await request == code
        for unasked, code in ((bench.client.read_input_registers, 1), (bench.client.read_holding_registers, 2)):
            answer = await unasked(23, count=2, device_id=DRIVE)
            assert answer.exception_code == code
        assert await bench.read(10, 2, DRIVE) == [ENABLE, 0] and await bench.read(23, 1, DRIVE) == [0]
        assert bench.world.torque_nm[0] == 0.0 and await bench.state() == OPERATION_ENABLED
        for allowed in (10, 1000, 0):
            assert await bench.write_one(23, allowed, DRIVE) == 0

    on_bench(test)


# Requests on one connection


def _frame(transaction: int, unit: int, pdu: bytes) -> bytes:
    return struct.pack(">HHHB", transaction, 0, len(pdu) + 1, unit) + pdu


def _cycle(transaction: int, controlword: int, torque: int) -> bytes:
    return _frame(transaction, DRIVE, struct.pack(">BHHHHBHH", 23, 0, 5, 10, 2, 4, controlword, torque))


STEPS = [(SHUTDOWN, 0), (SWITCH_ON, 0), (ENABLE, 100), (ENABLE, 200), (SWITCH_ON, 0)]
ORDER = [(READY, 0), (SWITCHED_ON, 0), (OPERATION_ENABLED, 100), (OPERATION_ENABLED, 200), (SWITCHED_ON, 0)]


@pytest.mark.parametrize("piece", [1, 5, 19, 33, 1000])
def test_pipelined_cycles_act_and_are_answered_one_by_one_in_order(piece: int) -> None:
    """However they are cut: byte by byte, across requests, all in one segment."""

    async def test(bench: Bench) -> None:
        stream = b"".join(_cycle(k, *step) for k, step in enumerate(STEPS))
        reader, writer = await asyncio.open_connection("127.0.0.1", bench.port)
        for at in range(0, len(stream), piece):
            writer.write(stream[at : at + piece])
            await writer.drain()
            await asyncio.sleep(0)
        for k, (state, torque) in enumerate(ORDER):
            transaction, _, length, unit, function, size = struct.unpack(">HHHBBB", await reader.readexactly(9))
            assert (transaction, length, unit, function, size) == (k, 13, DRIVE, 23, 10)
            _, statusword, _, shown = struct.unpack(">HHih", await reader.readexactly(10))
            assert (statusword & 0x6F, shown) == (state, torque)
        writer.close()
        await writer.wait_closed()
        targets = [event["target_torque_nm"] for event in bench.recorder.recording().of_kind("command")]
        assert targets == [pytest.approx(torque * 1e-3 * RATED_NM) for _, torque in STEPS]

    on_bench(test)


def test_a_request_acts_when_the_kernel_took_it() -> None:
    """The process is late: it looks at the socket only after the request has lain there."""

    async def run() -> None:
        stamps: list[float] = []
        world = World(PLANT, 7)
        drive = Drive(0, world, Recorder(world), RATED_NM, RATED_NM)

        def arrival(stamp: Stamp) -> float:
            stamps.append(stamp.timestamp)
            return 0.5

        face = ModbusFace({DRIVE: DriveRegisters(ModbusAxis(drive))}, lambda: 0.25, arrival)
        port = await face.open("127.0.0.1", 0)
        reader, writer = await asyncio.open_connection("127.0.0.1", port)
        try:
            # The kernel begins to stamp a little after it was asked to, unless another socket had asked before.
            for _ in range(1000):
                writer.write(_cycle(0, SHUTDOWN, 0) + _cycle(0, SWITCH_ON, 0))
                await reader.readexactly(2 * 19)
                if stamps:
                    break
            seen = len(stamps)
            writer.write(_cycle(0, SHUTDOWN, 0) + _cycle(0, SWITCH_ON, 0))
            await reader.readexactly(2 * 19)
            assert seen == 1 and len(stamps) == 2 and stamps[0] < stamps[1], "one for what came together"
            assert world.now_s == 0.5
        finally:
            writer.close()
            await writer.wait_closed()
            await face.close()

    asyncio.run(run())


# The rack

RACK_AXIS_3, RACK_AXIS_4 = 208, 210
INPUTS = 128


def test_a_rack_shows_what_is_in_it_and_what_is_not() -> None:
    async def test(bench: Bench) -> None:
        bench.world.start_at_equilibrium(bench.world.tension_n + [20, 22, 24, 26, 28, 30], 0.1)
        bench.now_s = 0.25
        bench.amplifier.set_status(4, ChannelStatus.OVERLOAD)
        registers = await bench.read(0, 125, RACK) + await bench.read(125, 3, RACK)
        assert registers[:3] == [0x5204, 6, 0b0011]
        assert long(*registers[3:5]) == pytest.approx(100_000, abs=600)
        assert registers[5:8] == [0, 250, 1]
        spans = [registers[8 + 8 * k :][:8] for k in range(6)]
        for number in (3, 4):
            span = spans[number - 1]
            assert span[0] & 0x4F == SWITCH_ON_DISABLED and span[0] & 1 << 9
            assert long(*span[1:3]) == pytest.approx(bench.world.speed_m_per_s[number - 1] * 1e6, abs=600)
            assert signed(span[3]) == pytest.approx(bench.world.torque_nm[number - 1] / RATED_NM * 1e3, abs=0.5)
            assert float32(*span[5:7]) == pytest.approx(bench.amplifier.tension_n(number, 0.25), rel=1e-6)
        assert [spans[2][7], spans[3][7]] == [0, 1]
        for number in (1, 2, 5, 6):
            span = spans[number - 1]
            assert span[:5] == [0] * 5 and math.isnan(float32(*span[5:7])) and span[7] == 2
        assert registers[8 + 8 * 6 :] == [0] * (120 - 56) + [0x5256] + [0] * (INPUTS - 121)
        assert await bench.read(200, 32, RACK) == [0] * 32
        settings = await bench.read(300, 5, RACK)
        assert settings == [0, 0, *divmod(round(1000 * RATED_NM), 0x10000), 1000]

    on_bench(test)


def test_one_transaction_is_a_whole_cycle_of_a_rack() -> None:
    async def test(bench: Bench) -> None:
        for controlword in (SHUTDOWN, SWITCH_ON):
            assert await bench.write(RACK_AXIS_3, controlword, 0, controlword, 0, unit=RACK) == 0
        shown = await bench.cycle(RACK_AXIS_3, [ENABLE, 100, ENABLE, 0x10000 - 100], 40, RACK)
        for number, torque in ((3, 100), (4, -100)):
            span = shown[8 + 8 * (number - 1) :]
            assert span[0] & 0x6F == OPERATION_ENABLED and signed(span[3]) == torque
        shown = await bench.cycle(200, [1, *divmod(100_000, 0x10000), 17], 6, RACK)
        assert shown[2] == 0b0111 and shown[5] == 17
        assert long(*shown[3:5]) == pytest.approx(100_000, abs=600)
        assert bench.world.unwind_speed_m_per_s == 0.1
        torques = {event["roller"]: event["torque_nm"] for event in bench.recorder.recording().of_kind("torque")}
        assert torques == {3: pytest.approx(0.1 * RATED_NM), 4: pytest.approx(-0.1 * RATED_NM)}

    on_bench(test)


def test_each_axis_of_a_rack_is_watched_by_its_own_pair() -> None:
    async def test(bench: Bench) -> None:
        assert await bench.write_one(301, 50, RACK) == 0
        for controlword in (SHUTDOWN, SWITCH_ON, ENABLE):
            await bench.write(RACK_AXIS_3, controlword, 0, controlword, 0, unit=RACK)
        bench.wait(0.04)
        await bench.write(RACK_AXIS_4, ENABLE, 0, unit=RACK)
        bench.wait(0.02)
        shown = await bench.read(8, 32, RACK)
        assert shown[16] & 0x4F == FAULT and shown[24] & 0x6F == OPERATION_ENABLED

    on_bench(test)


def test_the_line_watchdog_of_a_rack() -> None:
    async def test(bench: Bench) -> None:
        assert await bench.write_one(300, 100, RACK) == 0
        await bench.write(200, 1, *divmod(100_000, 0x10000), 1, unit=RACK)
        for _ in range(3):
            bench.wait(0.04)
            await bench.write(200, 1, *divmod(100_000, 0x10000), 1, unit=RACK)
        assert await bench.read(2, 1, RACK) == [0b1011]
        assert bench.world.unwind_speed_m_per_s == 0.0

    on_bench(test)


def test_what_a_rack_refuses_changes_nothing() -> None:
    async def test(bench: Bench) -> None:
        half = [1, 0]  # run, and the high word of a speed
        refusals: list[tuple[Coroutine[Any, Any, int], int]] = [
            (bench.write(200, *half, unit=RACK), 3),
            (bench.write(202, 0, 0, unit=RACK), 3),
            (bench.write_one(200, 4, RACK), 3),
            (bench.write_one(RACK_AXIS_3, ENABLE, RACK), 3),
            (bench.write(RACK_AXIS_3, SHUTDOWN, 0, SHUTDOWN, unit=RACK), 3),
            (bench.write(RACK_AXIS_3 + 1, 0, SHUTDOWN, 0, unit=RACK), 3),
            (bench.write(204, SHUTDOWN, 0, unit=RACK), 2),  # axis 1 is not in this rack
            (bench.write(200, 1, 0, 0, 1, SHUTDOWN, 0, unit=RACK), 2),
            (bench.write(RACK_AXIS_4, SHUTDOWN, 0, SHUTDOWN, 0, unit=RACK), 2),  # nor is axis 5
            (bench.write_one(0, 1, RACK), 2),
            (bench.write_one(232, 1, RACK), 2),
            (bench.write(301, 100, 0, unit=RACK), 2),  # 302 is read only
            (bench.write_one(300, 9, RACK), 3),
            (bench.write(300, 100, 1001, unit=RACK), 3),
        ]
        for request, code in refusals:
            assert await request == code
        for address, count in ((127, 2), (128, 1), (199, 1), (231, 2), (299, 1), (304, 2), (305, 1)):
            answer = await bench.client.read_holding_registers(address, count=count, device_id=RACK)
            assert answer.exception_code == 2, address
        assert await bench.read(200, 32, RACK) == [0] * 32 and await bench.read(300, 2, RACK) == [0, 0]
        assert not bench.recorder.recording().of_kind("command")
        assert bench.plc.watchdog_s == 0.0

    on_bench(test)


def test_an_amplifier_shows_a_broken_wire_where_the_load_cell_is_elsewhere() -> None:
    async def test(bench: Bench) -> None:
        registers = (await bench.client.read_input_registers(16, count=24, device_id=AMPLIFIER)).registers
        assert registers[2::4] == [0, 0, 2, 2, 2, 2]
        assert [math.isnan(float32(*registers[k : k + 2])) for k in range(0, 24, 4)] == [False] * 2 + [True] * 4

    on_bench(test)
