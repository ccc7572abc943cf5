"""The variables of docs/devices/r2r-opcua.md: what each says of its device, and what a write to it does.

Nothing here knows a server or a wire. All times are world time in seconds.
"""

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from enum import IntEnum
from math import isfinite
from typing import Protocol

from sim_plant.devices.amplifier import Amplifier, ChannelStatus
from sim_plant.devices.cia402 import CYCLIC_SYNCHRONOUS_TORQUE
from sim_plant.devices.drive import Drive
from sim_plant.devices.line_plc import LinePlc

AXIS_ID = 0x5205
AMPLIFIER_ID = 0x5206
LINE_ID = 0x5207

WATCHDOG_MS = range(10, 1001)

Scalar = bool | int | float


class Kind(IntEnum):
    """Data types of the variables; the value is the built-in type's number (OPC UA part 6, 5.1.2)."""

    BOOLEAN = 1
    UINT16 = 5
    UINT32 = 7
    DOUBLE = 11
    STRING = 12

    @property
    def zero(self) -> "Scalar | str":
        zeros: dict[Kind, Scalar | str] = {Kind.BOOLEAN: False, Kind.DOUBLE: 0.0, Kind.STRING: ""}
        return zeros.get(self, 0)


class Status(IntEnum):
    """Status codes that the variables give (OPC UA part 6, A.2)."""

    GOOD = 0x00000000
    UNCERTAIN_SENSOR_NOT_ACCURATE = 0x40930000
    BAD_SENSOR_FAILURE = 0x808C0000  #: there is no value
    BAD_NODE_ID_UNKNOWN = 0x80340000
    BAD_NOT_WRITABLE = 0x803B0000
    BAD_OUT_OF_RANGE = 0x803C0000
    BAD_WRITE_NOT_SUPPORTED = 0x80730000  #: a part of an array, a value that is said to be bad
    BAD_TYPE_MISMATCH = 0x80740000
    BAD_TRANSACTION_FAILED = 0x80F10000  #: would have been written, but something else in the request was refused

    @property
    def is_bad(self) -> bool:
        return self >= 0x80000000


_CELL_STATUS = {
    ChannelStatus.OK: Status.GOOD,
    ChannelStatus.OVERLOAD: Status.UNCERTAIN_SENSOR_NOT_ACCURATE,
    ChannelStatus.NOT_CALIBRATED: Status.UNCERTAIN_SENSOR_NOT_ACCURATE,
    ChannelStatus.WIRE_BREAK: Status.BAD_SENSOR_FAILURE,
}


class Device(Protocol):
    """An object below Objects, and what stands behind its variables."""

    name: str

    def variables(self) -> Sequence["Variable"]: ...

    def sample(self, now_s: float) -> None:
        """Take the device to `now_s` and measure: all its variables tell of this instant from now on."""
        ...

    def apply(self, written: Mapping[str, Scalar], now_s: float) -> None:
        """Let the values of one request act, all together. They have been checked."""
        ...


@dataclass(frozen=True, slots=True, eq=False)
class Variable:
    """One row of the table. `read` and `status` tell of the device's last sample."""

    device: Device
    name: str
    kind: Kind
    read: Callable[[], Scalar | str]
    unit: str = ""
    accepts: Callable[[Scalar], bool] | None = None  #: whether a written value is in range; None: read only
    status: Callable[[], Status] = lambda: Status.GOOD

    @property
    def node_name(self) -> str:
        return f"{self.device.name}.{self.name}"

    def check(self, kind: int, value: Scalar) -> Status:
        """Whether a value that came as a scalar of this data type may be written."""
        if self.accepts is None:
            return Status.BAD_NOT_WRITABLE
        if kind != self.kind:
            return Status.BAD_TYPE_MISMATCH
        return Status.GOOD if self.accepts(value) else Status.BAD_OUT_OF_RANGE


