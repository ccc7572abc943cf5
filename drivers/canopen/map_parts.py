"""What the maps of CANopen devices are made of: objects, PDOs, identity, watchdog, heartbeat, and their rules."""

from collections.abc import Mapping, Sequence
from typing import Annotated, Literal

from pydantic import Field

from drivers.map_fields import Format, Range, SpeedUnit, TimeUnit, TorqueUnit, WebSpeedUnit
from drivers.map_rules import BYTES, fit_problems, range_problems, type_problems
from gateway.core.line import Positive, Strict

MAX_PDO_BYTES = 8
UNSIGNED = ("u8", "u16", "u32")  #: of objects that carry bits, codes or counts

Index = Annotated[int, Field(ge=0x1000, le=0xFFFF)]
Node = Annotated[int, Field(ge=1, le=127)]
ObjectType = Literal["u8", "i8", "u16", "i16", "u32", "i32", "f32"]


class CanObject(Strict):
    index: Index
    sub: Annotated[int, Field(ge=0, le=254)] = 0
    type: ObjectType


class SpeedObject(CanObject):
    unit: SpeedUnit
    scale: Positive = 1.0


class WebSpeedObject(CanObject):
    unit: WebSpeedUnit
    scale: Positive = 1.0
    range: Range


class TorqueObject(CanObject):
    unit: TorqueUnit
    scale: Positive = 1.0


class TimeObject(CanObject):
    unit: TimeUnit
    scale: Positive = 1.0
    range: Range


class HeartbeatObject(TimeObject):
    value: Positive  #: the producer time to set, in the unit of the object


class Watchdog(TimeObject):
    """What takes torque off, or stops the line, when the gateway falls silent.

    "receive-pdo": the device expects receive PDOs (or life counters in them) within a time of its own.
    "heartbeat-consumer": it expects the heartbeat of `node`, which the link produces; the object is an entry of 1016h,
    node number and milliseconds in one.
    """

    kind: Literal["receive-pdo", "heartbeat-consumer"] = "receive-pdo"
    node: Node = 127  #: the gateway's own number; said with "heartbeat-consumer" only


class OptionObject(CanObject):
    """An object that must have a value, or the device does not do what the rest of the map says."""

    value: int
    writable: bool  #: true: set to the value; false: only looked at


class CanIdentity(Strict):
    """Object 1018h."""

    vendor_id: Annotated[int, Field(ge=0, le=0xFFFFFFFF)]
    product_code: Annotated[int, Field(ge=0, le=0xFFFFFFFF)]


EmergencyCode = Annotated[int, Field(ge=0x0100, le=0xFFFF)]


class EmergencyClasses(Strict):
    """Error codes of emergency messages whose class is known: a code, its group (0x4200) or its class (0x4000).

    Of all others the statusword decides, or bit 0 of the error register where there is none.
    """

    faults: list[EmergencyCode] = []  #: torque goes off, whatever else the device says
    warnings: list[EmergencyCode] = []  #: told, and nothing else


class CanMap(Strict):
    """What every CANopen device type states."""

    format: Format
    protocol: Literal["canopen"]
    description: str
    identity: CanIdentity
    heartbeat: HeartbeatObject
    emergency: EmergencyClasses = EmergencyClasses()


class Pdo(Strict):
    communication: Annotated[int, Field(ge=0x1400, le=0x19FF)]  #: index of the communication record
    mapping: Annotated[int, Field(ge=0x1600, le=0x1BFF)]  #: index of the mapping record
    cob_id: Annotated[int, Field(ge=0x180, le=0x500)]  #: of node 0; the node's number is added
    writable: bool = True  #: true: `prepare` writes the mapping; false: it is fixed, and only read and compared


def pdo_problems(
    key: str, names: Sequence[str], entries: Mapping[str, CanObject | None], needed: Sequence[str]
) -> list[str]:
    """What is wrong with the objects listed in a PDO; `entries` are the objects by their names."""
    problems: list[str] = []
    if missing := sorted(set(needed) - set(names)):
        problems.append(f"{key}.objects: lacks {', '.join(missing)}")
    if twice := sorted({name for name in names if names.count(name) > 1}):
        problems.append(f"{key}.objects: {', '.join(twice)} listed twice")
    if undefined := [name for name in names if entries[name] is None]:
        problems.append(f"{key}.objects: {', '.join(undefined)} is not defined in objects")
    return problems + size_problems(key, [entry for name in names if (entry := entries[name]) is not None])


def size_problems(key: str, entries: Sequence[CanObject]) -> list[str]:
    size = sum(BYTES[entry.type] for entry in entries)
    return [] if size <= MAX_PDO_BYTES else [f"{key}.objects: {size} bytes; a PDO carries at most {MAX_PDO_BYTES}"]


def place_problems(objects: Mapping[str, CanObject]) -> list[str]:
    """Objects that stand at the same place; `objects` by their keys in the map."""
    problems: list[str] = []
    places: dict[tuple[int, int], str] = {}
    for key, entry in objects.items():
        if (other := places.setdefault((entry.index, entry.sub), key)) != key:
            problems.append(f"{key}: {entry.index:04X}h sub {entry.sub} is already {other}")
    return problems


def heartbeat_problems(heartbeat: HeartbeatObject) -> list[str]:
    problems = range_problems("heartbeat", heartbeat.range)
    problems += fit_problems("heartbeat", heartbeat.type, heartbeat.range, heartbeat.scale)
    low, high = heartbeat.range
    if not low <= heartbeat.value <= high:
        problems.append(f"heartbeat.value: {heartbeat.value} is outside heartbeat.range [{low}, {high}]")
    return problems


def emergency_problems(emergency: EmergencyClasses) -> list[str]:
    both = sorted(set(emergency.faults) & set(emergency.warnings))
    return [f"emergency: {code:04X}h is among faults and warnings" for code in both]


def watchdog_problems(watchdog: Watchdog) -> list[str]:
    problems = range_problems("watchdog", watchdog.range)
    if watchdog.kind == "receive-pdo":
        if "node" in watchdog.model_fields_set:
            problems.append('watchdog.node: only kind = "heartbeat-consumer" listens to a node')
        return problems + fit_problems("watchdog", watchdog.type, watchdog.range, watchdog.scale)
    problems += type_problems("watchdog", watchdog.type, ("u32",))
    if (watchdog.unit, watchdog.scale) != ("ms", 1.0):
        problems.append("watchdog.unit: an entry of 1016h counts milliseconds; allowed: ms with scale 1")
    # 16 of the 32 bits are the time (CiA 301, object 1016h).
    return problems + fit_problems("watchdog", "u16", watchdog.range, watchdog.scale)
