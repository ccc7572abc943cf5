"""What doctor and scan ask of Modbus TCP units, against scripted ones; and that they only ask."""

import asyncio
import struct
from collections.abc import Awaitable, Callable

import pytest

from drivers.device_map import MAPS, load_map, map_names
from drivers.inspection import BusFacts
from drivers.modbus.client import ModbusFailed
from drivers.modbus.inspect import inspect
from drivers.modbus.maps import ModbusMap
from drivers.modbus.scan import registers, scan, usual_float
from drivers.wiring import Wired
from gateway.core.line import ModbusTcpBus
from tests.protocol.driver_support import FAULT, Registers, frame, line, until
from tests.protocol.modbus_support import wired
from tests.support.cutting import cut


def quiet(text: str) -> None:
    """Nobody waits."""


def bench(body: Callable[[Registers], Awaitable[None]], channels: int = 2) -> None:
    """`body` with the peer; afterwards every request must have been function 3 or 4."""

    async def run() -> None:
        async with Registers(channels) as peer:
            await body(peer)
            assert {pdu[0] for _, pdu in peer.requests} <= {3, 4}

    asyncio.run(run())


async def inspected(peer: Registers, n: int = 2) -> BusFacts:
    of_line = line(n, modbus_port=peer.port)
    (bus,) = (bus for bus in of_line.buses if isinstance(bus, ModbusTcpBus))
    return await inspect(bus, wired(of_line), 0.0, quiet)


def test_load_cells_and_plc_as_their_maps_say() -> None:
    async def body(peer: Registers) -> None:
        peer.tension(1, 12.5)
        peer.tension(2, 30.0)
        peer.plc[2:4] = struct.unpack(">HH", struct.pack(">i", 50_000))
        peer.plc[14] = 100
        first, second, plc = (await inspected(peer)).devices
        for cell, tension_n in ((first.cell, 12.5), (second.cell, 30.0)):
            assert cell is not None and cell.counter_moves is True and not cell.trouble
            assert len(cell.samples_n) >= 2 and set(cell.samples_n) == {tension_n}
        assert plc.plc is not None and plc.watchdog is not None
        assert plc.plc.permissive and not plc.plc.emergency_stop and not plc.plc.running
        assert plc.plc.speed_m_per_s.value == pytest.approx(0.05)
        assert plc.watchdog.now_s.value == pytest.approx(0.1) and plc.watchdog.high_s == 1.0

    bench(body)


def test_what_is_wrong_with_a_cell_is_said() -> None:
    async def body(peer: Registers) -> None:
        peer.counts = False
        peer.tension(1, float("nan"), 2)
        peer.tension(2, float("nan"))
        broken, nan, missing, _ = (await inspected(peer, 3)).devices
        assert broken.cell is not None and broken.cell.trouble == "wire break" and not broken.cell.samples_n
        assert broken.cell.counter_moves is False
        assert nan.cell is not None and "not finite" in nan.cell.trouble and not nan.cell.samples_n
        assert missing.differences == ("channel 3: the amplifier has 2",)

    bench(body)


def test_another_device_and_a_unit_that_nobody_answers_to() -> None:
    async def body(peer: Registers) -> None:
        peer.amplifier[0] = 0x1234

        async def script(transaction: bytes, unit: int, pdu: bytes) -> list[bytes] | None:
            return [frame(transaction, unit, bytes((pdu[0] | 0x80, 11)))] if unit == 2 else None

        peer.script = script
        first, _, plc = (await inspected(peer)).devices
        assert first.identity is not None and not first.identity.fits and first.cell is None
        assert (first.identity.found, first.identity.wanted) == ("device id 0x1234", "device id 0x5201")
        assert plc.identity is not None and not plc.identity.fits and "exception 11" in plc.identity.found

    bench(body)


def test_a_unit_that_is_silent_costs_the_others_nothing() -> None:
    async def body(peer: Registers) -> None:
        async def script(transaction: bytes, unit: int, pdu: bytes) -> list[bytes] | None:
            return [] if unit == 1 else None

        peer.script = script
        first, second, plc = (await inspected(peer)).devices
        assert "no answer" in first.silent and "no answer" in second.silent
        assert plc.plc is not None and plc.plc.permissive

    bench(body)


def test_nobody_listens() -> None:
    async def run() -> None:
        async with Registers() as peer:
            port = peer.port
        of_line = line(modbus_port=port)
        (bus,) = (bus for bus in of_line.buses if isinstance(bus, ModbusTcpBus))
        facts = await inspect(bus, wired(of_line), 0.0, quiet)
        assert facts.trouble == f"no connection to 127.0.0.1:{port}" and not facts.devices

    asyncio.run(run())


