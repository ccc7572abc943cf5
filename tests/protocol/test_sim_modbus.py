"""The Modbus face of the simulated line over TCP: pymodbus's client and bare sockets as peers."""

import asyncio
import math
import struct
from collections.abc import AsyncIterator, Awaitable, Callable
from contextlib import asynccontextmanager
from pathlib import Path

import pytest
from pymodbus.client import AsyncModbusTcpClient

from sim_plant.devices.amplifier import Amplifier, ChannelStatus
from sim_plant.devices.line_plc import LinePlc
from sim_plant.faces.modbus import MAX_CONNECTIONS, ModbusFace
from sim_plant.faces.modbus_units import AmplifierRegisters, PlcRegisters
from sim_plant.plant import load_plant
from sim_plant.recorder import Recorder
from sim_plant.world import World

PLANT = load_plant(Path(__file__).parents[2] / "sim_plant/plants/s_real.toml")
AMPLIFIER, PLC = 1, 2


class Bench:
    """Amplifier and PLC on a port of their own, in time that the test steps."""

    def __init__(self) -> None:
        self.now_s = 0.0
        self.world = World(PLANT, 7)
        self.recorder = Recorder(self.world)
        self.amplifier = Amplifier(self.world)
        self.plc = LinePlc(self.world, self.recorder)
        units = {AMPLIFIER: AmplifierRegisters(self.amplifier), PLC: PlcRegisters(self.plc)}
        self.face = ModbusFace(units, lambda: self.now_s)
        self.port = 0

    @asynccontextmanager
    async def client(self) -> AsyncIterator[AsyncModbusTcpClient]:
        client = AsyncModbusTcpClient("127.0.0.1", port=self.port, retries=0, timeout=2)
        assert await client.connect()
        try:
            yield client
        finally:
            client.close()

    async def stream(self) -> tuple[asyncio.StreamReader, asyncio.StreamWriter]:
        return await asyncio.open_connection("127.0.0.1", self.port)


def on_bench(test: Callable[[Bench], Awaitable[None]]) -> None:
    async def run() -> None:
        bench = Bench()
        bench.port = await bench.face.open("127.0.0.1", 0)
        try:
            async with asyncio.timeout(20):
                await test(bench)
        finally:
            await bench.face.close()

    asyncio.run(run())


def frame(transaction: int, unit: int, pdu: bytes) -> bytes:
    return struct.pack(">HHHB", transaction, 0, len(pdu) + 1, unit) + pdu


def tension_n(registers: list[int], channel: int) -> float:
    return struct.unpack(">f", struct.pack(">HH", *registers[16 + 4 * (channel - 1) :][:2]))[0]


def test_amplifier_tells_the_plants_tensions() -> None:
    async def test(bench: Bench) -> None:
        bench.world.start_at_equilibrium(bench.world.tension_n + [20, 22, 24, 26, 28, 30], 0.1)
        bench.now_s = 0.25
        async with bench.client() as client:
            answer = await client.read_input_registers(0, count=40, device_id=AMPLIFIER)
            assert answer.registers[:4] == [0x5201, 6, 1, 250]
            assert struct.pack(">12H", *answer.registers[4:16]).rstrip(b"\0") == b"1381236736"
            for channel in range(1, 7):
                # Sensor noise is 0.1 N, and two reads within the millisecond are one measurement.
                shown_n = tension_n(answer.registers, channel)
                assert shown_n == pytest.approx(bench.world.tension_n[channel - 1], abs=0.6)
                assert answer.registers[18 + 4 * (channel - 1) :][:2] == [0, 0]
            again = await client.read_holding_registers(0, count=40, device_id=AMPLIFIER)
            assert again.registers == answer.registers
            part = await client.read_input_registers(23, count=7, device_id=AMPLIFIER)
            assert part.registers == answer.registers[23:30]
            bench.now_s = 0.251
            later = await client.read_input_registers(3, count=1, device_id=AMPLIFIER)
            assert later.registers == [251]

    on_bench(test)


