"""Maps of Modbus TCP devices: which registers mean what."""

from typing import Annotated, Literal

from pydantic import Field, model_validator

from drivers.map_fields import (
    UNSEEN_POWER,
    Bit,
    Format,
    Range,
    SpeedUnit,
    TensionUnit,
    TimeUnit,
    TorqueAccuracy,
    TorqueFilter,
    TorqueUnit,
    WebSpeedUnit,
    refuse_together,
)
from drivers.map_rules import (
    UNSIGNED,
    base_problems,
    bit_problems,
    fit_problems,
    overlap_problems,
    range_problems,
    registers_of,
    type_problems,
)
from gateway.core.drive_tells import INVERTER_ACCURACY, TORQUE_FILTER_S
from gateway.core.line import Name, Positive, Strict
from gateway.core.wiring_proof import LONGEST_TEXT

MAX_READ_REGISTERS = 125
MAX_WRITE_REGISTERS = 121  #: of function 23; function 16 would take two more

RegisterType = Literal["u16", "i16", "u32", "i32", "f32"]
Address = Annotated[int, Field(ge=0, le=65536)]


class Register(Strict):
    address: Address
    type: RegisterType = "u16"


class RegisterCheck(Register):
    value: int  #: what a device of this type has there, in the bits of `mask`
    mask: Annotated[int, Field(ge=1)] | None = None  #: all bits where it is left out


