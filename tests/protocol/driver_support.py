"""Scripted peers for the drivers: raw CAN frames and raw Modbus TCP bytes, written apart from the code under test."""

import asyncio
import struct
import threading
from collections.abc import Awaitable, Callable
from typing import Any, Self

import can

from gateway.core.line import Line
from gateway.core.signals import Inputs

PATIENCE_S = 5.0  #: until a test that waits for something fails
GROUP = "239.74.163.2"
SWITCH_ON_DISABLED, READY, SWITCHED_ON, ENABLED, QUICK_STOP, FAULT = 0x0250, 0x0231, 0x0233, 0x1237, 0x0217, 0x0218


def parameter(value: float) -> dict[str, float]:
    return {"value": value, "tolerance": 0.1}


def line(
    n: int = 2, can_bus: dict[str, Any] | None = None, modbus_port: int = 5020, plc_port: int | None = None
) -> Line:
    """A line of n spans: drives are nodes 1 to n, rated 80 Nm; one amplifier as unit 1, the PLC as unit 2."""
    buses: list[dict[str, Any]] = [
        {"name": "drives", "protocol": "canopen", "interface": "udp_multicast", "channel": GROUP, **(can_bus or {})},
        {"name": "io", "protocol": "modbus-tcp", "host": "127.0.0.1", "port": modbus_port},
    ]
    if plc_port is not None:
        buses.append({"name": "plc-io", "protocol": "modbus-tcp", "host": "127.0.0.1", "port": plc_port})
    return Line.model_validate(
        {
            "format": 1,
            "site": "test",
            "line": "line",
            "control": {"period_s": 0.1, "latency_s": 0.1},  # slow, so that a busy machine makes no test fail
            "limits": {
                "torque_nm": 60.0,
                "torque_rate_nm_per_s": 1000.0,
                "tension_min_n": 2.0,
                "tension_max_n": 60.0,
                "speed_max_m_per_s": 1.0,
            },
            "web": {"stiffness_n": parameter(2400.0)},
            "rollers": [
                {
                    "name": f"roller-{k}",
                    "radius_m": parameter(0.04),
                    "inertia_kg_m2": parameter(1.0),
                    "friction_nms_per_rad": parameter(10.0),
                }
                for k in range(1, n + 1)
            ],
            "spans": [{"name": f"span-{k}", "length_m": parameter(1.0)} for k in range(1, n + 1)],
            "buses": buses,
            "drives": [
                {
                    "name": f"drive-{k}",
                    "bus": "drives",
                    "map": "cia402-torque",
                    "address": k,
                    "roller": k,
                    "rated_torque_nm": 80.0,
                }
                for k in range(1, n + 1)
            ],
            "load_cells": [
                {
                    "name": f"cell-{k}",
                    "bus": "io",
                    "map": "loadcell-amp",
                    "address": 1,
                    "channel": k,
                    "span": k,
                    "capacity_n": 100.0,
                }
                for k in range(1, n + 1)
            ],
            "plc": {"name": "plc", "bus": "io" if plc_port is None else "plc-io", "map": "line-plc", "address": 2},
            "recipes": [{"name": "a", "tension_n": [20.0] * n, "speed_m_per_s": 0.1}],
        }
    )


async def cycle(link: Any, inputs: Inputs, wait_s: float = 0.5) -> None:
    """One reading cycle. `wait_s` is only used up when something does not answer."""
    now_s = asyncio.get_running_loop().time()
    link.trigger(now_s)
    await link.collect(inputs, now_s + wait_s)


async def until(condition: Callable[[], bool]) -> None:
    """Let the loop run until something has happened."""
    async with asyncio.timeout(PATIENCE_S):
        while not condition():  # noqa: ASYNC110 (what happens, happens in sockets)
            await asyncio.sleep(0)


# CANopen


