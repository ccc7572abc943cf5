"""What the tests of the Modbus drivers share: the links of a line, built without the other protocols, and a bench."""

import asyncio
import struct
from collections.abc import Awaitable, Callable
from pathlib import Path

from drivers.device_map import MAPS, load_map
from drivers.modbus.build import build
from drivers.modbus.link import ModbusLink
from drivers.wiring import Wired
from gateway.core.line import Line, ModbusTcpBus
from gateway.core.signals import DriveRequest, DriveState, Inputs, Outputs, Quality
from tests.protocol.driver_support import (
    ENABLED,
    FAULT,
    PATIENCE_S,
    QUICK_STOP,
    READY,
    SWITCH_ON_DISABLED,
    SWITCHED_ON,
    Registers,
    cycle,
    frame,
    line,
    until,
)

Body = Callable[[ModbusLink, Registers], Awaitable[None]]
DriveBody = Callable[[ModbusLink, list["ModbusDrive"], Registers], Awaitable[None]]


def modbus_links(of_line: Line, folder: Path = MAPS) -> list[ModbusLink]:
    """The links of everything in a line that is on Modbus TCP."""
    links, reasons = build(of_line, wired(of_line, folder))
    assert not reasons
    assert all(isinstance(link, ModbusLink) for link in links)
    return [link for link in links if isinstance(link, ModbusLink)]


def wired(of_line: Line, folder: Path = MAPS) -> list[Wired]:
    buses = {bus.name: bus for bus in of_line.buses if isinstance(bus, ModbusTcpBus)}
    items = [*of_line.drives, *of_line.load_cells, of_line.plc]
    return [Wired(i, buses[i.bus], load_map(folder / f"{i.map}.toml")) for i in items if i.bus in buses]


def bench(body: Body, n: int = 2, channels: int = 2) -> None:
    """`body` with the link of a line's amplifier and PLC, open, and the peer that plays both."""

    async def run() -> None:
        async with Registers(channels) as peer:
            (link,) = modbus_links(line(n, modbus_port=peer.port))
            await link.open()
            try:
                await body(link, peer)
            finally:
                await link.close()

    asyncio.run(run())


def command(run: bool, speed_m_per_s: float, n: int = 2) -> Outputs:
    outputs = Outputs(n)
    outputs.run, outputs.speed_request_m_per_s = run, speed_m_per_s
    return outputs


async def until_good(link: ModbusLink, inputs: Inputs) -> None:
    """Cycles until tensions and v0 are all good."""
    inputs.tension.quality[:] = inputs.unwind_speed.quality[:] = Quality.STALE
    async with asyncio.timeout(PATIENCE_S):
        while not (inputs.tension.good() and inputs.unwind_speed.good()):
            await cycle(link, inputs, 0.01)
            await asyncio.sleep(0)  # without a connection a cycle waits for nothing


# Drives, as the documents of the devices describe them

_STEPS = {  # of CiA 402: (state, controlword) to state; everything else stays
    (SWITCH_ON_DISABLED, 0x06): READY,
    (READY, 0x07): SWITCHED_ON,
    (SWITCHED_ON, 0x0F): ENABLED,
    (ENABLED, 0x06): READY,
    (ENABLED, 0x02): QUICK_STOP,
    (FAULT, 0x80): SWITCH_ON_DISABLED,
}


class Power:
    """The state machine of one axis. `commands` are all pairs of controlword and target torque that were written."""

    def __init__(self) -> None:
        self.statusword = SWITCH_ON_DISABLED
        self.torque = 0  #: that it shows
        self.commands: list[tuple[int, int]] = []
        self.obeys = True

    def take(self, controlword: int, torque: int) -> None:
        self.commands.append((controlword, torque))
        if self.obeys:
            off = controlword == 0 and self.statusword != FAULT
            after = SWITCH_ON_DISABLED if off else _STEPS.get((self.statusword, controlword))
            self.statusword = after or self.statusword
            self.torque = torque if self.statusword == ENABLED else 0


