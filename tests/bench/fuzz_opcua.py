"""Fuzz targets on OPC UA: whole answers through the engine, and readings through the devices."""

import struct
from math import isfinite
from random import Random

from asyncua import ua
from asyncua.ua.ua_binary import struct_to_binary

from drivers.device_map import MAPS, load_map
from drivers.opcua.amplifier import Amplifier
from drivers.opcua.maps import LoadCellMap
from drivers.opcua.nodes import NodeTable, Reading
from drivers.opcua.services import Misfit, Services
from gateway.core.signals import Inputs, Quality
from tests.bench.fuzz_canopen import ACCEPTED, REFUSED, same
from tests.bench.fuzz_lines import CAPACITY_N, lines

READS = 4


class EngineAnswer:
    """The body of a ReadResponse with four Doubles, through `Services`, which decodes for the engine.

    The encoding of a good answer is fixed (OPC 10000-6, 5.2), so the oracle knows where its numbers are; of what has
    another layout it asks only that nothing is believed that is no Double.
    """

    name = "opcua read response"

    def __init__(self) -> None:
        self._services = Services([b"\0\1"] * READS, ["f64"] * READS)

    def valid(self, dice: Random) -> bytes:
        response = ua.ReadResponse()
        response.Results = [
            ua.DataValue(ua.Variant(dice.uniform(-100.0, 100.0), ua.VariantType.Double), StatusCode=None)
            for _ in range(READS)
        ]
        return struct_to_binary(response)

    def check(self, data: bytes) -> str:
        try:
            readings = self._services.readings(data, tuple(range(READS)))
        except Misfit:
            return REFUSED
        assert len(readings) == READS
        for reading in readings:
            # A value that is believed stands in the bytes as a Double, whole.
            assert not reading.good or struct.pack("<d", reading.value) in data, reading
        return ACCEPTED if all(reading.good for reading in readings) else REFUSED


class CellReadings:
    """Health, sample counter, then tension and status of six channels; packed as (u32 status, f64 value)."""

    name = "opcua load-cell readings"
    _each = struct.Struct("<Id")

    def __init__(self) -> None:
        device = load_map(MAPS / "r2r-opcua-amplifier.toml")
        assert isinstance(device, LoadCellMap)
        self._device = Amplifier(device, lines("opcua").load_cells, NodeTable())
        self._device.activate()
        self._inputs = Inputs(6)
        self._counters: set[float] = set()  #: one of them was the last that the driver took

    def valid(self, dice: Random) -> bytes:
        counter = float(dice.randrange(3) if dice.random() < 0.3 else dice.randrange(65536))
        readings = [(0, 1.0), (0, counter)]
        for _ in range(6):
            code = dice.choice((0, 0, 0, 0x40930000, 0x808C0000))
            readings += [(code, dice.uniform(-20.0, 110.0)), (0, float(dice.choice((0, 0, 0, 0, 1, 2, 3))))]
        return b"".join(self._each.pack(*reading) for reading in readings)

    def check(self, data: bytes) -> str:
        data = data[: 14 * self._each.size].ljust(14 * self._each.size, b"\x80")
        readings = tuple(Reading(*pair) for pair in self._each.iter_unpack(data))
        if not all(isfinite(reading.value) for reading in (readings[0], readings[1], *readings[3::2])):
            return REFUSED  # no engine makes such readings: these nodes are whole numbers
        self._device.fill(self._inputs, 0.0, readings)
        healthy, counter, *cells = self._each.iter_unpack(data)
        heard = _is_good(healthy[0]) and _is_good(counter[0])
        stands = heard and counter[1] in self._counters
        if heard:
            self._counters = {counter[1]}
        elif not _is_bad(healthy[0]) and not _is_bad(counter[0]):  # the driver may have taken it
            self._counters = {*self._counters, counter[1]}
        known = heard and int(healthy[1]) & 1
        good = 0
        for k in range(6):
            (code, tension_n), (status_code, status) = cells[2 * k], cells[2 * k + 1]
            inside = isfinite(tension_n) and abs(tension_n) <= CAPACITY_N and int(status) == 0
            believed = self._inputs.tension.quality[k] == Quality.GOOD
            if believed:
                bad = (healthy[0], counter[0], code, status_code)
                assert inside and not any(map(_is_bad, bad)), (cells[2 * k], cells[2 * k + 1])
                assert same(float(self._inputs.tension.value[k]), tension_n)
            elif known and not stands and _is_good(code) and _is_good(status_code):
                assert not inside, f"a good value was refused: {cells[2 * k]}"
            good += believed
        return ACCEPTED if good == 6 else REFUSED


def _is_good(status: int) -> bool:
    """What further bits make of a good value is the driver's to decide."""
    return status == 0


def _is_bad(status: int) -> bool:
    """Bad or uncertain (OPC 10000-4, 7.39.1)."""
    return status >> 30 != 0