class Drive:
    """A drive as the test scripts it: objects behind an SDO server, and what it answers to a SYNC."""

    def __init__(self, node: int) -> None:
        self.node = node
        self.statusword = SWITCH_ON_DISABLED
        self.speed_um_per_s = 0
        self.torque_per_mille = 0
        self.sdo_answers = True
        self.starts = True
        self.aborts: dict[tuple[int, int], int] = {}  #: writes to these objects are aborted with this code
        self.stubborn: set[tuple[int, int]] = set()  #: writes to these are confirmed, and not done
        self.on_sync: Callable[[Drive], list[bytes]] = lambda drive: [drive.tpdo()]
        self.rpdos: list[bytes] = []
        self.writes: list[tuple[int, int, bytes]] = []
        self.nmt: list[int] = []
        self.objects: dict[tuple[int, int], bytes] = {
            (0x1018, 1): struct.pack("<I", 0x520),
            (0x1018, 2): struct.pack("<I", 0x402),
            (0x1017, 0): struct.pack("<H", 100),
            (0x6060, 0): b"\0",
            (0x6061, 0): b"\x0a",
            (0x6072, 0): struct.pack("<H", 1000),
            (0x6076, 0): struct.pack("<I", 80_000),
            (0x60FD, 0): struct.pack("<I", 0),
            (0x1400, 1): struct.pack("<I", 0x200 + node),
            (0x1400, 2): b"\x01",
            (0x1400, 5): struct.pack("<H", 0),
            (0x1800, 1): struct.pack("<I", 0x40000180 + node),
            (0x1800, 2): b"\x01",
            (0x1600, 0): b"\x01",
            (0x1A00, 0): b"\x02",
            **{(0x1600, sub): struct.pack("<I", 0x60400010) for sub in range(1, 9)},
            **{(0x1A00, sub): struct.pack("<I", 0x60410010) for sub in range(1, 9)},
        }

    def tpdo(self) -> bytes:
        return struct.pack("<Hih", self.statusword, self.speed_um_per_s, self.torque_per_mille)

    def sdo(self, request: bytes) -> bytes | None:
        command, index, sub = struct.unpack_from("<BHB", request)
        if not self.sdo_answers or command == 0x80:
            return None
        head = struct.pack("<HB", index, sub)
        data = self.objects.get((index, sub))
        if (index, sub) == (0x6041, 0):
            data = struct.pack("<H", self.statusword)
        if data is None:
            return b"\x80" + head + struct.pack("<I", 0x06020000)
        if command == 0x40:
            return bytes((0x43 | (4 - len(data)) << 2,)) + head + data.ljust(4, b"\0")
        assert command & 0xE3 == 0x23, f"only expedited downloads are expected, got {command:02X}h"
        if code := self.aborts.get((index, sub)):
            return b"\x80" + head + struct.pack("<I", code)
        written = request[4 : 8 - (command >> 2 & 3)]
        assert len(written) == len(data), f"{index:04X}h sub {sub} has {len(data)} bytes, {len(written)} written"
        self.writes.append((index, sub, written))
        if (index, sub) not in self.stubborn:
            self.objects[index, sub] = written
        return b"\x60" + head + bytes(4)


class Drives:
    """The other end of the bus. `frames` are all frames that the link sent."""

    def __init__(self, drives: list[Drive], **bus: Any) -> None:
        self.drives = {drive.node: drive for drive in drives}
        self.frames: list[tuple[int, bytes]] = []
        self._sent: set[tuple[int, bytes]] = set()
        self._bus = can.Bus(ignore_config=True, **bus)
        self._stop = threading.Event()
        self._thread: threading.Thread | None = None

    async def __aenter__(self) -> Self:
        try:
            asyncio.get_running_loop().add_reader(self._bus.fileno(), self._read)
        except NotImplementedError:
            self._thread = threading.Thread(target=self._run)
            self._thread.start()
        return self

    async def __aexit__(self, *_: object) -> None:
        if self._thread is None:
            asyncio.get_running_loop().remove_reader(self._bus.fileno())
        else:
            self._stop.set()
            self._thread.join()
        self._bus.shutdown()

    def send(self, cob_id: int, data: bytes) -> None:
        self._bus.send(can.Message(arbitration_id=cob_id, data=data, is_extended_id=False))

    def heartbeat(self, node: int, state: int = 5) -> None:
        self.send(0x700 + node, bytes((state,)))

    def _run(self) -> None:
        while not self._stop.is_set():
            message = self._bus.recv(0.01)
            if message is not None:
                self._on_frame(message.arbitration_id, bytes(message.data))

    def _read(self) -> None:
        while (message := self._bus.recv(0)) is not None:
            self._on_frame(message.arbitration_id, bytes(message.data))

    def _on_frame(self, cob_id: int, data: bytes) -> None:
        if 0x081 <= cob_id <= 0x1FF or 0x580 <= cob_id <= 0x5FF or cob_id >= 0x700:
            return  # our own, echoed
        self.frames.append((cob_id, data))
        node = cob_id & 0x7F
        if cob_id == 0x000:
            self._on_nmt(*data)
        elif cob_id == 0x080:
            for drive in self.drives.values():
                self.heartbeat(drive.node)
                for payload in drive.on_sync(drive):
                    self.send(0x180 + drive.node, payload)
        elif node in self.drives and cob_id >> 7 == 0x4:
            self.drives[node].rpdos.append(data)
        elif node in self.drives and cob_id >> 7 == 0xC and (answer := self.drives[node].sdo(data)):
            self.send(0x580 + node, answer)

    def _on_nmt(self, command: int, node: int) -> None:
        self.drives[node].nmt.append(command)
        if command == 1 and self.drives[node].starts:
            self.heartbeat(node)


