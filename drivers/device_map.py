"""What a device map may say, and its loader: everything a link must know of a device type, as data.

One TOML file a device type in `drivers/maps`. Strict: unknown keys, wrong types, units of the wrong quantity,
fields that overlap and PDOs that do not fit a frame are refused, all at once, each with file, key, what is
allowed and the nearest valid thing. Numbers in a map are in the device's own unit; `scaling` makes SI of them.
"""

import tomllib
from pathlib import Path
from typing import Annotated, Literal, TypeVar

from pydantic import Field, ValidationError, model_validator

from drivers.map_errors import MapRefused, reasons_of
from drivers.map_rules import (
    BYTES,
    INTEGERS,
    UNSIGNED,
    base_problems,
    bit_problems,
    fit_problems,
    overlap_problems,
    range_problems,
    registers_of,
    type_problems,
)
from gateway.core.line import Positive, Strict

SpeedUnit = Literal["m/s", "mm/s", "um/s", "m/min", "rad/s", "rpm", "mrpm"]
WebSpeedUnit = Literal["m/s", "mm/s", "um/s", "m/min"]  #: where there is no roller to convert an angular speed with
TorqueUnit = Literal["rated torque", "Nm", "mNm"]  #: "rated torque" is the drive's own, from the line's file
TensionUnit = Literal["N", "mN", "kN"]
TimeUnit = Literal["s", "ms"]
Range = Annotated[list[float], Field(min_length=2, max_length=2)]  #: lowest and highest, in the unit of the field
Format = Annotated[int, Field(ge=1, le=1)]  # not Literal, which takes `true` and 1.0 for 1
Bits = Annotated[int, Field(ge=0, le=31)]

M = TypeVar("M", bound=Strict)
MAX_PDO_BYTES = 8
MAX_READ_REGISTERS = 125

MAPS = Path(__file__).parent / "maps"  #: one file a device type


class Bit(Strict):
    bit: Bits
    inverted: bool = False  #: true where 0 means yes


# CANopen drives


class CanObject(Strict):
    index: Annotated[int, Field(ge=0x1000, le=0xFFFF)]
    sub: Annotated[int, Field(ge=0, le=254)] = 0
    type: Literal["u8", "i8", "u16", "i16", "u32", "i32", "f32"]


class SpeedObject(CanObject):
    unit: SpeedUnit
    scale: Positive = 1.0


class TorqueObject(CanObject):
    unit: TorqueUnit
    scale: Positive = 1.0


class TimeObject(CanObject):
    unit: TimeUnit
    scale: Positive = 1.0
    range: Range


class HeartbeatObject(TimeObject):
    value: Positive  #: the producer time to set, in the unit of the object


class SafeTorqueOff(CanObject, Bit):
    """Where the drive says that its hard-wired safe torque off is active."""


class MaxTorqueObject(TorqueObject):
    writable: bool  #: true: set to the line's limit; false: the drive's own, which must allow the line's limit


class DriveObjects(Strict):
    """The objects of CiA 402 cyclic synchronous torque, wherever the device keeps them."""

    controlword: CanObject
    statusword: CanObject
    mode: CanObject
    target_torque: TorqueObject
    torque: TorqueObject
    speed: SpeedObject
    max_torque: MaxTorqueObject
    rated_torque: TorqueObject | None = None  #: compared with the line's file when it is there
    safe_torque_off: SafeTorqueOff | None = None


PdoEntry = Literal["controlword", "statusword", "mode", "target_torque", "torque", "speed", "safe_torque_off"]


class Pdo(Strict):
    communication: Annotated[int, Field(ge=0x1400, le=0x19FF)]  #: index of the communication record
    mapping: Annotated[int, Field(ge=0x1600, le=0x1BFF)]  #: index of the mapping record
    cob_id: Annotated[int, Field(ge=0x180, le=0x500)]  #: of node 0; the node's number is added
    objects: Annotated[list[PdoEntry], Field(min_length=1, max_length=8)]


class CanIdentity(Strict):
    vendor_id: Annotated[int, Field(ge=0, le=0xFFFFFFFF)]
    product_code: Annotated[int, Field(ge=0, le=0xFFFFFFFF)]


