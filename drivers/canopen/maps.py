"""Maps of CANopen devices: what a file in `drivers/maps` may say of a drive, a load-cell amplifier, a line PLC."""

from typing import Annotated, Literal

from pydantic import Field, model_validator

from drivers.canopen.map_parts import (
    CanIdentity,
    CanObject,
    HeartbeatObject,
    Index,
    ObjectType,
    OptionObject,
    Pdo,
    SpeedObject,
    TorqueObject,
    Watchdog,
    WebSpeedObject,
    heartbeat_problems,
    pdo_problems,
    place_problems,
    size_problems,
    watchdog_problems,
)
from drivers.map_fields import Bit, Format, Range, TensionUnit, refuse_together
from drivers.map_rules import INTEGERS, bit_problems, range_problems, type_problems
from gateway.core.line import Positive, Strict

COB_ID_STEP = 0x100  #: from one PDO of a node to its next (CiA 301, predefined connection set)
_UNSIGNED = ("u8", "u16", "u32")  #: of objects that carry bits, codes or counts


class CanMap(Strict):
    """What every CANopen device type states."""

    format: Format
    protocol: Literal["canopen"]
    description: str
    identity: CanIdentity
    heartbeat: HeartbeatObject


# drives


class SafeTorqueOff(CanObject, Bit):
    """Where the drive says that its hard-wired safe torque off is active."""


class TargetTorqueObject(TorqueObject):
    range: Range | None = None  #: what the object takes, in its unit, where that is less than its type


class MaxTorqueObject(TorqueObject):
    writable: bool  #: true: set to the line's limit; false: the drive's own, which must allow the line's limit


class DriveObjects(Strict):
    """The objects of CiA 402 cyclic synchronous torque, wherever the device keeps them."""

    controlword: CanObject
    statusword: CanObject
    mode: CanObject
    target_torque: TargetTorqueObject
    torque: TorqueObject
    speed: SpeedObject
    max_torque: MaxTorqueObject | None = None  #: without it the drive itself does not hold the line's limit
    rated_torque: TorqueObject | None = None  #: compared with the line's file when it is there
    safe_torque_off: SafeTorqueOff | None = None


class DriveOptions(Strict):
    """Settings that decide what the rest of the map means."""

    abort_connection: OptionObject | None = None  #: what it does when its watchdog fires; must take torque off
    fault_reaction: OptionObject | None = None
    speed_unit: OptionObject | None = None  #: the unit of `objects.speed`, where the device lets it be chosen

    def present(self) -> list[OptionObject]:
        return [option for _, option in self if option is not None]


DriveEntry = Literal["controlword", "statusword", "mode", "target_torque", "torque", "speed", "safe_torque_off"]


class DrivePdo(Pdo):
    objects: Annotated[list[DriveEntry], Field(min_length=1, max_length=8)]


class DriveMap(CanMap):
    role: Literal["drive"]
    cyclic_torque_mode: Annotated[int, Field(ge=-128, le=127)]
    follows_command: Bit | None = None  #: of the statusword: the target torque is followed, not ignored
    objects: DriveObjects
    options: DriveOptions = DriveOptions()
    receive_pdo: DrivePdo
    transmit_pdo: DrivePdo
    watchdog: Watchdog

    def objects_of(self, pdo: DrivePdo) -> list[CanObject]:
        """The objects of a PDO in mapping order."""
        return [getattr(self.objects, name) for name in pdo.objects]

    @model_validator(mode="after")
    def _layout(self) -> "DriveMap":
        entries = dict(self.objects)
        receive, transmit = self.receive_pdo.objects, self.transmit_pdo.objects
        problems = pdo_problems("receive_pdo", receive, entries, ["controlword", "target_torque"])
        problems += pdo_problems("transmit_pdo", transmit, entries, ["statusword", "speed", "torque"])
        problems += place_problems({f"objects.{name}": entry for name, entry in entries.items() if entry is not None})
        problems += _drive_type_problems(self.objects)
        if self.follows_command is not None:
            problems += bit_problems("follows_command", self.follows_command.bit, "u16")
        for name, option in self.options:
            if option is not None:
                problems += type_problems(f"options.{name}", option.type, INTEGERS)
        return refuse_together(self, problems + watchdog_problems(self.watchdog) + heartbeat_problems(self.heartbeat))