def devices_of(
    axes: Mapping[int, Drive], amplifier: Amplifier | None, cells: Sequence[int], plc: LinePlc | None
) -> list[Device]:
    """What stands behind one server. Numbers count from 1. Raises ValueError for a cell that the amplifier lacks."""
    devices: list[Device] = [_Axis(number, drive) for number, drive in axes.items()]
    channels = range(1, 1 + (amplifier.channels if amplifier else 0))
    if wrong := [number for number in cells if number not in channels]:
        raise ValueError(f"cells {wrong} have no amplifier channel: it has {len(channels)}, counted from 1")
    if amplifier is not None:
        devices.append(_Amplifier(amplifier))
        devices += [_Cell(number, amplifier) for number in cells]
    if plc is not None:
        devices.append(_Line(plc))
    return devices


def write(values: Iterable[tuple[Variable, Scalar]], now_s: float) -> None:
    """Let the values of one request act at one instant. They have been checked."""
    written: dict[Device, dict[str, Scalar]] = {}
    for variable, value in values:
        written.setdefault(variable.device, {})[variable.name] = value
    for device, of_device in written.items():
        device.apply(of_device, now_s)


def _any(value: Scalar) -> bool:
    return True


def _is_watchdog(value: Scalar) -> bool:
    return value == 0 or value in WATCHDOG_MS


class _Axis:
    """A drive whose watchdog is fed by changes of Life alone."""

    def __init__(self, number: int, drive: Drive) -> None:
        self.name = f"Axis{number}"
        self._drive = drive
        self._written: dict[str, Scalar] = {"Controlword": 0, "TargetTorque": 0.0, "Life": 0, "Watchdog": 0}
        drive.operational = True  # there is no network management: the drive listens from power-on
        self.sample(0.0)

    def variables(self) -> Sequence[Variable]:
        drive, written = self._drive, self._written
        return (
            Variable(self, "DeviceId", Kind.UINT32, lambda: AXIS_ID),
            Variable(self, "SerialNumber", Kind.STRING, lambda: str(drive.serial)),
            Variable(self, "Statusword", Kind.UINT16, lambda: self._sample.statusword),
            Variable(self, "Speed", Kind.DOUBLE, lambda: self._sample.speed_m_per_s, "m/s"),
            Variable(self, "Torque", Kind.DOUBLE, lambda: self._sample.torque_nm, "Nm"),
            Variable(self, "SafeTorqueOff", Kind.BOOLEAN, lambda: drive.sto),
            Variable(self, "ErrorCode", Kind.UINT16, lambda: drive.shown_code),
            Variable(self, "Controlword", Kind.UINT16, lambda: written["Controlword"], accepts=_any),
            Variable(self, "TargetTorque", Kind.DOUBLE, lambda: written["TargetTorque"], "Nm", accepts=isfinite),
            Variable(self, "Life", Kind.UINT16, lambda: written["Life"], accepts=_any),
            Variable(self, "Watchdog", Kind.UINT16, lambda: written["Watchdog"], "ms", accepts=_is_watchdog),
            Variable(self, "RatedTorque", Kind.DOUBLE, lambda: drive.rated_torque_nm, "Nm"),
            Variable(self, "MaxTorque", Kind.DOUBLE, lambda: drive.max_torque_nm, "Nm"),
        )

    def sample(self, now_s: float) -> None:
        self._sample = self._drive.sample(now_s)

    def apply(self, written: Mapping[str, Scalar], now_s: float) -> None:
        alive = written.get("Life", self._written["Life"]) != self._written["Life"]
        self._written |= written
        self._drive.watchdog_s = self._written["Watchdog"] * 1e-3
        if written.keys() == {"Watchdog"}:
            return
        controlword, torque_nm = int(self._written["Controlword"]), float(self._written["TargetTorque"])
        self._drive.receive(controlword, torque_nm, CYCLIC_SYNCHRONOUS_TORQUE, now_s, alive=alive)
        self._drive.sync(now_s)