class DriveMap(Strict):
    format: Format
    protocol: Literal["canopen"]
    role: Literal["drive"]
    description: str
    cyclic_torque_mode: Annotated[int, Field(ge=-128, le=127)]
    follows_command: Bit | None = None  #: of the statusword: the target torque is followed, not ignored
    identity: CanIdentity
    objects: DriveObjects
    receive_pdo: Pdo
    transmit_pdo: Pdo
    watchdog: TimeObject
    heartbeat: HeartbeatObject

    @model_validator(mode="after")
    def _layout(self) -> "DriveMap":
        problems = _pdo_problems("receive_pdo", self.receive_pdo, self.objects, {"controlword", "target_torque"})
        problems += _pdo_problems("transmit_pdo", self.transmit_pdo, self.objects, {"statusword", "speed", "torque"})
        spans: dict[tuple[int, int], str] = {}
        for name, entry in self.objects:
            if entry is not None and (other := spans.setdefault((entry.index, entry.sub), name)) != name:
                problems.append(f"objects.{name}: {entry.index:04X}h sub {entry.sub} is already objects.{other}")
        problems += _drive_type_problems(self.objects)
        if self.follows_command is not None:
            problems += bit_problems("follows_command", self.follows_command.bit, "u16")
        problems += range_problems("watchdog", self.watchdog.range) + fit_problems("watchdog", *_time(self.watchdog))
        problems += range_problems("heartbeat", self.heartbeat.range) + fit_problems(
            "heartbeat", *_time(self.heartbeat)
        )
        low, high = self.heartbeat.range
        if not low <= self.heartbeat.value <= high:
            problems.append(f"heartbeat.value: {self.heartbeat.value} is outside heartbeat.range [{low}, {high}]")
        return _refuse_together(self, problems)


def _drive_type_problems(objects: DriveObjects) -> list[str]:
    problems = type_problems("objects.controlword", objects.controlword.type, ("u16",))
    problems += type_problems("objects.statusword", objects.statusword.type, ("u16",))
    problems += type_problems("objects.mode", objects.mode.type, ("i8",))
    if (sto := objects.safe_torque_off) is not None:
        problems += type_problems("objects.safe_torque_off", sto.type, INTEGERS)
        problems += bit_problems("objects.safe_torque_off", sto.bit, sto.type)
    rated = objects.rated_torque
    if rated is not None and rated.unit == "rated torque":
        problems.append("objects.rated_torque.unit: 'rated torque' of itself says nothing; allowed: Nm, mNm")
    return problems


def _pdo_problems(key: str, pdo: Pdo, objects: DriveObjects, needed: set[str]) -> list[str]:
    problems: list[str] = []
    if missing := sorted(needed - set(pdo.objects)):
        problems.append(f"{key}.objects: lacks {', '.join(missing)}")
    if twice := sorted({name for name in pdo.objects if pdo.objects.count(name) > 1}):
        problems.append(f"{key}.objects: {', '.join(twice)} listed twice")
    entries = {name: getattr(objects, name) for name in pdo.objects}
    if undefined := [name for name, entry in entries.items() if entry is None]:
        problems.append(f"{key}.objects: {', '.join(undefined)} is not defined in objects")
    size = sum(BYTES[entry.type] for entry in entries.values() if entry is not None)
    if size > MAX_PDO_BYTES:
        problems.append(f"{key}.objects: {size} bytes; a PDO carries at most {MAX_PDO_BYTES}")
    return problems


# Modbus TCP devices

RegisterType = Literal["u16", "i16", "u32", "i32", "f32"]
Address = Annotated[int, Field(ge=0, le=65536)]


class Register(Strict):
    address: Address
    type: RegisterType = "u16"


class RegisterCheck(Register):
    value: int  #: what a device of this type has there


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


class ChannelTension(Strict):
    offset: Annotated[int, Field(ge=0, le=MAX_READ_REGISTERS)]
    type: RegisterType
    unit: TensionUnit
    scale: Positive = 1.0


class ChannelStatus(Strict):
    offset: Annotated[int, Field(ge=0, le=MAX_READ_REGISTERS)]
    type: RegisterType = "u16"
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
    device_id: RegisterCheck


class LoadCellMap(ModbusMap):
    role: Literal["load-cell"]
    channel_count: Register
    status: StatusRegister
    sample_counter: Register
    channels: Channels

    @model_validator(mode="after")
    def _layout(self) -> "LoadCellMap":
        fields: dict[str, tuple[int, str]] = {
            name: (getattr(self, name).address, getattr(self, name).type)
            for name in ("device_id", "channel_count", "status", "sample_counter")
        }
        channels = self.channels
        inside = {"channels.tension": (channels.tension.offset, channels.tension.type)}
        if channels.status is not None:
            inside["channels.status"] = (channels.status.offset, channels.status.type)
        problems = overlap_problems(fields) + overlap_problems(inside) + base_problems(fields, self.address_base)
        for name, (offset, kind) in inside.items():
            if offset + registers_of(kind) > channels.stride:
                problems.append(f"{name}.offset: {offset} does not fit channels.stride {channels.stride}")
        end = channels.first + channels.stride * channels.count
        for name, (_, kind) in fields.items():
            problems += type_problems(name, kind, UNSIGNED)
        problems += bit_problems("status.healthy", self.status.healthy.bit, self.status.type)
        if channels.status is not None:
            problems += type_problems("channels.status", channels.status.type, UNSIGNED)
        for name, (address, kind) in fields.items():
            if address < end and channels.first < address + registers_of(kind):
                problems.append(f"{name}.address: {address} overlaps channels ({channels.first} to {end - 1})")
        return _refuse_together(self, problems)