# Modbus TCP

Script = Callable[[bytes, int, bytes], Awaitable[list[bytes] | None]]


class Registers:
    """Amplifier (unit 1, input registers) and PLC (unit 2, holding registers) on one raw TCP server.

    `script(transaction, unit, pdu)` may take over an answer: the chunks to send as they are, or None to leave it to
    the registers.
    """

    def __init__(self, channels: int = 2) -> None:
        self.amplifier = [0x5201, channels, 1, 0] + [0] * (12 + 4 * channels)
        self.plc = [0x5202, 0b0011] + [0] * 13
        self.requests: list[tuple[int, bytes]] = []
        self.connections = 0
        self.script: Script | None = None
        self.counts = True  #: the amplifier's sample counter moves
        self.echoes = True  #: the PLC echoes the life counter
        self.port = 0
        self._server: asyncio.Server | None = None
        self._writers: set[asyncio.StreamWriter] = set()

    async def __aenter__(self) -> "Registers":
        await self.start()
        return self

    async def start(self) -> None:
        self._server = await asyncio.start_server(self._serve, "127.0.0.1", self.port)
        self.port = self._server.sockets[0].getsockname()[1]

    async def __aexit__(self, *_: object) -> None:
        await self.stop()

    @property
    def connected(self) -> int:
        """Connections that are open."""
        return len(self._writers)

    async def stop(self) -> None:
        assert self._server is not None
        self._server.close()
        for writer in list(self._writers):
            writer.close()
        await until(lambda: not self._writers)
        await self._server.wait_closed()

    def tension(self, channel: int, value_n: float, status: int = 0) -> None:
        at = 16 + 4 * (channel - 1)
        self.amplifier[at : at + 3] = [*struct.unpack(">HH", struct.pack(">f", value_n)), status]

    async def _serve(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        self.connections += 1
        self._writers.add(writer)
        try:
            while True:
                head = await reader.readexactly(7)
                pdu = await reader.readexactly(struct.unpack(">H", head[4:6])[0] - 1)
                self.requests.append((head[6], pdu))
                chunks = await self.script(head[:2], head[6], pdu) if self.script else None
                if chunks is None:
                    chunks = [frame(head[:2], head[6], self.answer(head[6], pdu))]
                for chunk in chunks:
                    writer.write(chunk)
        except (asyncio.IncompleteReadError, ConnectionError):
            pass
        finally:
            writer.close()
            self._writers.discard(writer)

    def answer(self, unit: int, pdu: bytes) -> bytes:
        function = pdu[0]
        registers = self.amplifier if unit == 1 else self.plc
        if unit == 1 and self.counts:
            self.amplifier[3] = (self.amplifier[3] + 1) & 0xFFFF
        address, count = struct.unpack(">HH", pdu[1:5])
        if function == 16:
            registers[address : address + count] = struct.unpack(f">{count}H", pdu[6:])
            return pdu[:5]
        if function == 23:
            at, length = struct.unpack(">HH", pdu[5:9])
            registers[at : at + length] = struct.unpack(f">{length}H", pdu[10:])
            if self.echoes:
                registers[4] = registers[13]
        if function not in (3, 4, 23):
            return bytes((function | 0x80, 1))
        if address + count > len(registers):
            return bytes((function | 0x80, 2))
        return bytes((function, 2 * count)) + struct.pack(f">{count}H", *registers[address : address + count])


def frame(transaction: bytes, unit: int, pdu: bytes) -> bytes:
    return transaction + struct.pack(">HHB", 0, len(pdu) + 1, unit) + pdu
