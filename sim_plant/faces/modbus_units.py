"""The registers of load-cell amplifier and line PLC, as docs/devices/ describes them."""

import struct
from collections.abc import Collection
from math import nan

from sim_plant.devices.amplifier import Amplifier, ChannelStatus
from sim_plant.devices.line_plc import LinePlc
from sim_plant.faces.modbus_codec import (
    ILLEGAL_ADDRESS,
    ILLEGAL_VALUE,
    READ_HOLDING,
    READ_INPUT,
    READ_WRITE,
    WRITE_MANY,
    WRITE_ONE,
    Refused,
)
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

AMPLIFIER_ID = 0x5201
PLC_ID = 0x5202

_FIRST_CHANNEL = 16
_REGISTERS_PER_CHANNEL = 4
_AMPLIFIER_HEAD = struct.Struct(">4H16s8x")
_CHANNEL = struct.Struct(">fHH")

_COMMAND = range(10, 15)  #: the registers that can be written
_REQUEST = (11, 12)
_WATCHDOG = 14
_PLC_STATUS = struct.Struct(">HHiHI6x")
_PLC_COMMAND = struct.Struct(">HiHH")
_FIVE_WORDS = struct.Struct(">5H")


class AmplifierRegisters:
    """Read-only: the head, registers that are reserved up to the first channel, then four for each channel.

    To a channel that is not in `cells` (all, unless told otherwise) nothing is connected.
    """

    functions = frozenset({READ_HOLDING, READ_INPUT})

    def __init__(self, amplifier: Amplifier, cells: Collection[int] | None = None) -> None:
        self._amplifier = amplifier
        self._cells = frozenset(range(1, amplifier.channels + 1) if cells is None else cells)

    def check_read(self, address: int, count: int) -> None:
        if address + count > _FIRST_CHANNEL + _REGISTERS_PER_CHANNEL * self._amplifier.channels:
            raise Refused(ILLEGAL_ADDRESS)

    def read(self, address: int, count: int, now_s: float) -> bytes:
        self.check_read(address, count)
        first = max(0, address - _FIRST_CHANNEL) // _REGISTERS_PER_CHANNEL
        channels = max(0, address + count - _FIRST_CHANNEL + _REGISTERS_PER_CHANNEL - 1) // _REGISTERS_PER_CHANNEL
        data = b"".join(self._channel(c + 1, now_s) for c in range(first, channels))
        if address < _FIRST_CHANNEL:
            data, start = self._head(now_s) + data, 0
        else:
            start = _FIRST_CHANNEL + _REGISTERS_PER_CHANNEL * first
        return data[2 * (address - start) : 2 * (address - start + count)]

    def write(self, address: int, values: tuple[int, ...], now_s: float) -> None:
        raise Refused(ILLEGAL_ADDRESS)

    def _head(self, now_s: float) -> bytes:
        amplifier = self._amplifier
        counter, serial = amplifier.counter(now_s), str(amplifier.serial).encode()
        return _AMPLIFIER_HEAD.pack(AMPLIFIER_ID, amplifier.channels, amplifier.healthy, counter, serial)

    def _channel(self, channel: int, now_s: float) -> bytes:
        return _CHANNEL.pack(*channel_words(self._amplifier, channel, channel in self._cells, now_s), 0)


class PlcRegisters:
    """Registers 0 to 4 tell, 5 to 9 are reserved, 10 to 14 command. A write takes effect as a whole or not at all."""

    functions = frozenset({READ_HOLDING, WRITE_ONE, WRITE_MANY, READ_WRITE})

    def __init__(self, plc: LinePlc) -> None:
        self._plc = plc
        self._command = [0] * len(_COMMAND)

    def check_read(self, address: int, count: int) -> None:
        if address + count > _COMMAND.stop:
            raise Refused(ILLEGAL_ADDRESS)

    def read(self, address: int, count: int, now_s: float) -> bytes:
        self.check_read(address, count)
        data = self._status(now_s) + _FIVE_WORDS.pack(*self._command)
        return data[2 * address : 2 * (address + count)]

    def write(self, address: int, values: tuple[int, ...], now_s: float) -> None:
        written = range(address, address + len(values))
        if written[0] not in _COMMAND or written[-1] not in _COMMAND:
            raise Refused(ILLEGAL_ADDRESS)
        if (_REQUEST[0] in written) != (_REQUEST[1] in written):
            raise Refused(ILLEGAL_VALUE)  # half a 32-bit speed is another speed
        after = self._command.copy()
        for register, value in zip(written, values, strict=True):
            after[register - _COMMAND.start] = value
        command, request_um_per_s, life, watchdog_ms = _PLC_COMMAND.unpack(_FIVE_WORDS.pack(*after))
        if command & ~COMMAND_BITS or not watchdog_allowed(watchdog_ms, PLC_WATCHDOG_MS):
            raise Refused(ILLEGAL_VALUE)
        self._command = after
        self._plc.watchdog_s = watchdog_ms * 1e-3
        if address < _WATCHDOG:
            self._plc.warn(bool(command & WARNING_BIT), now_s)
            self._plc.command(bool(command & RUN_BIT), request_um_per_s / UM_PER_M, life, now_s)

    def _status(self, now_s: float) -> bytes:
        status = self._plc.status(now_s)
        speed = speed_word(status.unwind_speed_m_per_s)
        return _PLC_STATUS.pack(PLC_ID, status_word(status), speed, status.life_echo, self._plc.serial)


def channel_words(amplifier: Amplifier, channel: int, connected: bool, now_s: float) -> tuple[float, int]:
    """Tension in N and status of a channel. Without a load cell it shows a broken wire."""
    status = amplifier.status(channel) if connected else ChannelStatus.WIRE_BREAK
    broken = status is ChannelStatus.WIRE_BREAK
    return nan if broken else amplifier.tension_n(channel, now_s), int(status)