class PlcRead(Strict):
    status: Register
    permissive: Bit
    emergency_stop: Bit  #: yes: the emergency stop circuit is open
    running: Bit
    watchdog_tripped: Bit
    speed: SpeedRegister
    life_echo: Register


class PlcWrite(Strict):
    command: Register
    run: Bit
    speed: SpeedRegister
    life: Register


class PlcMap(ModbusMap):
    role: Literal["line-plc"]
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
        first = min(address for address, _ in written.values())
        last = max(address + registers_of(kind) for address, kind in written.values())
        if last - first != sum(registers_of(kind) for _, kind in written.values()):
            problems.append("write: the registers must lie side by side, they are written in one request")
        if self.read_function != 3:
            problems.append(f"read_function: {self.read_function}; allowed: 3, the registers that function 23 reads")
        problems += _plc_type_problems(self)
        problems += range_problems("read.speed", self.read.speed.range)
        problems += range_problems("write.speed", self.write.speed.range)
        problems += range_problems("watchdog", self.watchdog.range) + fit_problems("watchdog", *_time(self.watchdog))
        return _refuse_together(self, problems)


def _plc_type_problems(device: PlcMap) -> list[str]:
    read, write = device.read, device.write
    problems = type_problems("device_id", device.device_id.type, UNSIGNED)
    problems += type_problems("read.status", read.status.type, UNSIGNED)
    problems += type_problems("read.life_echo", read.life_echo.type, UNSIGNED)
    problems += type_problems("write.command", write.command.type, UNSIGNED)
    problems += type_problems("write.life", write.life.type, UNSIGNED)
    problems += bit_problems("write.run", write.run.bit, write.command.type)
    for name in ("permissive", "emergency_stop", "running", "watchdog_tripped"):
        problems += bit_problems(f"read.{name}", getattr(read, name).bit, read.status.type)
    return problems


def _register_fields(key: str, table: Strict) -> dict[str, tuple[int, str]]:
    return {f"{key}.{name}": (field.address, field.type) for name, field in table if isinstance(field, Register)}


def _time(entry: TimeObject | TimeRegister) -> tuple[str, Range, float]:
    return entry.type, entry.range, entry.scale


def _refuse_together(model: M, problems: list[str]) -> M:
    if problems:
        raise ValueError("\n".join(problems))
    return model


# Loading

DeviceMap = DriveMap | LoadCellMap | PlcMap
MODELS: dict[tuple[str, str], type[DriveMap] | type[LoadCellMap] | type[PlcMap]] = {
    ("canopen", "drive"): DriveMap,
    ("modbus-tcp", "load-cell"): LoadCellMap,
    ("modbus-tcp", "line-plc"): PlcMap,
}


def map_names(folder: Path = MAPS) -> list[str]:
    """The names that `map` may have in a line's file."""
    return sorted(path.stem for path in folder.glob("*.toml"))


def load_map(path: Path) -> DeviceMap:
    """The device map in `path`. Raises MapRefused with every reason."""
    try:
        document = tomllib.loads(path.read_text(encoding="utf-8"))
    except (OSError, UnicodeDecodeError, tomllib.TOMLDecodeError) as error:
        raise MapRefused([f"{path.name}: cannot be read: {error}"]) from error
    kind = (str(document.get("protocol")), str(document.get("role")))
    model = MODELS.get(kind)
    if model is None:
        allowed = ", ".join(f"protocol = {p!r} with role = {r!r}" for p, r in MODELS)
        raise MapRefused([f"{path.name}: protocol {kind[0]!r} with role {kind[1]!r} is unknown; allowed: {allowed}"])
    try:
        return model.model_validate(document)
    except ValidationError as refusal:
        reasons = [line for error in refusal.errors() for line in reasons_of(model, error)]
        raise MapRefused([f"{path.name}: {reason}" for reason in reasons]) from refusal
