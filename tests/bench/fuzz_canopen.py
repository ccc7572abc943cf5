"""Fuzz targets on CANopen. Each oracle reads the same bytes with struct, after the pages in docs/devices."""

import asyncio
import struct
from collections.abc import Callable, Coroutine
from math import isclose
from random import Random
from typing import Any, TypeVar

from drivers.canopen.amplifier import AmplifierNode
from drivers.canopen.maps import DriveMap, LoadCellMap, PlcMap
from drivers.canopen.pdo import MalformedPdo, PdoCodec
from drivers.canopen.plc import PlcNode
from drivers.canopen.sdo import SdoBus, SdoFailed
from drivers.canopen.station import Station
from drivers.device_map import MAPS, load_map
from gateway.core.signals import Inputs, Quality
from tests.bench.fuzz_lines import CAPACITY_N, RATED_NM, lines

T = TypeVar("T")

ACCEPTED, REFUSED = "accepted", "refused"
NODE = 3


def same(found: float, wanted: float) -> bool:
    return isclose(found, wanted, rel_tol=1e-9, abs_tol=1e-12)


class DriveTpdo:
    """TPDO1 of r2r-drive: u16 statusword, i32 um/s, i16 thousandths of rated torque."""

    name = "canopen drive TPDO"

    def __init__(self) -> None:
        device = load_map(MAPS / "cia402-torque.toml")
        assert isinstance(device, DriveMap)
        self._codec = PdoCodec(device, RATED_NM, 0.035)

    def valid(self, dice: Random) -> bytes:
        return struct.pack("<Hih", dice.choice((0x1237, 0x0650, 0x0631)), dice.randint(-(10**5), 10**5), 71)

    def check(self, data: bytes) -> str:
        try:
            sample = self._codec.decode(data)
        except MalformedPdo:
            assert len(data) != 8, "a whole PDO was refused"
            return REFUSED
        assert len(data) == 8, "a PDO of a wrong length was accepted"
        word, speed, torque = struct.unpack("<Hih", data)
        assert sample.statusword == word
        assert same(sample.speed_m_per_s, speed * 1e-6)
        assert same(sample.torque_nm, torque / 1000 * RATED_NM)
        return ACCEPTED


class CellTpdo:
    """A TPDO of r2r-cell-can: i16 tension in 0.01 N and u8 status, twice, then the u16 sample counter."""

    name = "canopen load-cell TPDO"
    cob_id = 0x180 + 101

    def __init__(self) -> None:
        device = load_map(MAPS / "r2r-cell-can.toml")
        assert isinstance(device, LoadCellMap)
        self._node = AmplifierNode(device, lines("canopen").load_cells[:2])
        answers = {0x2131: b"\x08", 0x2132: b"\x01", 0x6131: b"\0\0\x21\0", 0x6132: b"\x02"}

        def answer(can_id: int, request: bytes) -> bool:
            index, sub = struct.unpack_from("<HB", request, 1)
            data = answers.get(index) or self._mapped(index, sub)
            head = bytes((0x43 | (4 - len(data)) << 2,))
            bus.on_frame(0x580 + 101, head + request[1:4] + data.ljust(4, b"\0"), 0.0)
            return True

        bus = SdoBus(answer, [101])
        reasons = at_once(self._node.check(bus))
        assert not reasons, reasons
        self._node.station.on_heartbeat(b"\x05", 0.0)
        self._inputs = Inputs(6)
        self._counter: int | None = None

    def _mapped(self, index: int, sub: int) -> bytes:
        """The fixed mapping of the page."""
        entries = (0x71300110, 0x61500108, 0x71300210, 0x61500208, 0x21300010)
        if index & 0xFF00 == 0x1A00:
            return b"\x05" if sub == 0 else struct.pack("<I", entries[sub - 1])
        return struct.pack("<I", self.cob_id) if sub == 1 else b"\x01"

    def valid(self, dice: Random) -> bytes:
        status = dice.choice((0, 0, 0, 1, 2, 4, 8))
        counter = dice.randrange(4) if dice.random() < 0.3 else dice.randrange(65536)
        return struct.pack("<hBhBH", dice.randint(-3000, 12000), status, dice.randint(0, 6000), 0, counter)

    def check(self, data: bytes) -> str:
        self._node.begin_sync()
        inputs = self._inputs
        try:
            self._node.on_answer(self.cob_id, data)
        except MalformedPdo:
            assert len(data) != 8, "a whole PDO was refused"
            return REFUSED
        assert len(data) == 8, "a PDO of a wrong length was accepted"
        self._node.fill(inputs, 0.0, active=True)
        first, first_status, second, second_status, counter = struct.unpack("<hBhBH", data)
        stands, self._counter = counter == self._counter, counter
        good = 0
        for k, (counts, status) in enumerate(((first, first_status), (second, second_status))):
            tension_n = counts * 0.01
            usable = not stands and status == 0 and abs(tension_n) <= CAPACITY_N
            assert (inputs.tension.quality[k] == Quality.GOOD) == usable, (counts, status, inputs.tension.quality[k])
            assert not usable or same(float(inputs.tension.value[k]), tension_n)
            good += usable
        return ACCEPTED if good == 2 else REFUSED


