"""Fuzz targets on Modbus TCP: whole answers through the client that believes them, registers through the devices."""

import logging
import struct
from collections.abc import Callable
from math import isfinite
from random import Random
from types import SimpleNamespace

from pymodbus.framer import FramerSocket
from pymodbus.pdu import DecodePDU, ModbusPDU

from drivers.device_map import MAPS, load_map
from drivers.modbus.amplifier import Amplifier
from drivers.modbus.axis import Axis, axis_settings
from drivers.modbus.client import ModbusConnection, ModbusFailed
from drivers.modbus.device import Standing
from drivers.modbus.maps import DriveMap, LoadCellMap, PlcMap
from drivers.modbus.plc import Plc
from drivers.modbus.registers import RegisterBlock
from gateway.core.signals import DriveState, Inputs, Quality
from tests.bench.fuzz_canopen import ACCEPTED, REFUSED, same
from tests.bench.fuzz_lines import CAPACITY_N, RATED_NM, lines

UNIT, TRANSACTION, COUNT = 3, 4711, 5
FAR_S = 1e12


class ClientAnswer:
    """Whole frames, through pymodbus's own framer and decoder, then through `ModbusConnection`: `COUNT` registers.

    In place of the socket stands what pymodbus does with the bytes from it.
    """

    name = "modbus answer"

    def __init__(self) -> None:
        logging.getLogger("pymodbus").setLevel(logging.CRITICAL + 1)
        self._framer = FramerSocket(DecodePDU(False))
        self._bytes = b""
        self._connection = ModbusConnection("127.0.0.1", 1)
        context = SimpleNamespace(recv_buffer=b"", request_transaction_id=TRANSACTION, transport=None)
        client = SimpleNamespace(connected=True, ctx=context, close=lambda: None, read_holding_registers=self._answer)
        self._reconnect: Callable[[], None] = lambda: setattr(self._connection, "_client", client)

    def valid(self, dice: Random) -> bytes:
        if dice.random() < 0.1:
            return struct.pack(">HHHBBB", TRANSACTION, 0, 3, UNIT, 0x83, dice.randrange(1, 12))
        values = [dice.randrange(65536) for _ in range(COUNT)]
        return struct.pack(f">HHHBBB{COUNT}H", TRANSACTION, 0, 3 + 2 * COUNT, UNIT, 3, 2 * COUNT, *values)

    async def _answer(self, address: int, count: int, device_id: int) -> ModbusPDU:
        _, pdu = self._framer.handleFrame(self._bytes, device_id, TRANSACTION)
        if pdu is None:  # it would wait for more
            raise TimeoutError
        return pdu

    async def check(self, data: bytes) -> str:
        self._bytes = data
        self._reconnect()
        wanted = _wanted(data)
        try:
            found = await self._connection.read(3, UNIT, 0, COUNT, FAR_S)
        except ModbusFailed:
            assert wanted is None, f"a sound answer was refused: {data.hex()}"
            return REFUSED
        assert wanted is not None, f"{data.hex()} was accepted as {found}"
        assert found == wanted, f"{data.hex()}: {found}, not {wanted}"
        return ACCEPTED


def _wanted(data: bytes) -> list[int] | None:
    """The registers in the first frame that is for this request; None where there is none."""
    while len(data) >= 9:
        transaction, protocol, length, unit = struct.unpack_from(">HHHB", data)
        frame, data = data[7 : 6 + length], data[6 + length :]
        if protocol or len(frame) != length - 1:
            return None
        if unit != UNIT or transaction not in (TRANSACTION, 0):
            continue  # of another request: passed over
        whole = transaction == TRANSACTION and len(frame) == 2 + 2 * COUNT and frame[:2] == bytes((3, 2 * COUNT))
        return list(struct.unpack_from(f">{COUNT}H", frame, 2)) if whole else None
    return None


class CellRegisters:
    """Registers 2 to 27 of loadcell-amp: health, sample counter, six channels of float32 and status."""

    name = "modbus load-cell registers"
    _layout = struct.Struct(">HH24x" + "fHxx" * 6)

    def __init__(self) -> None:
        device = load_map(MAPS / "loadcell-amp.toml")
        assert isinstance(device, LoadCellMap)
        self._device = Amplifier(device, lines("mixed").load_cells)
        self._block = RegisterBlock(self._device.wish.reads, self._device.wish.word_order)
        assert (self._block.address, self._block.count) == (2, 37), (self._block.address, self._block.count)
        self._inputs = Inputs(6)
        self._counter: int | None = None

    def valid(self, dice: Random) -> bytes:
        counter = dice.randrange(3) if dice.random() < 0.3 else dice.randrange(65536)
        cells = [value for _ in range(6) for value in (dice.uniform(-20.0, 110.0), dice.choice((0, 0, 0, 0, 1, 2, 3)))]
        return self._layout.pack(1, counter, *cells)[:74]

    def check(self, data: bytes) -> str:
        registers = _registers(data)
        try:
            numbers = self._block.decode(registers)
        except ValueError:
            assert len(registers) != 37, "whole registers were refused"
            return REFUSED
        assert len(registers) == 37, "a wrong number of registers was accepted"
        self._device.fill(self._inputs, numbers, Standing(active=True), 0.0)
        health, counter, *cells = self._layout.unpack(struct.pack(">37H", *registers) + b"\0\0")
        stands, self._counter = counter == self._counter, counter
        good = 0
        for k, (tension_n, status) in enumerate(zip(cells[::2], cells[1::2], strict=True)):
            usable = not stands and health & 1 and status == 0 and isfinite(tension_n) and abs(tension_n) <= CAPACITY_N
            assert (self._inputs.tension.quality[k] == Quality.GOOD) == bool(usable), (tension_n, status, health)
            assert not usable or same(float(self._inputs.tension.value[k]), tension_n)
            good += bool(usable)
        return ACCEPTED if good == 6 else REFUSED