def test_amplifier_tells_a_broken_wire() -> None:
    async def test(bench: Bench) -> None:
        bench.amplifier.set_status(3, ChannelStatus.WIRE_BREAK)
        bench.amplifier.healthy = False
        async with bench.client() as client:
            registers = (await client.read_input_registers(0, count=40, device_id=AMPLIFIER)).registers
        assert registers[2] == 0
        assert registers[26] == 2 and math.isnan(tension_n(registers, 3))
        assert registers[22] == 0 and math.isfinite(tension_n(registers, 2))

    on_bench(test)


def test_exceptions_as_pymodbus_sees_them() -> None:
    async def test(bench: Bench) -> None:
        async with bench.client() as client:
            asked = [
                (client.read_input_registers(40, count=1, device_id=AMPLIFIER), 2),
                (client.read_input_registers(39, count=2, device_id=AMPLIFIER), 2),
                (client.write_register(0, 1, device_id=AMPLIFIER), 1),
                (client.read_coils(0, count=1, device_id=AMPLIFIER), 1),
                (client.read_input_registers(0, count=1, device_id=PLC), 1),
                (client.read_holding_registers(14, count=2, device_id=PLC), 2),
                (client.write_register(4, 1, device_id=PLC), 2),
                (client.write_registers(9, [0, 0], device_id=PLC), 2),
                (client.write_register(11, 1, device_id=PLC), 3),  # half a speed
                (client.write_register(10, 4, device_id=PLC), 3),  # a bit that has no meaning
                (client.write_register(14, 9, device_id=PLC), 3),
                (client.write_register(14, 1001, device_id=PLC), 3),
                (client.read_holding_registers(0, count=1, device_id=77), 11),
            ]
            for request, code in asked:
                answer = await request
                assert answer.isError() and answer.exception_code == code
            assert (await client.read_holding_registers(10, count=5, device_id=PLC)).registers == [0] * 5

    on_bench(test)


def test_plc_runs_the_unwinder_in_one_transaction() -> None:
    async def test(bench: Bench) -> None:
        async with bench.client() as client:
            request = [1, *_words(100_000), 17]
            answer = await client.readwrite_registers(
                read_address=0, read_count=5, write_address=10, values=request, device_id=PLC
            )
            # Permissive, emergency stop healthy, running, watchdog not tripped.
            assert answer.registers[0] == 0x5202 and answer.registers[1] == 0b0111
            assert _speed(answer.registers) == pytest.approx(0.1, abs=1e-3)
            assert answer.registers[4] == 17
            assert bench.world.unwind_speed_m_per_s == 0.1
            await client.write_registers(11, _words(-50_000), device_id=PLC)
            assert bench.world.unwind_speed_m_per_s == -0.05
            await client.write_register(10, 0, device_id=PLC)
            assert bench.world.unwind_speed_m_per_s == 0.0
            bench.plc.emergency_stop = True
            bench.plc.permissive = False
            assert (await client.read_holding_registers(1, count=1, device_id=PLC)).registers == [0]

    on_bench(test)


def test_plc_stops_when_the_life_counter_stands_still() -> None:
    async def test(bench: Bench) -> None:
        async with bench.client() as client:

            async def cycle(run: int, life: int) -> int:
                answer = await client.readwrite_registers(
                    read_address=0, read_count=5, write_address=10, values=[run, *_words(100_000), life], device_id=PLC
                )
                return answer.registers[1]

            await client.write_register(14, 100, device_id=PLC)
            assert await cycle(1, 1) == 0b0111
            bench.now_s = 0.09
            assert await cycle(1, 2) == 0b0111
            bench.now_s = 0.18
            assert await cycle(1, 2) == 0b0111  # the counter stands still from here on
            bench.now_s = 0.192
            assert await cycle(1, 2) == 0b1011
            assert bench.world.unwind_speed_m_per_s == 0.0
            bench.now_s = 0.2
            assert await cycle(1, 3) == 0b1011  # latched: a counter that moves again is not enough
            assert await cycle(0, 4) & 0b0100 == 0
            assert await cycle(1, 5) == 0b0111
        [trip] = bench.recorder.recording().of_kind("plc_watchdog")
        assert trip["time_s"] == pytest.approx(0.19)

    on_bench(test)