def _drive_type_problems(objects: DriveObjects) -> list[str]:
    problems = type_problems("objects.controlword", objects.controlword.type, ("u16",))
    problems += type_problems("objects.statusword", objects.statusword.type, ("u16",))
    problems += type_problems("objects.mode", objects.mode.type, ("i8",))
    if objects.target_torque.range is not None:
        problems += range_problems("objects.target_torque", objects.target_torque.range)
    if (sto := objects.safe_torque_off) is not None:
        problems += type_problems("objects.safe_torque_off", sto.type, INTEGERS)
        problems += bit_problems("objects.safe_torque_off", sto.bit, sto.type)
    rated = objects.rated_torque
    if rated is not None and rated.unit == "rated torque":
        problems.append("objects.rated_torque.unit: 'rated torque' of itself says nothing; allowed: Nm, mNm")
    return problems


# load-cell amplifiers


class ChannelObject(Strict):
    """An object whose sub-index is the channel."""

    index: Index
    type: ObjectType

    def of_channel(self, channel: int) -> CanObject:
        return CanObject(index=self.index, sub=channel, type=self.type)


class ChannelTension(ChannelObject):
    unit: TensionUnit
    scale: Positive = 1.0
    digits: ChannelObject | None = None  #: where the device says how many decimal digits a count has (CiA 404)


class ChannelStatus(ChannelObject):
    ok: int
    texts: dict[str, str] = {}  #: what the other values mean; keys are the values


class ChannelCheck(ChannelObject):
    value: int  #: what a channel must have there


class Healthy(CanObject, Bit):
    """Where the amplifier says that it is healthy."""


class LoadCellObjects(Strict):
    channel_count: CanObject
    sample_counter: CanObject  #: moves with every measurement: a frozen amplifier is found by it
    tension: ChannelTension
    status: ChannelStatus | None = None
    physical_unit: ChannelCheck | None = None
    healthy: Healthy | None = None


ChannelEntry = Literal["tension", "status", "sample_counter"]


class ChannelPdos(Pdo):
    """Several PDOs alike, for as many channels each as `objects` lists "tension". Communication, mapping and COB-ID
    are those of the first; of each further one the records are the next, the COB-ID 100h higher."""

    count: Annotated[int, Field(ge=1, le=4)]
    objects: Annotated[list[ChannelEntry], Field(min_length=2, max_length=8)]

    @property
    def channels_each(self) -> int:
        return self.objects.count("tension")


class LoadCellMap(CanMap):
    role: Literal["load-cell"]
    objects: LoadCellObjects
    transmit_pdos: ChannelPdos

    @property
    def channels(self) -> int:
        return self.transmit_pdos.count * self.transmit_pdos.channels_each

    def transmit_pdo(self, pdo: int) -> Pdo:
        """PDO `pdo`, counted from 0."""
        first = self.transmit_pdos
        return Pdo(
            communication=first.communication + pdo,
            mapping=first.mapping + pdo,
            cob_id=first.cob_id + COB_ID_STEP * pdo,
            writable=first.writable,
        )

    def objects_of(self, pdo: int) -> list[CanObject]:
        """The objects of PDO `pdo`, counted from 0, in mapping order."""
        first = pdo * self.transmit_pdos.channels_each
        seen = {"tension": first, "status": first}
        entries: list[CanObject] = []
        for name in self.transmit_pdos.objects:
            if name == "sample_counter":
                entries.append(self.objects.sample_counter)
                continue
            seen[name] += 1
            entry = getattr(self.objects, name)
            entries.append(entry.of_channel(seen[name]))
        return entries

    @model_validator(mode="after")
    def _layout(self) -> "LoadCellMap":
        names, objects = self.transmit_pdos.objects, self.objects
        needed = ("sample_counter", "tension")
        problems = [f"transmit_pdos.objects: lacks {name}" for name in needed if name not in names]
        if names.count("sample_counter") > 1:
            problems.append("transmit_pdos.objects: sample_counter listed twice")
        wanted = names.count("tension") if objects.status is not None else 0
        if names.count("status") != wanted:
            problems.append(f"transmit_pdos.objects: {names.count('status')} times status; allowed: {wanted}")
        else:
            problems += size_problems("transmit_pdos", self.objects_of(0))
        problems += type_problems("objects.channel_count", objects.channel_count.type, _UNSIGNED)
        problems += type_problems("objects.sample_counter", objects.sample_counter.type, _UNSIGNED)
        if objects.status is not None:
            problems += type_problems("objects.status", objects.status.type, _UNSIGNED)
        if objects.tension.digits is not None:
            problems += type_problems("objects.tension.digits", objects.tension.digits.type, ("u8", "i8"))
        if (healthy := objects.healthy) is not None:
            problems += type_problems("objects.healthy", healthy.type, _UNSIGNED)
            problems += bit_problems("objects.healthy", healthy.bit, healthy.type)
        return refuse_together(self, problems + heartbeat_problems(self.heartbeat))


