"""A drive as a CANopen node: the objects of docs/devices/r2r-drive.md beside network management."""

from collections.abc import Mapping

from canopen.objectdictionary import ObjectDictionary
from canopen.sdo.exceptions import SdoAbortedError

from sim_plant.devices.drive import Drive, DriveSample
from sim_plant.faces.canopen_node import TellError
from sim_plant.faces.canopen_pdo import OUT_OF_RANGE, Key
from sim_plant.faces.canopen_sdo import Reader, Writer, drive_dictionary
from sim_plant.faces.words import speed_word, torque_word, watchdog_allowed

CYCLIC_SYNCHRONOUS_TORQUE = 10
NO_MODE = 0
QUICK_STOP_RAMP_THEN_OFF = 2
STO_ACTIVE = 1 << 16  #: in 60FDh
WATCHDOG_MS = range(10, 201)

_CONTROLWORD, _TARGET_TORQUE, _MODE = (0x6040, 0), (0x6071, 0), (0x6060, 0)


class DriveDevice:
    """The CANopen side of `drive`. See `canopen_node.Device`."""

    commands: Mapping[Key, str] = {_CONTROLWORD: "H", _TARGET_TORQUE: "h", _MODE: "b"}
    values: Mapping[Key, str] = {
        (0x603F, 0): "H",
        (0x6041, 0): "H",
        (0x6061, 0): "b",
        (0x606C, 0): "i",
        (0x6077, 0): "h",
        (0x60FD, 0): "I",
    }

    def __init__(self, drive: Drive) -> None:
        self._drive = drive
        self._sample = DriveSample(drive.statusword, 0.0, 0.0)  #: of the last SYNC
        self.readers: Mapping[Key, Reader] = {
            (0x603F, 0): lambda: drive.error_code,
            (0x6041, 0): lambda: drive.statusword,
            (0x6061, 0): lambda: drive.mode,
            (0x606C, 0): lambda: speed_word(self._sample.speed_m_per_s),
            (0x6072, 0): lambda: round(1e3 * drive.max_torque_nm / drive.rated_torque_nm),
            (0x6076, 0): lambda: round(1e3 * drive.rated_torque_nm),
            (0x6077, 0): lambda: torque_word(self._sample.torque_nm, drive.rated_torque_nm),
            (0x60FD, 0): lambda: STO_ACTIVE if drive.sto else 0,
        }
        self.writers: Mapping[Key, Writer] = {
            (0x1400, 5): self._set_watchdog,
            (0x605A, 0): _quick_stop_option,
            _MODE: _known_mode,
        }

    @property
    def dictionary(self) -> ObjectDictionary:
        return drive_dictionary()

    @property
    def error_code(self) -> int:
        return self._drive.error_code

    def tell_errors(self, to: TellError) -> None:
        self._drive.on_emergency = to
        self._drive.on_warning = to

    def reset(self) -> None:
        self._drive.watchdog_s = 0.0

    def set_operational(self, operational: bool, now_s: float) -> None:
        self._drive.poll(now_s)
        self._drive.operational = operational

    def lose_power(self, now_s: float) -> None:
        self._drive.lose_power(now_s)

    def command(self, values: Mapping[Key, int], now_s: float) -> bool:
        target_torque_nm = values[_TARGET_TORQUE] * 1e-3 * self._drive.rated_torque_nm
        self._drive.receive(values[_CONTROLWORD], target_torque_nm, values[_MODE], now_s)
        return True

    def sync(self, now_s: float) -> None:
        self._sample = self._drive.sync(now_s)

    def poll(self, now_s: float) -> None:
        """Nothing: a drive tells by itself what happens to it."""

    def _set_watchdog(self, time_ms: int) -> None:
        if not watchdog_allowed(time_ms, WATCHDOG_MS):
            raise SdoAbortedError(OUT_OF_RANGE)
        self._drive.watchdog_s = time_ms * 1e-3


def _known_mode(mode: int) -> None:
    if mode not in (NO_MODE, CYCLIC_SYNCHRONOUS_TORQUE):
        raise SdoAbortedError(OUT_OF_RANGE)


def _quick_stop_option(value: int) -> None:
    if value != QUICK_STOP_RAMP_THEN_OFF:
        raise SdoAbortedError(OUT_OF_RANGE)
