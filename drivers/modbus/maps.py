"""Maps of Modbus TCP devices: which registers mean what."""

from typing import Annotated, Literal

from pydantic import Field, model_validator

from drivers.map_fields import Bit, Format, Range, TensionUnit, TimeUnit, WebSpeedUnit, refuse_together
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
from gateway.core.line import Positive, Strict

MAX_READ_REGISTERS = 125

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
        return refuse_together(self, problems)


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
    for name in ("permissive", "emergency_stop", "running", "watchdog_tripped"):
        problems += bit_problems(f"read.{name}", getattr(read, name).bit, read.status.type)
    return problems


def _register_fields(key: str, table: Strict) -> dict[str, tuple[int, str]]:
    return {f"{key}.{name}": (field.address, field.type) for name, field in table if isinstance(field, Register)}