# line PLC


class PlcRead(Strict):
    status: CanObject
    permissive: Bit
    emergency_stop: Bit  #: yes: the emergency stop circuit is open
    running: Bit
    watchdog_tripped: Bit
    speed: WebSpeedObject
    life_echo: CanObject


class PlcWrite(Strict):
    command: CanObject
    run: Bit
    speed: WebSpeedObject
    life: CanObject


class PlcReceivePdo(Pdo):
    objects: Annotated[list[Literal["command", "speed", "life"]], Field(min_length=1, max_length=8)]


class PlcTransmitPdo(Pdo):
    objects: Annotated[list[Literal["status", "speed", "life_echo"]], Field(min_length=1, max_length=8)]


class PlcMap(CanMap):
    role: Literal["line-plc"]
    read: PlcRead
    write: PlcWrite
    receive_pdo: PlcReceivePdo
    transmit_pdo: PlcTransmitPdo
    watchdog: Watchdog

    def objects_of(self, pdo: PlcReceivePdo | PlcTransmitPdo) -> list[CanObject]:
        """The objects of a PDO in mapping order."""
        table = self.write if isinstance(pdo, PlcReceivePdo) else self.read
        return [getattr(table, name) for name in pdo.objects]

    @model_validator(mode="after")
    def _layout(self) -> "PlcMap":
        read, write = dict(self.read), dict(self.write)
        problems = pdo_problems("receive_pdo", self.receive_pdo.objects, write, ["command", "speed", "life"])
        problems += pdo_problems("transmit_pdo", self.transmit_pdo.objects, read, ["status", "speed", "life_echo"])
        objects = {f"read.{name}": entry for name, entry in read.items() if isinstance(entry, CanObject)}
        objects |= {f"write.{name}": entry for name, entry in write.items() if isinstance(entry, CanObject)}
        problems += place_problems({**objects, "watchdog": self.watchdog, "heartbeat": self.heartbeat})
        for key in ("read.status", "write.command"):
            problems += type_problems(key, objects[key].type, _UNSIGNED)
        for key in ("read.life_echo", "write.life"):
            problems += type_problems(key, objects[key].type, ("u16", "u32"))
        problems += bit_problems("write.run", self.write.run.bit, self.write.command.type)
        for name in ("permissive", "emergency_stop", "running", "watchdog_tripped"):
            problems += bit_problems(f"read.{name}", read[name].bit, self.read.status.type)
        problems += range_problems("read.speed", self.read.speed.range)
        problems += range_problems("write.speed", self.write.speed.range)
        if self.watchdog.kind != "receive-pdo":
            problems.append(f"watchdog.kind: {self.watchdog.kind!r}; allowed: 'receive-pdo', the life counter's")
        return refuse_together(self, problems + watchdog_problems(self.watchdog) + heartbeat_problems(self.heartbeat))