class _Amplifier:
    name = "Amplifier"

    def __init__(self, amplifier: Amplifier) -> None:
        self._amplifier = amplifier
        self._counter = 0

    def variables(self) -> Sequence[Variable]:
        amplifier = self._amplifier
        return (
            Variable(self, "DeviceId", Kind.UINT32, lambda: AMPLIFIER_ID),
            Variable(self, "SerialNumber", Kind.STRING, lambda: str(amplifier.serial)),
            Variable(self, "Channels", Kind.UINT16, lambda: amplifier.channels),
            Variable(self, "SampleCounter", Kind.UINT16, lambda: self._counter),
            Variable(self, "Healthy", Kind.BOOLEAN, lambda: amplifier.healthy),
        )

    def sample(self, now_s: float) -> None:
        self._counter = self._amplifier.counter(now_s)

    def apply(self, written: Mapping[str, Scalar], now_s: float) -> None:
        raise TypeError("the amplifier is read only")


class _Cell:
    def __init__(self, number: int, amplifier: Amplifier) -> None:
        self.name = f"Cell{number}"
        self._number = number
        self._amplifier = amplifier
        self._tension_n = 0.0

    def variables(self) -> Sequence[Variable]:
        return (
            Variable(self, "Tension", Kind.DOUBLE, lambda: self._tension_n, "N", status=self._tension_status),
            Variable(self, "Status", Kind.UINT16, lambda: self._amplifier.status(self._number)),
        )

    def sample(self, now_s: float) -> None:
        self._tension_n = self._amplifier.tension_n(self._number, now_s)

    def apply(self, written: Mapping[str, Scalar], now_s: float) -> None:
        raise TypeError("the load cells are read only")

    def _tension_status(self) -> Status:
        return _CELL_STATUS[self._amplifier.status(self._number)]


class _Line:
    name = "Line"

    def __init__(self, plc: LinePlc) -> None:
        self._plc = plc
        self._written: dict[str, Scalar] = {
            "Run": False, "Warning": False, "SpeedRequest": 0.0, "Life": 0, "Watchdog": 0,
        }  # fmt: skip
        self.sample(0.0)

    def variables(self) -> Sequence[Variable]:
        written = self._written
        return (
            Variable(self, "DeviceId", Kind.UINT32, lambda: LINE_ID),
            Variable(self, "SerialNumber", Kind.UINT32, lambda: self._plc.serial),
            Variable(self, "Permissive", Kind.BOOLEAN, lambda: self._status.permissive),
            Variable(self, "EmergencyStopHealthy", Kind.BOOLEAN, lambda: not self._status.emergency_stop),
            Variable(self, "Running", Kind.BOOLEAN, lambda: self._status.running),
            Variable(self, "WatchdogTripped", Kind.BOOLEAN, lambda: self._status.watchdog_tripped),
            Variable(self, "Local", Kind.BOOLEAN, lambda: self._status.local),
            Variable(self, "UnwindSpeed", Kind.DOUBLE, lambda: self._status.unwind_speed_m_per_s, "m/s"),
            Variable(self, "LifeEcho", Kind.UINT16, lambda: self._status.life_echo),
            Variable(self, "Run", Kind.BOOLEAN, lambda: written["Run"], accepts=_any),
            Variable(self, "Warning", Kind.BOOLEAN, lambda: written["Warning"], accepts=_any),
            Variable(self, "SpeedRequest", Kind.DOUBLE, lambda: written["SpeedRequest"], "m/s", accepts=isfinite),
            Variable(self, "Life", Kind.UINT16, lambda: written["Life"], accepts=_any),
            Variable(self, "Watchdog", Kind.UINT16, lambda: written["Watchdog"], "ms", accepts=_is_watchdog),
        )

    def sample(self, now_s: float) -> None:
        self._status = self._plc.status(now_s)

    def apply(self, written: Mapping[str, Scalar], now_s: float) -> None:
        self._written |= written
        self._plc.poll(now_s)
        self._plc.watchdog_s = self._written["Watchdog"] * 1e-3
        if written.keys() != {"Watchdog"}:
            self._plc.warn(bool(self._written["Warning"]), now_s)
            run, request_m_per_s, life = (self._written[name] for name in ("Run", "SpeedRequest", "Life"))
            self._plc.command(bool(run), float(request_m_per_s), int(life), now_s)
