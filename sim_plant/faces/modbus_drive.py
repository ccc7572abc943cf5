"""The drive of one roller on Modbus, as docs/devices/r2r-drive-modbus.md describes it."""

import struct
from typing import NamedTuple

from sim_plant.devices.cia402 import CYCLIC_SYNCHRONOUS_TORQUE, State
from sim_plant.devices.drive import Drive
from sim_plant.faces.modbus_codec import (
    ILLEGAL_ADDRESS,
    ILLEGAL_VALUE,
    READ_HOLDING,
    READ_WRITE,
    WRITE_MANY,
    WRITE_ONE,
    Refused,
)
from sim_plant.faces.words import speed_word, torque_word, watchdog_allowed

DRIVE_ID = 0x5203
WATCHDOG_MS = range(10, 1001)

_COMMAND = range(10, 12)  #: controlword and target torque
_WATCHDOG = 23
_END = 24
_HEAD = struct.Struct(">HHihHH6x")
_SETTINGS = struct.Struct(">HHI12xIHH")


class AxisReading(NamedTuple):
    """What a drive shows, as numbers of the wire."""

    statusword: int
    speed_um_per_s: int
    torque_per_mille: int
    flags: int


class ModbusAxis:
    """A drive whose commands act at once, without a SYNC. It is ready for them from now on: Modbus has no NMT."""

    def __init__(self, drive: Drive) -> None:
        self.drive = drive
        drive.operational = True

    def set_watchdog(self, time_ms: int) -> None:
        """0, or one of WATCHDOG_MS. It acts from the next command on."""
        self.drive.watchdog_s = time_ms * 1e-3

    def command(self, controlword: int, torque_word: int, now_s: float) -> None:
        """Controlword and target torque, in 1/1000 of rated torque as an unsigned word, act now."""
        drive, before = self.drive, self.drive.state
        per_mille = torque_word - (torque_word >> 15 << 16)
        target_torque_nm = per_mille * 1e-3 * drive.rated_torque_nm
        drive.receive(controlword, target_torque_nm, CYCLIC_SYNCHRONOUS_TORQUE, now_s)
        drive.act(now_s)
        if before is State.FAULT and drive.state is not State.FAULT:
            # A fault reset ends the supervision until the next command; so does an interruption of operation, and
            # there is no torque then that it could take off.
            drive.operational = False
            drive.operational = True

    def reading(self, now_s: float) -> AxisReading:
        """What the drive shows now. To the recorder it is not there: only a command is."""
        drive = self.drive
        sample = drive.sample(now_s)
        return AxisReading(
            sample.statusword,
            speed_word(sample.speed_m_per_s),
            torque_word(sample.torque_nm, drive.rated_torque_nm),
            int(drive.sto),
        )

    @property
    def rated_torque_word(self) -> int:
        """mNm."""
        return round(1e3 * self.drive.rated_torque_nm)

    @property
    def max_torque_word(self) -> int:
        """1/1000 of rated torque."""
        return round(1e3 * self.drive.max_torque_nm / self.drive.rated_torque_nm)


class DriveRegisters:
    """Registers 0 to 9 tell, 10 and 11 command, 20 to 23 are settings."""

    functions = frozenset({READ_HOLDING, WRITE_ONE, WRITE_MANY, READ_WRITE})

    def __init__(self, axis: ModbusAxis) -> None:
        self._axis = axis
        self._command = (0, 0)
        self._watchdog_ms = 0

    def check_read(self, address: int, count: int) -> None:
        if address + count > _END:
            raise Refused(ILLEGAL_ADDRESS)

    def read(self, address: int, count: int, now_s: float) -> bytes:
        self.check_read(address, count)
        axis = self._axis
        shown = axis.reading(now_s)
        told = _HEAD.pack(
            DRIVE_ID,
            shown.statusword,
            shown.speed_um_per_s,
            shown.torque_per_mille,
            shown.flags,
            axis.drive.shown_code,
        )
        limits = axis.rated_torque_word, axis.max_torque_word
        settings = _SETTINGS.pack(*self._command, axis.drive.serial, *limits, self._watchdog_ms)
        return (told + settings)[2 * address : 2 * (address + count)]

    def write(self, address: int, values: tuple[int, ...], now_s: float) -> None:
        written = range(address, address + len(values))
        if written == range(_WATCHDOG, _WATCHDOG + 1):
            self._write_watchdog(values[0])
        elif written == _COMMAND:
            self._command = values[0], values[1]
            self._axis.command(*self._command, now_s)
        else:
            halves = written[0] in _COMMAND and written[-1] in _COMMAND
            raise Refused(ILLEGAL_VALUE if halves else ILLEGAL_ADDRESS)

    def _write_watchdog(self, time_ms: int) -> None:
        if not watchdog_allowed(time_ms, WATCHDOG_MS):
            raise Refused(ILLEGAL_VALUE)
        self._watchdog_ms = time_ms
        self._axis.set_watchdog(time_ms)