class Holding:
    """Holding registers behind one unit, as a `Registers.script` for functions 3, 16 and 23.

    `after_write(first, last)` lets the device act on what was written; `before_read()` lets it measure.
    """

    def __init__(self, count: int) -> None:
        self.registers = [0] * count
        self.writes: list[tuple[int, int]] = []  #: first and last register of every write
        self.reads: list[tuple[int, int]] = []
        self.refuses: dict[int, int] = {}  #: writes to these registers are answered with this exception
        self.stubborn: set[int] = set()  #: writes to these are confirmed, and not done
        self.silent = False

    def after_write(self, first: int, last: int) -> None: ...

    def before_read(self) -> None: ...

    def number(self, address: int, code: str, value: float) -> None:
        packed = struct.pack(code, value)
        self.registers[address : address + len(packed) // 2] = struct.unpack(f">{len(packed) // 2}H", packed)

    async def script(self, head: bytes, unit: int, pdu: bytes) -> list[bytes]:
        return [] if self.silent else [frame(head, unit, self.answer(pdu))]

    def answer(self, pdu: bytes) -> bytes:
        function = pdu[0]
        address, count = struct.unpack(">HH", pdu[1:5])
        if function in (16, 23):
            at, length, size = (address, count, pdu[5]) if function == 16 else struct.unpack(">HHB", pdu[5:10])
            values = struct.unpack(f">{length}H", pdu[-size:])
            for register in range(at, at + length):
                if register in self.refuses:
                    return bytes((function | 0x80, self.refuses[register]))
            self.writes.append((at, at + length - 1))
            for register, value in enumerate(values, at):
                if register not in self.stubborn:
                    self.registers[register] = value
            self.after_write(at, at + length - 1)
            if function == 16:
                return pdu[:5]
        if function not in (3, 23):
            return bytes((function | 0x80, 1))
        if address + count > len(self.registers):
            return bytes((function | 0x80, 2))
        self.reads.append((address, address + count - 1))
        self.before_read()
        return bytes((function, 2 * count)) + struct.pack(f">{count}H", *self.registers[address : address + count])


class ModbusDrive(Holding):
    """r2r-drive-modbus, rated 80 Nm."""

    def __init__(self) -> None:
        super().__init__(24)
        self.power = Power()
        self.registers[0] = 0x5203
        self.registers[20:24] = [80_000 >> 16, 80_000 & 0xFFFF, 1000, 0]

    def after_write(self, first: int, last: int) -> None:
        if first <= 10 and last >= 11:
            self.power.take(self.registers[10], *struct.unpack(">h", struct.pack(">H", self.registers[11])))

    def before_read(self) -> None:
        self.registers[1] = self.power.statusword
        if self.power.statusword == ENABLED:
            self.number(4, ">h", self.power.torque)


class Rack(Holding):
    """r2r-rack with `n` axes and channels, rated 80 Nm each."""

    def __init__(self, n: int) -> None:
        super().__init__(305)
        self.powers = [Power() for _ in range(n)]
        self.registers[:3] = [0x5204, n, 0b0011]
        self.registers[7] = 1
        self.registers[302:305] = [80_000 >> 16, 80_000 & 0xFFFF, 1000]

    def after_write(self, first: int, last: int) -> None:
        if first <= 203 <= last:
            self.registers[5] = self.registers[203]
        for k, power in enumerate(self.powers):
            if first <= 204 + 2 * k <= last:
                torque = struct.unpack(">h", struct.pack(">H", self.registers[205 + 2 * k]))[0]
                power.take(self.registers[204 + 2 * k], torque)

    def before_read(self) -> None:
        self.registers[6] = (self.registers[6] + 1) & 0xFFFF
        for k, power in enumerate(self.powers):
            self.registers[8 + 8 * k] = power.statusword
            if power.statusword == ENABLED:
                self.number(11 + 8 * k, ">h", power.torque)


def drives_line(n: int, port: int) -> Line:
    """Drives as units 11 and following, the amplifier as unit 1, the PLC as unit 2, behind one address."""
    base = line(n, modbus_port=port)
    change = {"bus": "io", "map": "r2r-drive-modbus"}
    drives = [drive.model_copy(update={**change, "address": 10 + drive.roller}) for drive in base.drives]
    return base.model_copy(update={"drives": drives, "buses": base.buses[1:]})


def rack_line(n: int, port: int) -> Line:
    """Everything in unit 3."""
    base = line(n, modbus_port=port)
    there = {"bus": "io", "address": 3}
    drives = [
        drive.model_copy(update={**there, "map": "r2r-rack-drive", "channel": drive.roller}) for drive in base.drives
    ]
    cells = [cell.model_copy(update={**there, "map": "r2r-rack-cells"}) for cell in base.load_cells]
    plc = base.plc.model_copy(update={**there, "map": "r2r-rack-plc"})
    return base.model_copy(update={"drives": drives, "load_cells": cells, "plc": plc, "buses": base.buses[1:]})


def torques(request: DriveRequest, *torque_nm: float) -> Outputs:
    outputs = Outputs(len(torque_nm))
    outputs.drive_request[:] = request
    outputs.torque_nm[:] = torque_nm
    return outputs


def drive_bench(body: DriveBody) -> None:
    """`body` with the link, two drives (units 11 and 12), and the server, which also plays amplifier and PLC."""

    async def run() -> None:
        async with Registers() as peer:
            drives = [ModbusDrive(), ModbusDrive()]

            async def play(head: bytes, unit: int, pdu: bytes) -> list[bytes] | None:
                return await drives[unit - 11].script(head, unit, pdu) if unit > 10 else None

            peer.script = play
            (link,) = modbus_links(drives_line(2, peer.port))
            await link.open()
            try:
                await body(link, drives, peer)
            finally:
                await link.close()

    asyncio.run(run())


async def enabled(link: ModbusLink, inputs: Inputs, torque_nm: float = 8.0) -> None:
    """Armed, and cycles until both drives follow their torque."""
    await link.prepare()
    inputs.drive_state[:] = DriveState.OFF
    async with asyncio.timeout(5.0):
        while not (inputs.drive_state == DriveState.ENABLED).all():
            link.write(torques(DriveRequest.ENABLE, torque_nm, torque_nm))
            await cycle(link, inputs)
    link.write(torques(DriveRequest.ENABLE, torque_nm, torque_nm))
    await cycle(link, inputs)


async def interrupt(link: ModbusLink, peer: Registers, inputs: Inputs, meanwhile: Callable[[], None]) -> None:
    """All connections are lost and made again within one cycle."""
    before = link.health.reconnects
    await peer.stop()
    meanwhile()
    await peer.start()
    peer.requests.clear()
    await cycle(link, inputs)
    await until(lambda: link.health.reconnects == before + 4)