class PlcTpdo:
    """TPDO1 of line-plc-can: u16 status, i32 um/s, u16 echo."""

    name = "canopen PLC TPDO"
    cob_id = 0x180 + 120

    def __init__(self) -> None:
        device = load_map(MAPS / "line-plc-can.toml")
        assert isinstance(device, PlcMap)
        self._node = PlcNode(device, lines("canopen").plc, 0.1)
        self._node.station.on_heartbeat(b"\x05", 0.0)
        self._inputs = Inputs(6)

    def valid(self, dice: Random) -> bytes:
        return struct.pack("<HiH", dice.randrange(16), dice.randint(-10, 120_000), dice.randrange(65536))

    def check(self, data: bytes) -> str:
        self._node.begin_sync()
        inputs = self._inputs
        try:
            self._node.on_answer(self.cob_id, data)
        except MalformedPdo:
            assert len(data) != 8, "a whole PDO was refused"
            return REFUSED
        assert len(data) == 8, "a PDO of a wrong length was accepted"
        self._node.fill(inputs, 0.0, active=True)
        status, speed, _ = struct.unpack("<HiH", data)
        assert inputs.plc.permissive == bool(status & 1)
        assert inputs.plc.emergency_stop == (not status & 2)
        assert inputs.plc.running == bool(status & 4)
        if inputs.unwind_speed.quality[0] != Quality.GOOD:
            assert abs(speed) > 50_000_000, "a usable speed was refused"
            return REFUSED
        assert same(float(inputs.unwind_speed.value[0]), speed * 1e-6) and abs(speed) <= 50_000_000
        return ACCEPTED


class Heartbeat:
    """One byte: the NMT state."""

    name = "canopen heartbeat"

    def __init__(self) -> None:
        device = load_map(MAPS / "cia402-torque.toml")
        assert isinstance(device, DriveMap)
        self._map = device

    def valid(self, dice: Random) -> bytes:
        return bytes((dice.choice((0x00, 0x04, 0x05, 0x7F)),))

    def check(self, data: bytes) -> str:
        station = Station("drive", NODE, self._map.heartbeat, watchdog=self._map.watchdog)
        station.on_heartbeat(b"\x05", 0.0)
        station.supervised = True
        try:
            station.on_heartbeat(data, 1.0)
        except ValueError:
            assert len(data) != 1, "a heartbeat was refused"
            assert station.heard_s == 0.0, "what was refused counts as life"
            return REFUSED
        assert len(data) == 1, "a heartbeat of a wrong length was accepted"
        assert station.nmt_state == data[0] & 0x7F
        assert bool(station.distrust) == (data[0] & 0x7F != 0x05), "a node that left operational is trusted"
        return ACCEPTED


class Emergency:
    """Eight bytes: u16 code, u8 error register, five bytes."""

    name = "canopen EMCY"

    def __init__(self) -> None:
        device = load_map(MAPS / "cia402-torque.toml")
        assert isinstance(device, DriveMap)
        self._map = device

    def valid(self, dice: Random) -> bytes:
        return struct.pack("<HB5x", dice.choice((0, 0x2310, 0x8250, 0x00FF, 0xFF01)), dice.randrange(256))

    def check(self, data: bytes) -> str:
        station = Station("drive", NODE, self._map.heartbeat)
        try:
            station.on_emergency(data)
        except ValueError:
            assert len(data) != 8, "an EMCY was refused"
            assert not station.emergency
            return REFUSED
        assert len(data) == 8, "an EMCY of a wrong length was accepted"
        code = struct.unpack_from("<H", data)[0]
        assert bool(station.emergency_told) == (code >= 0x100), station.emergency_told
        return ACCEPTED


class SdoAnswer:
    """The answer to the upload of one object, expedited; whatever else is asked then is aborted."""

    name = "canopen SDO answer"
    index, sub = 0x6076, 0x00

    def __init__(self) -> None:
        self._answer = b""
        self._bus = SdoBus(self._on_request, [NODE])

    def valid(self, dice: Random) -> bytes:
        command = dice.choice((0x43, 0x47, 0x4B, 0x4F, 0x42))
        return struct.pack("<BHBI", command, self.index, self.sub, dice.choice((0, 60_000, dice.getrandbits(32))))

    def _on_request(self, can_id: int, request: bytes) -> bool:
        answer, self._answer = self._answer, b""
        if answer:
            self._bus.on_frame(0x580 + NODE, answer, 0.0)
        # Behind what cannot be an answer, so that nobody waits for one in real time.
        self._bus.on_frame(0x580 + NODE, struct.pack("<BHBI", 0x80, self.index, self.sub, 0x08000000), 0.0)
        return True

    async def check(self, data: bytes) -> str:
        self._answer = data
        wanted = self._wanted(data)
        try:
            found = await self._bus.upload(NODE, self.index, self.sub, 4)
        except SdoFailed:
            assert wanted is None, f"a sound answer was refused: {data.hex()}"
            return REFUSED
        assert wanted is not None, f"{data.hex()} was accepted as {found.hex()}"
        assert found == wanted, f"{data.hex()}: {found.hex()}, not {wanted.hex()}"
        return ACCEPTED

    def _wanted(self, data: bytes) -> bytes | None:
        """CiA 301, 7.2.4.3.6; None for what is no expedited answer to this upload."""
        if len(data) != 8 or data[0] & 0xE2 != 0x42 or struct.unpack_from("<HB", data, 1) != (self.index, self.sub):
            return None
        return data[4 : 8 - (data[0] >> 2 & 3)] if data[0] & 1 else data[4:]


class AtOnceLoop(asyncio.SelectorEventLoop):
    """What is handed to a thread is done where it is handed over."""

    def run_in_executor(self, executor: Any, func: Callable[..., T], *args: Any) -> asyncio.Future[T]:
        done = self.create_future()
        try:
            done.set_result(func(*args))
        except Exception as error:
            done.set_exception(error)
        return done


def at_once(story: Coroutine[Any, Any, T]) -> T:
    """Run a coroutine, without threads."""
    with asyncio.Runner(loop_factory=AtOnceLoop) as runner:
        return runner.run(story)