def test_pipelined_requests_are_answered_one_by_one() -> None:
    async def test(bench: Bench) -> None:
        reader, writer = await bench.stream()
        requests = [frame(k, AMPLIFIER, struct.pack(">BHH", 4, k, 1)) for k in range(3)]
        writer.write(b"".join(requests) + frame(9, PLC, b"\x2b"))
        assert await reader.readexactly(3 * 11) == b"".join(
            frame(k, AMPLIFIER, struct.pack(">BBH", 4, 2, word)) for k, word in enumerate([0x5201, 6, 1])
        )
        assert await reader.readexactly(9) == frame(9, PLC, b"\xab\x01")
        writer.close()
        await writer.wait_closed()

    on_bench(test)


def test_a_request_may_come_byte_by_byte() -> None:
    async def test(bench: Bench) -> None:
        reader, writer = await bench.stream()
        for byte in frame(5, AMPLIFIER, struct.pack(">BHH", 3, 0, 2)):
            writer.write(bytes((byte,)))
            await writer.drain()
            await asyncio.sleep(0)
        assert await reader.readexactly(13) == frame(5, AMPLIFIER, struct.pack(">BBHH", 3, 4, 0x5201, 6))
        writer.close()
        await writer.wait_closed()

    on_bench(test)


@pytest.mark.parametrize("garbage", [b"GET / HTTP/1.1\r\n\r\n", bytes(64), struct.pack(">HHHB", 1, 0, 60000, 1)])
def test_garbage_closes_its_own_connection_only(garbage: bytes) -> None:
    async def test(bench: Bench) -> None:
        reader, writer = await bench.stream()
        async with bench.client() as bystander:
            assert not (await bystander.read_holding_registers(0, count=1, device_id=PLC)).isError()
            writer.write(garbage)
            with pytest.raises((asyncio.IncompleteReadError, ConnectionResetError)):
                await reader.readexactly(1)
            assert bench.face.malformed == 1
            assert (await bystander.read_holding_registers(0, count=1, device_id=PLC)).registers == [0x5202]
        writer.close()

    on_bench(test)


def test_connections_are_limited() -> None:
    async def test(bench: Bench) -> None:
        ask = frame(1, PLC, struct.pack(">BHH", 3, 0, 1))
        streams = []
        for _ in range(MAX_CONNECTIONS):
            reader, writer = await bench.stream()
            writer.write(ask)
            await reader.readexactly(11)
            streams.append(writer)
        reader, writer = await bench.stream()
        with pytest.raises((asyncio.IncompleteReadError, ConnectionResetError)):
            await reader.readexactly(1)
        assert bench.face.refused == 1
        writer.close()
        streams.pop().close()
        while len(bench.face.connections) == MAX_CONNECTIONS:  # noqa: ASYNC110
            await asyncio.sleep(0)
        reader, writer = await bench.stream()
        writer.write(ask)
        await reader.readexactly(11)
        for open_writer in (*streams, writer):
            open_writer.close()

    on_bench(test)


def test_a_port_that_is_taken_is_an_os_error() -> None:
    async def test(bench: Bench) -> None:
        with pytest.raises(OSError):
            await ModbusFace({}, lambda: 0.0).open("127.0.0.1", bench.port)

    on_bench(test)


def _words(value: int) -> list[int]:
    return list(struct.unpack(">HH", struct.pack(">i", value)))


def _speed(registers: list[int]) -> float:
    return struct.unpack(">i", struct.pack(">HH", *registers[2:4]))[0] * 1e-6
