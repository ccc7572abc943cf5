"""The rack: axes, load cells and line control behind one unit, as docs/devices/r2r-rack.md describes it."""

import struct
from collections.abc import Collection, Mapping

from sim_plant.devices.amplifier import Amplifier
from sim_plant.devices.line_plc import LinePlc
from sim_plant.faces.modbus_codec import (
    ILLEGAL_ADDRESS,
    ILLEGAL_VALUE,
    READ_HOLDING,
    READ_WRITE,
    WRITE_MANY,
    WRITE_ONE,
    Refused,
)
from sim_plant.faces.modbus_drive import WATCHDOG_MS, AxisReading, ModbusAxis
from sim_plant.faces.modbus_units import channel_words
from sim_plant.faces.words import (
    COMMAND_BITS,
    PLC_WATCHDOG_MS,
    RUN_BIT,
    UM_PER_M,
    WARNING_BIT,
    speed_word,
    status_word,
    watchdog_allowed,
)

RACK_ID = 0x5204
RACK_SERIAL = 0x52560000

_INPUTS = range(128)
_SERIAL = 120  #: behind the registers of 14 spans
_OUTPUTS = range(200, 232)
_SETTINGS = range(300, 305)
_LINE = range(200, 204)
_REQUEST = 201  #: with the register behind it
_FIRST_AXIS_COMMAND = 204
_LINE_WATCHDOG, _AXES_WATCHDOG = 300, 301

_HEAD = struct.Struct(">HHHiHHH")
_SPAN = struct.Struct(">HihHfH")
_LINE_COMMAND = struct.Struct(">HiH")
_LINE_WORDS = struct.Struct(">4H")
_LAST_SETTINGS = struct.Struct(">IH")
_NO_AXIS = AxisReading(0, 0, 0, 0)


class RackRegisters:
    """What is in the rack of a plant with so many spans: axes by roller, `cells` by span, both from 1, and the PLC.

    An axis or a line control that is not in it shows zeros and cannot be written; a load cell that is not in it is a
    broken wire.
    """

    functions = frozenset({READ_HOLDING, WRITE_ONE, WRITE_MANY, READ_WRITE})

    def __init__(
        self,
        spans: int,
        axes: Mapping[int, ModbusAxis],
        amplifier: Amplifier,
        cells: Collection[int],
        plc: LinePlc | None,
    ) -> None:
        self.serial = RACK_SERIAL
        self._spans = spans
        self._axes = dict(axes)
        self._amplifier = amplifier
        self._cells = frozenset(cells)
        self._plc = plc
        self._words = dict.fromkeys([*_OUTPUTS, _LINE_WATCHDOG, _AXES_WATCHDOG], 0)
        line = [*_LINE, _LINE_WATCHDOG] if plc else []
        self._axis_pairs = {_FIRST_AXIS_COMMAND + 2 * (roller - 1): axis for roller, axis in self._axes.items()}
        axis_words = [first + k for first in self._axis_pairs for k in (0, 1)] + [_AXES_WATCHDOG] * bool(axes)
        self._writable = frozenset([*line, *axis_words])

    def check_read(self, address: int, count: int) -> None:
        asked = range(address, address + count)
        if not any(asked[0] in block and asked[-1] in block for block in (_INPUTS, _OUTPUTS, _SETTINGS)):
            raise Refused(ILLEGAL_ADDRESS)

    def read(self, address: int, count: int, now_s: float) -> bytes:
        self.check_read(address, count)
        if address in _INPUTS:
            return self._inputs(now_s)[2 * address : 2 * (address + count)]
        if address in _OUTPUTS:
            return struct.pack(f">{count}H", *(self._words[k] for k in range(address, address + count)))
        first = address - _SETTINGS.start
        return self._settings()[2 * first : 2 * (first + count)]

    def write(self, address: int, values: tuple[int, ...], now_s: float) -> None:
        written = range(address, address + len(values))
        if not self._writable.issuperset(written):
            raise Refused(ILLEGAL_ADDRESS)
        pairs = [_REQUEST, *self._axis_pairs]
        if any((first in written) != (first + 1 in written) for first in pairs):
            raise Refused(ILLEGAL_VALUE)  # half a 32-bit speed is another speed, half an axis command another command
        after = self._words | dict(zip(written, values, strict=True))
        self._check(after)
        self._words = after
        self._act(written, now_s)

    def _check(self, words: Mapping[int, int]) -> None:
        if words[_LINE.start] & ~COMMAND_BITS:
            raise Refused(ILLEGAL_VALUE)
        for register, allowed in ((_LINE_WATCHDOG, PLC_WATCHDOG_MS), (_AXES_WATCHDOG, WATCHDOG_MS)):
            if not watchdog_allowed(words[register], allowed):
                raise Refused(ILLEGAL_VALUE)

    def _act(self, written: range, now_s: float) -> None:
        """What was written acts, the settings first."""
        words = self._words
        if self._plc is not None and _LINE_WATCHDOG in written:
            self._plc.watchdog_s = words[_LINE_WATCHDOG] * 1e-3
        if _AXES_WATCHDOG in written:
            for axis in self._axes.values():
                axis.set_watchdog(words[_AXES_WATCHDOG])
        for first, axis in self._axis_pairs.items():
            if first in written:
                axis.command(words[first], words[first + 1], now_s)
        if self._plc is not None and written[0] in _LINE:
            packed = _LINE_WORDS.pack(*(words[k] for k in _LINE))
            command, request_um_per_s, life = _LINE_COMMAND.unpack(packed)
            self._plc.warn(bool(command & WARNING_BIT), now_s)
            self._plc.command(bool(command & RUN_BIT), request_um_per_s / UM_PER_M, life, now_s)

    def _inputs(self, now_s: float) -> bytes:
        amplifier = self._amplifier
        line, speed_um_per_s, life = 0, 0, 0
        if self._plc is not None:
            status = self._plc.status(now_s)
            line, life = status_word(status), status.life_echo
            speed_um_per_s = speed_word(status.unwind_speed_m_per_s)
        counter = amplifier.counter(now_s)
        data = _HEAD.pack(RACK_ID, self._spans, line, speed_um_per_s, life, counter, amplifier.healthy)
        data += b"".join(self._span(number, now_s) for number in range(1, self._spans + 1))
        return data.ljust(2 * _SERIAL, b"\0") + struct.pack(">I12x", self.serial)

    def _span(self, number: int, now_s: float) -> bytes:
        axis = self._axes.get(number)
        shown = _NO_AXIS if axis is None else axis.reading(now_s)
        tension_n, status = channel_words(self._amplifier, number, number in self._cells, now_s)
        return _SPAN.pack(
            shown.statusword, shown.speed_um_per_s, shown.torque_per_mille, shown.flags, tension_n, status
        )

    def _settings(self) -> bytes:
        axis = next(iter(self._axes.values()), None)  # they are alike
        torques = (0, 0) if axis is None else (axis.rated_torque_word, axis.max_torque_word)
        watchdogs = struct.pack(">HH", self._words[_LINE_WATCHDOG], self._words[_AXES_WATCHDOG])
        return watchdogs + _LAST_SETTINGS.pack(*torques)
