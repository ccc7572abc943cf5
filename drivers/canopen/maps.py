"""Maps of CANopen devices: objects, PDOs, watchdog and heartbeat of a device type."""

from typing import Annotated, Literal

from pydantic import Field, model_validator

from drivers.map_fields import Bit, Format, Range, SpeedUnit, TimeUnit, TorqueUnit, refuse_together
from drivers.map_rules import BYTES, INTEGERS, bit_problems, fit_problems, range_problems, type_problems
from gateway.core.line import Positive, Strict

MAX_PDO_BYTES = 8


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

    def written(self) -> tuple[str, Range, float]:
        """What a time that is written must fit: type, range, scale."""
        return self.type, self.range, self.scale


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
        problems += range_problems("watchdog", self.watchdog.range) + fit_problems("watchdog", *self.watchdog.written())
        problems += range_problems("heartbeat", self.heartbeat.range) + fit_problems(
            "heartbeat", *self.heartbeat.written()
        )
        low, high = self.heartbeat.range
        if not low <= self.heartbeat.value <= high:
            problems.append(f"heartbeat.value: {self.heartbeat.value} is outside heartbeat.range [{low}, {high}]")
        return refuse_together(self, problems)


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