class DriveRegisters:
    """Registers 1 to 6 of r2r-drive-modbus: statusword, i32 um/s, i16 thousandths, flags, error code."""

    name = "modbus drive registers"
    _layout = struct.Struct(">HihHH")
    #: Mask and value of the statusword, as r2r-drive has them, and what it means for the loop.
    _states = ((0x4F, 0x08, DriveState.FAULT), (0x6F, 0x07, DriveState.STOPPING), (0x6F, 0x21, DriveState.READY))

    def __init__(self) -> None:
        device = load_map(MAPS / "r2r-drive-modbus.toml")
        assert isinstance(device, DriveMap)
        line = lines("modbus")
        drive = line.drives[0].model_copy(update={"channel": 1})
        settings = axis_settings(drive, line.limits.torque_nm, line.limits.watchdog_s, 0.035)
        self._device = Axis("drive-1", 0, device, settings)
        self._block = RegisterBlock(self._device.wish.reads, self._device.wish.word_order)
        assert (self._block.address, self._block.count) == (1, 6), (self._block.address, self._block.count)
        self._inputs = Inputs(6)

    def valid(self, dice: Random) -> bytes:
        word = dice.choice((0x1237, 0x0250, 0x0231, 0x0218, 0x0217))
        return self._layout.pack(word, dice.randint(-200_000, 200_000), dice.randint(-1000, 1000), 0, 0)

    def check(self, data: bytes) -> str:
        registers = _registers(data)
        try:
            numbers = self._block.decode(registers)
        except ValueError:
            assert len(registers) != 6, "whole registers were refused"
            return REFUSED
        assert len(registers) == 6, "a wrong number of registers was accepted"
        inputs = self._inputs
        self._device.fill(inputs, numbers, Standing(active=True), 0.0)
        word, speed, torque, flags, _ = self._layout.unpack(struct.pack(">6H", *registers))
        assert same(float(inputs.speed.value[0]), speed * 1e-6)
        assert same(float(inputs.torque.value[0]), torque / 1000 * RATED_NM)
        for mask, value, state in self._states:
            if word & mask == value and not flags & 1:
                assert inputs.drive_state[0] == state, (hex(word), inputs.drive_state[0])
        enabled = word & 0x6F == 0x27 and word & 0x1000 and not flags & 1
        assert inputs.drive_state[0] != DriveState.ENABLED or enabled, (hex(word), flags)
        return ACCEPTED


class PlcRegisters:
    """Registers 1 to 4 of line-plc: status, i32 um/s, echo."""

    name = "modbus PLC registers"
    _layout = struct.Struct(">HiH")

    def __init__(self) -> None:
        device = load_map(MAPS / "line-plc.toml")
        assert isinstance(device, PlcMap)
        self._device = Plc(device, lines("demo").plc, 0.1)
        self._block = RegisterBlock(self._device.wish.reads, self._device.wish.word_order)
        assert (self._block.address, self._block.count) == (1, 4), (self._block.address, self._block.count)
        self._inputs = Inputs(6)

    def valid(self, dice: Random) -> bytes:
        return self._layout.pack(dice.randrange(16), dice.randint(-10, 120_000), dice.randrange(65536))

    def check(self, data: bytes) -> str:
        registers = _registers(data)
        try:
            numbers = self._block.decode(registers)
        except ValueError:
            assert len(registers) != 4, "whole registers were refused"
            return REFUSED
        assert len(registers) == 4, "a wrong number of registers was accepted"
        inputs = self._inputs
        self._device.fill(inputs, numbers, Standing(active=True), 0.0)
        status, speed, _ = self._layout.unpack(struct.pack(">4H", *registers))
        assert inputs.plc.permissive == bool(status & 1)
        assert inputs.plc.emergency_stop == (not status & 2)
        assert inputs.plc.running == bool(status & 4)
        if inputs.unwind_speed.quality[0] != Quality.GOOD:
            assert abs(speed) > 50_000_000, "a usable speed was refused"
            return REFUSED
        assert same(float(inputs.unwind_speed.value[0]), speed * 1e-6) and abs(speed) <= 50_000_000
        return ACCEPTED


def _registers(data: bytes) -> list[int]:
    """As the client hands them over: whole ones."""
    return list(struct.unpack(f">{len(data) // 2}H", data[: len(data) // 2 * 2]))
