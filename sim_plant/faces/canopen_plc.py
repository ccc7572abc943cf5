"""The line PLC as a CANopen node: the objects of docs/devices/line-plc-can.md beside network management."""

from collections.abc import Callable, Mapping
from functools import cache

from canopen.objectdictionary import ObjectDictionary
from canopen.sdo.exceptions import SdoAbortedError

from sim_plant.devices.line_plc import LinePlc
from sim_plant.faces.canopen_objects import (
    add_fixed_pdo,
    add_members,
    add_object,
    communication_profile,
    transmit_cob_id,
)
from sim_plant.faces.canopen_pdo import OUT_OF_RANGE, Key
from sim_plant.faces.canopen_sdo import Reader, Writer
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

_STATUS, _SPEED, _ECHO = ((0x2000, k) for k in (1, 2, 3))
_COMMAND, _REQUEST, _LIFE = ((0x2001, k) for k in (1, 2, 3))


@cache
def plc_dictionary() -> ObjectDictionary:
    dictionary = communication_profile("line-plc-can", device_type=0, product=0x0401)
    add_members(dictionary, 0x2000, "Status", "HiH")
    add_members(dictionary, 0x2001, "Command", "HiH")
    add_object(dictionary, 0x2002, "Command watchdog", "H", "rw")
    add_fixed_pdo(dictionary, 0x1400, 0x200, [(_COMMAND, 16), (_REQUEST, 32), (_LIFE, 16)])
    add_fixed_pdo(dictionary, 0x1800, transmit_cob_id(0x180), [(_STATUS, 16), (_SPEED, 32), (_ECHO, 16)])
    return dictionary


class PlcDevice:
    """The CANopen side of `plc`. See `canopen_node.Device`."""

    commands: Mapping[Key, str] = {_COMMAND: "H", _REQUEST: "i", _LIFE: "H"}
    values: Mapping[Key, str] = {_STATUS: "H", _SPEED: "i", _ECHO: "H"}
    error_code = 0  #: nothing can fail in it but its wire

    def __init__(self, plc: LinePlc) -> None:
        self._plc = plc
        self._held: tuple[int, float, int] | None = None  #: command, request in m/s, life counter of the last RPDO
        self._request_m_per_s = 0.0  #: the last that took effect
        self._status = plc.status(0.0)
        self.readers: Mapping[Key, Reader] = {
            _STATUS: lambda: status_word(self._status),
            _SPEED: lambda: speed_word(self._status.unwind_speed_m_per_s),
            _ECHO: lambda: self._status.life_echo,
        }
        self.writers: Mapping[Key, Writer] = {(0x2002, 0): self._set_watchdog}

    @property
    def dictionary(self) -> ObjectDictionary:
        return plc_dictionary()

    def tell_errors(self, to: Callable[[int], None]) -> None:
        """There are none."""

    def reset(self) -> None:
        self._plc.watchdog_s = 0.0

    def set_operational(self, operational: bool, now_s: float) -> None:
        self._held = None
        if not operational:
            self._plc.warn(False, now_s)
            self._plc.command(False, self._request_m_per_s, self._status.life_echo, now_s)

    def lose_power(self, now_s: float) -> None:
        self.set_operational(False, now_s)

    def command(self, values: Mapping[Key, int], now_s: float) -> bool:
        if values[_COMMAND] & ~COMMAND_BITS:
            return False
        self._held = values[_COMMAND], values[_REQUEST] / UM_PER_M, values[_LIFE]
        return True

    def sync(self, now_s: float) -> None:
        if self._held is not None:
            command, self._request_m_per_s, life = self._held
            self._held = None
            self._plc.warn(bool(command & WARNING_BIT), now_s)
            self._plc.command(bool(command & RUN_BIT), self._request_m_per_s, life, now_s)
        self._status = self._plc.status(now_s)

    def poll(self, now_s: float) -> None:
        self._status = self._plc.status(now_s)

    def _set_watchdog(self, time_ms: int) -> None:
        if not watchdog_allowed(time_ms, PLC_WATCHDOG_MS):
            raise SdoAbortedError(OUT_OF_RANGE)
        self._plc.watchdog_s = time_ms * 1e-3