class SerialRegister(Strict):
    address: Address
    type: Literal["u16", "u32", "u64", "text"] = "u16"  #: a text is ASCII, two characters a register
    registers: Annotated[int, Field(ge=1, le=LONGEST_TEXT // 2)] | None = None  #: of a text

    @property
    def count(self) -> int:
        return self.registers or {"u16": 1, "u32": 2, "u64": 4}[self.type]

    @model_validator(mode="after")
    def _length(self) -> "SerialRegister":
        wrong = (self.type == "text") != (self.registers is not None)
        return refuse_together(self, ["registers: a text needs it, a number has none"] if wrong else [])


class StatusRegister(Register):
    healthy: Bit


class SpeedRegister(Register):
    unit: WebSpeedUnit
    scale: Positive = 1.0
    range: Range


class TimeRegister(Register):
    unit: TimeUnit
    scale: Positive = 1.0
    range: Range

    def written(self) -> tuple[str, Range, float]:
        """What a time that is written must fit: type, range, scale."""
        return self.type, self.range, self.scale


class ChannelTension(Strict):
    offset: Annotated[int, Field(ge=0, le=MAX_READ_REGISTERS)]
    type: RegisterType
    unit: TensionUnit
    scale: Positive = 1.0


class ChannelStatus(Strict):
    offset: Annotated[int, Field(ge=0, le=MAX_READ_REGISTERS)]
    type: RegisterType = "u16"
    mask: Annotated[int, Field(ge=1)] | None = None  #: the bits that count; all where it is left out
    ok: int
    texts: dict[str, str] = {}  #: what the other values mean; keys are the values


class Channels(Strict):
    first: Address  #: where channel 1 begins
    stride: Annotated[int, Field(ge=1, le=MAX_READ_REGISTERS)]  #: registers from one channel to the next
    count: Annotated[int, Field(ge=1)]
    tension: ChannelTension
    status: ChannelStatus | None = None


class ModbusMap(Strict):
    """What every Modbus device type states. Addresses are as the manual prints them, counted from `address_base`."""

    format: Format
    protocol: Literal["modbus-tcp"]
    description: str
    address_base: Annotated[int, Field(ge=0, le=1)]
    word_order: Literal["high-first", "low-first"]
    read_function: Annotated[int, Field(ge=3, le=4)]
    function_23: bool = True  #: false: the device does not know it, and is written with 16 before it is read
    #: Devices of one family may share a unit identifier; they are exchanged in one transaction then.
    family: Name | None = None
    serial: SerialRegister | None = None  #: its serial number; without it nobody sees that it was exchanged

    def serial_problems(self, fields: dict[str, tuple[int, str]]) -> list[str]:
        """The serial number has registers of its own, like every field."""
        if (serial := self.serial) is None:
            return []
        end = serial.address + serial.count
        return base_problems({"serial": (serial.address, "")}, self.address_base) + [
            f"serial.address: {serial.address} overlaps {name}"
            for name, (address, kind) in fields.items()
            if address < end and serial.address < address + registers_of(kind)
        ]


class LoadCellMap(ModbusMap):
    role: Literal["load-cell"]
    device_id: RegisterCheck | None = None  #: without it another device at this address is not found out
    channel_count: Register | None = None  #: without it a channel that the device lacks is found by its exception
    status: StatusRegister | None = None
    sample_counter: Register | None = None  #: without it the link cannot tell a frozen device from a steady web
    channels: Channels

    @model_validator(mode="after")
    def _layout(self) -> "LoadCellMap":
        fields: dict[str, tuple[int, str]] = {
            name: (register.address, register.type)
            for name in ("device_id", "channel_count", "status", "sample_counter")
            if (register := getattr(self, name)) is not None
        }
        channels = self.channels
        inside = {"channels.tension": (channels.tension.offset, channels.tension.type)}
        if channels.status is not None:
            inside["channels.status"] = (channels.status.offset, channels.status.type)
        problems = overlap_problems(fields) + overlap_problems(inside) + base_problems(fields, self.address_base)
        problems += self.serial_problems(fields)
        for name, (offset, kind) in inside.items():
            if offset + registers_of(kind) > channels.stride:
                problems.append(f"{name}.offset: {offset} does not fit channels.stride {channels.stride}")
        end = channels.first + channels.stride * channels.count
        for name, (_, kind) in fields.items():
            problems += type_problems(name, kind, UNSIGNED)
        if self.status is not None:
            problems += bit_problems("status.healthy", self.status.healthy.bit, self.status.type)
        if channels.status is not None:
            problems += type_problems("channels.status", channels.status.type, UNSIGNED)
        for name, (address, kind) in fields.items():
            if address < end and channels.first < address + registers_of(kind):
                problems.append(f"{name}.address: {address} overlaps channels ({channels.first} to {end - 1})")
        return refuse_together(self, problems)


class PlcRead(Strict):
    status: Register
    permissive: Bit
    emergency_stop: Bit  #: yes: the emergency stop circuit is open
    running: Bit
    watchdog_tripped: Bit
    local: Bit | None = None  #: yes: the line is not started from elsewhere
    speed: SpeedRegister
    life_echo: Register


class PlcWrite(Strict):
    command: Register
    run: Bit
    warning: Bit | None = None  #: lamp and horn before anything moves
    speed: SpeedRegister
    life: Register


class PlcMap(ModbusMap):
    role: Literal["line-plc"]
    device_id: RegisterCheck
    read: PlcRead
    write: PlcWrite
    watchdog: TimeRegister

    @model_validator(mode="after")
    def _layout(self) -> "PlcMap":
        written = _register_fields("write", self.write)
        fields = {"device_id": (self.device_id.address, self.device_id.type)}
        fields |= {"watchdog": (self.watchdog.address, self.watchdog.type)}
        fields |= _register_fields("read", self.read) | written
        problems = overlap_problems(fields) + base_problems(fields, self.address_base)
        problems += _side_by_side("write", written) + self.serial_problems(fields)
        if self.read_function != 3:
            problems.append(f"read_function: {self.read_function}; allowed: 3, the registers that function 23 reads")
        problems += _plc_type_problems(self)
        problems += range_problems("read.speed", self.read.speed.range)
        problems += range_problems("write.speed", self.write.speed.range)
        problems += range_problems("watchdog", self.watchdog.range) + fit_problems("watchdog", *self.watchdog.written())
        return refuse_together(self, problems)


def _plc_type_problems(device: PlcMap) -> list[str]:
    read, write = device.read, device.write
    problems = type_problems("device_id", device.device_id.type, UNSIGNED)
    problems += type_problems("read.status", read.status.type, UNSIGNED)
    problems += type_problems("read.life_echo", read.life_echo.type, UNSIGNED)
    problems += type_problems("write.command", write.command.type, UNSIGNED)
    problems += type_problems("write.life", write.life.type, UNSIGNED)
    problems += bit_problems("write.run", write.run.bit, write.command.type)
    if write.warning is not None:
        problems += bit_problems("write.warning", write.warning.bit, write.command.type)
    for name in ("permissive", "emergency_stop", "running", "watchdog_tripped", "local"):
        if (entry := getattr(read, name)) is not None:
            problems += bit_problems(f"read.{name}", entry.bit, read.status.type)
    return problems


def _register_fields(key: str, table: Strict) -> dict[str, tuple[int, str]]:
    return {f"{key}.{name}": (field.address, field.type) for name, field in table if isinstance(field, Register)}


class ReadTorque(Register):
    unit: TorqueUnit
    scale: Positive = 1.0


class RollerSpeed(Register):
    unit: SpeedUnit
    scale: Positive = 1.0


class FlagRegister(Register, Bit):
    """One bit of a register."""


class ErrorCode(Register):
    texts: dict[str, str] = {}  #: what its values mean; keys are the values


class MaxTorque(ReadTorque):
    writable: bool  #: true: set to the line's limit; false: the drive's own, which must allow the line's limit


class ModeRegister(Register):
    shown: Literal["always", "enabled"] = "always"  #: "enabled": it displays 0 as long as it is not enabled


class DriveRead(Strict):
    statusword: Register
    speed: RollerSpeed
    torque: ReadTorque
    safe_torque_off: FlagRegister | None = None
    error_code: ErrorCode | None = None  #: of a fault, or of a warning
    mode_displayed: ModeRegister | None = None  #: its mode of operation, where it has several


class DriveWrite(Strict):
    controlword: Register
    target_torque: ReadTorque


class Axes(Strict):
    """Of a device with several: where each is, from the first, whose addresses the map gives."""

    count: Annotated[int, Field(ge=1)]
    read_stride: Annotated[int, Field(ge=1, le=MAX_READ_REGISTERS)]  #: registers of `read` from one axis to the next
    write_stride: Annotated[int, Field(ge=1, le=MAX_WRITE_REGISTERS)]  #: the same of `write`


class DriveMap(ModbusMap):
    role: Literal["drive"]
    device_id: RegisterCheck
    follows_command: Bit | None = None  #: of the statusword: the target torque is followed, not ignored
    voltage_enabled: Bit | None = None  #: of the statusword: the power stage is supplied, whether it is on or off
    torque_mode: int | None = None  #: what `read.mode_displayed` shows while torques are followed
    torque_accuracy: TorqueAccuracy = INVERTER_ACCURACY
    torque_filter_s: TorqueFilter = TORQUE_FILTER_S
    read: DriveRead
    write: DriveWrite
    axes: Axes | None = None
    axis_count: Register | None = None  #: how many axes the device has
    rated_torque: ReadTorque | None = None  #: compared with the line's file when it is there
    max_torque: MaxTorque
    watchdog: TimeRegister

    @property
    def speed(self) -> RollerSpeed:
        """The roller's."""
        return self.read.speed

    @property
    def unseen(self) -> list[str]:
        """What its answers do not tell, as far as this map says, each with the key that would."""
        return [] if self.voltage_enabled is not None else [UNSEEN_POWER]

    @property
    def torques(self) -> tuple[ReadTorque, ReadTorque]:
        """What it reports, and what it is asked for."""
        return self.read.torque, self.write.target_torque

    @property
    def mode(self) -> int | None:
        """The mode of operation in which torques are followed; None: it has but one."""
        return self.torque_mode

    @model_validator(mode="after")
    def _layout(self) -> "DriveMap":
        read, write = _register_fields("read", self.read), _register_fields("write", self.write)
        fields = {
            name: (register.address, register.type)
            for name in ("device_id", "axis_count", "rated_torque", "max_torque", "watchdog")
            if (register := getattr(self, name)) is not None
        }
        everything = fields | read | write
        problems = overlap_problems(_apart(everything)) + base_problems(everything, self.address_base)
        problems += _side_by_side("write", write) + self.serial_problems(everything)
        problems += _drive_type_problems(self) + _axes_problems(self, read, write)
        problems += range_problems("watchdog", self.watchdog.range) + fit_problems("watchdog", *self.watchdog.written())
        return refuse_together(self, problems)


def _apart(fields: dict[str, tuple[int, str]]) -> dict[str, tuple[int, str]]:
    """Without the flags: several may be bits of one register, and of the statusword."""
    return {name: field for name, field in fields.items() if name != "read.safe_torque_off"}


def _side_by_side(key: str, fields: dict[str, tuple[int, str]]) -> list[str]:
    first = min(address for address, _ in fields.values())
    last = max(address + registers_of(kind) for address, kind in fields.values())
    if last - first == sum(registers_of(kind) for _, kind in fields.values()):
        return []
    return [f"{key}: the registers must lie side by side, they are written in one request"]


def _drive_type_problems(device: DriveMap) -> list[str]:
    read = device.read
    problems = type_problems("read.statusword", read.statusword.type, ("u16",))
    problems += type_problems("write.controlword", device.write.controlword.type, ("u16",))
    problems += type_problems("write.target_torque", device.write.target_torque.type, ("i16", "i32", "f32"))
    problems += type_problems("device_id", device.device_id.type, UNSIGNED)
    if device.axis_count is not None:
        problems += type_problems("axis_count", device.axis_count.type, UNSIGNED)
    if (sto := read.safe_torque_off) is not None:
        problems += type_problems("read.safe_torque_off", sto.type, UNSIGNED)
        problems += bit_problems("read.safe_torque_off", sto.bit, sto.type)
    if read.error_code is not None:
        problems += type_problems("read.error_code", read.error_code.type, UNSIGNED)
        problems += [
            f"read.error_code.texts: {key!r} is no number" for key in read.error_code.texts if not _is_number(key)
        ]
    for key, bit in (("follows_command", device.follows_command), ("voltage_enabled", device.voltage_enabled)):
        if bit is not None:
            problems += bit_problems(key, bit.bit, "u16")
    if (read.mode_displayed is None) != (device.torque_mode is None):
        problems.append("torque_mode: goes with read.mode_displayed; allowed: both or none")
    if read.mode_displayed is not None:
        problems += type_problems("read.mode_displayed", read.mode_displayed.type, ("u16", "i16"))
    rated = device.rated_torque
    if rated is not None and rated.unit == "rated torque":
        problems.append("rated_torque.unit: 'rated torque' of itself says nothing; allowed: Nm, mNm")
    return problems


def _is_number(text: str) -> bool:
    try:
        int(text, 0)
    except ValueError:
        return False
    return True


def _axes_problems(device: DriveMap, read: dict[str, tuple[int, str]], write: dict[str, tuple[int, str]]) -> list[str]:
    axes = device.axes
    if axes is None:
        return []
    problems: list[str] = []
    for key, fields, stride in (("read", read, axes.read_stride), ("write", write, axes.write_stride)):
        first = min(address for address, _ in fields.values())
        extent = max(address + registers_of(kind) for address, kind in fields.values()) - first
        if extent > stride:
            problems.append(f"axes.{key}_stride: {stride}; `{key}` takes {extent} registers of an axis")
    return problems