def test_a_modbus_drive_in_fault_without_a_watchdog_register() -> None:
    """r2r-drive-modbus behind unit 2: the device id of the drive, a fault, and exception 2 for register 23."""

    async def body(peer: Registers) -> None:
        peer.plc = [0x5203, FAULT, 0, 0, 0, 1, 0x8250] + [0] * 13 + [0, 60_000 & 0xFFFF, 1000]
        of_line = line(1, modbus_port=peer.port)
        (bus,) = (bus for bus in of_line.buses if isinstance(bus, ModbusTcpBus))
        drive = of_line.drives[0].model_copy(update={"bus": "io", "map": "r2r-drive-modbus", "address": 2})
        device = load_map(MAPS / "r2r-drive-modbus.toml")
        (facts,) = (await inspect(bus, [Wired(drive, bus, device)], 0.0, quiet)).devices
        assert facts.drive is not None and facts.watchdog is not None
        assert facts.drive.error == "error 0x8250 communication watchdog" and facts.drive.safe_torque_off is True
        assert facts.drive.rated_torque_nm is not None and facts.drive.rated_torque_nm.value == 60.0
        assert facts.drive.max_torque_nm is not None and facts.drive.max_torque_nm.value == 60.0
        assert facts.watchdog.now_s.value is None and "exception 2" in facts.watchdog.now_s.trouble

    bench(body)


def maps() -> dict[str, ModbusMap]:
    every = {name: load_map(MAPS / f"{name}.toml") for name in map_names()}
    return {name: device for name, device in every.items() if isinstance(device, ModbusMap)}


def test_scan_finds_units_functions_and_maps() -> None:
    async def body(peer: Registers) -> None:
        async def script(transaction: bytes, unit: int, pdu: bytes) -> list[bytes] | None:
            if unit == 2 and pdu[0] == 4:
                return [frame(transaction, unit, bytes((0x84, 1)))]
            if unit == 7:  # a strange one: there, but it gives nothing
                return [frame(transaction, unit, bytes((pdu[0] | 0x80, 4)))]
            if unit not in (1, 2):
                return [frame(transaction, unit, bytes((pdu[0] | 0x80, 11)))]
            return None

        peer.script = script
        found = await scan("127.0.0.1", peer.port, [1, 2, 3, 7], maps(), quiet)
        assert found.connected
        assert {unit.unit: unit.maps for unit in found.units} == {1: ("loadcell-amp",), 2: ("line-plc",), 7: ()}
        assert found.units[1].functions == {3: "yes", 4: "no"}
        assert found.units[2].functions[3] == "exception 4 to function 3", "an exception is an answer"

    bench(body)


def test_scan_says_when_nobody_listens() -> None:
    async def run() -> None:
        async with Registers() as peer:
            port = peer.port
        found = await scan("127.0.0.1", port, [1], {}, quiet)
        assert not found.connected and not found.units

    asyncio.run(run())


def test_the_code_of_an_exception_is_read_from_what_the_client_says() -> None:
    async def body(peer: Registers) -> None:
        with pytest.raises(ModbusFailed) as failed:
            await registers("127.0.0.1", peer.port, 2, 4000, 1, [3])
        assert failed.value.exception_code == 2

    bench(body)


def test_a_register_in_every_way_of_reading() -> None:
    async def body(peer: Registers) -> None:
        peer.tension(1, 30.0)  # registers 16 and 17 on the wire, high word first
        function, rows = await registers("127.0.0.1", peer.port, 1, 17, 1)
        assert function == 3
        by_name = {row.reading: row for row in rows}
        assert len(rows) == 14
        # Who reads the manual's 17 and counts from 1 finds it, with the high word first.
        assert by_name["f32 high-first"].one == 30.0 and usual_float(by_name["f32 high-first"], 30.0)
        assert by_name["u16"].one == 0x41F0 and by_name["u16"].zero == 0
        assert by_name["u32 low-first"].one == 0x41F0
        assert by_name["u32 high-first, bytes swapped"].one == 0xF0410000
        assert by_name["i32 low-first, bytes swapped"].one == 0x0000F041
        assert not usual_float(by_name["u16"], 30)

    bench(body)


def test_registers_at_the_ends_of_what_there_is() -> None:
    async def body(peer: Registers) -> None:
        last = len(peer.plc) - 1
        peer.plc[last] = 0xFFFE
        _, rows = await registers("127.0.0.1", peer.port, 2, last, 1, [3])
        by_name = {row.reading: row for row in rows}
        assert by_name["i16"].zero == -2
        assert by_name["u32 high-first"].zero is None, "the register behind it does not exist"
        assert by_name["u32 high-first"].one == 0xFFFE
        _, rows = await registers("127.0.0.1", peer.port, 2, 0, 1, [3])
        by_name = {row.reading: row for row in rows}
        assert by_name["u16"].zero == 0x5202 and by_name["u16"].one is None, "nothing lies before register 0"

    bench(body)


def test_wherever_it_is_cancelled_no_connection_stays_open() -> None:
    async def body(peer: Registers) -> None:
        of_line = line(2, modbus_port=peer.port)
        (bus,) = (bus for bus in of_line.buses if isinstance(bus, ModbusTcpBus))
        cuts = 0
        while await cut(inspect(bus, wired(of_line), 0.0, quiet), cuts + 1):
            cuts += 1
            await until(lambda: not peer.connected)
        assert cuts > 10
        cuts = 0
        while await cut(scan("127.0.0.1", peer.port, [1, 2], {}, quiet), cuts + 1):
            cuts += 1
            await until(lambda: not peer.connected)
        assert cuts >= 4

    bench(body)
