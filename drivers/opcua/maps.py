"""Maps of OPC UA devices: which nodes mean what.

A node is named by its identifier in the map's namespace, as servers print it without `ns=` and `s=`; `i=1234` is a
numeric one. {address} and {channel} in it become those of the device in the line's file.
"""

import re
from typing import Annotated, Literal

from pydantic import Field, model_validator

from drivers.map_fields import (
    UNSEEN_POWER,
    Bit,
    Bits,
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
from drivers.map_rules import bit_problems, fit_problems, range_problems
from gateway.core.drive_tells import INVERTER_ACCURACY, TORQUE_FILTER_S
from gateway.core.line import Name, Positive, Strict

NumberType = Literal["u8", "i8", "u16", "i16", "u32", "i32", "f32", "f64"]
CountType = Literal["u16", "u32"]  #: bits, codes and counts
#: What a source time stamp is of: of each measurement, changed or not, or of the value's last change.
SourceTimeKind = Literal["sample", "change"]

_NUMERIC = re.compile(r"i=(\d{1,10})")
_NUMERIC_TEMPLATE = re.compile(r"i=(\d|\{address\}|\{channel\})+")
_LARGEST_NUMERIC = 0xFFFFFFFF


class NodeRef(Strict):
    node: Annotated[str, Field(min_length=1, max_length=200)]

    def identifier(self, address: int, channel: int) -> str:
        """The node of one device. Raises ValueError for a numeric one that cannot be."""
        text = self.node.replace("{address}", str(address)).replace("{channel}", str(channel))
        numeric = _NUMERIC.fullmatch(text)
        if text.startswith("i=") and (numeric is None or int(numeric[1]) > _LARGEST_NUMERIC):
            raise ValueError(f"node {text!r}; allowed: i= and a number up to {_LARGEST_NUMERIC}, or a name")
        return text

    @model_validator(mode="after")
    def _numeric(self) -> "NodeRef":
        wrong = self.node.startswith("i=") and not _NUMERIC_TEMPLATE.fullmatch(self.node)
        return refuse_together(self, [f"node: {self.node!r}; allowed: i= and a number, or a name"] if wrong else [])


class Count(NodeRef):
    type: CountType = "u16"


class Identity(Count):
    value: int  #: what a device of this type has there


class Flag(NodeRef):
    """Yes or no: a Boolean, or a bit of a word. `inverted`: true where false or 0 means yes."""

    type: Literal["bool", "u16", "u32"] = "bool"
    bit: Bits | None = None
    inverted: bool = False

    @model_validator(mode="after")
    def _bit(self) -> "Flag":
        if self.type == "bool":
            problems = [] if self.bit is None else ["bit: a bool has none; allowed: no such key, or type u16 or u32"]
        elif self.bit is None:
            problems = [f"bit: is missing; a {self.type} needs it"]
        else:
            problems = bit_problems("", self.bit, self.type)
        return refuse_together(self, [problem.removeprefix(".") for problem in problems])

    def is_set(self, value: float) -> bool:
        """What it says."""
        return bool(int(value) >> (self.bit or 0) & 1) != self.inverted


class Switch(NodeRef):
    """A Boolean that is written."""

    inverted: bool = False


class Speed(NodeRef):
    type: NumberType
    unit: SpeedUnit
    scale: Positive = 1.0


class WebSpeed(NodeRef):
    type: NumberType
    unit: WebSpeedUnit
    scale: Positive = 1.0
    range: Range


class Torque(NodeRef):
    type: NumberType
    unit: TorqueUnit
    scale: Positive = 1.0


class Tension(NodeRef):
    type: NumberType
    unit: TensionUnit
    scale: Positive = 1.0


class ChannelStatus(Count):
    ok: int
    texts: dict[str, str] = {}  #: what the other values mean; keys are the values


class WatchdogNode(Count):
    unit: TimeUnit
    scale: Positive = 1.0
    range: Range

    def problems(self) -> list[str]:
        written = range_problems("watchdog", self.range)
        return written + fit_problems("watchdog", self.type, self.range, self.scale)


class OpcUaMap(Strict):
    """What every OPC UA device type states."""

    format: Format
    protocol: Literal["opcua"]
    description: str
    family: Name | None = None  #: devices of one family may share an address: they are instances of one machine
    namespace: Annotated[str, Field(min_length=1, max_length=200)]  #: its URI
    identity: Identity
    serial: NodeRef | None = None  #: its serial number, a String or an integer; without it no exchange is seen

    @property
    def told(self) -> dict[str, NodeRef]:
        """What says which device it is."""
        return {"identity": self.identity} | ({} if self.serial is None else {"serial": self.serial})


class ModeNode(NodeRef):
    type: Literal["i8", "u8", "i16", "u16", "i32"] = "i8"
    shown: Literal["always", "enabled"] = "always"  #: "enabled": it displays 0 as long as it is not enabled


class DriveNodes(Strict):
    statusword: Count
    speed: Speed
    torque: Torque
    safe_torque_off: Flag | None = None
    error_code: Count | None = None  #: of a fault, or of a warning
    mode_displayed: ModeNode | None = None  #: its mode of operation, where it has several
    rated_torque: Torque | None = None  #: compared with the line's file when it is there
    max_torque: Torque
    controlword: Count
    target_torque: Torque
    life: Count  #: moves with every command


class DriveMap(OpcUaMap):
    role: Literal["drive"]
    source_time: SourceTimeKind = "sample"
    follows_command: Bit | None = None  #: of the statusword: the target torque is followed, not ignored
    voltage_enabled: Bit | None = None  #: of the statusword: the power stage is supplied, whether it is on or off
    torque_mode: int | None = None  #: what `nodes.mode_displayed` shows while torques are followed
    torque_accuracy: TorqueAccuracy = INVERTER_ACCURACY
    torque_filter_s: TorqueFilter = TORQUE_FILTER_S
    nodes: DriveNodes
    watchdog: WatchdogNode

    @property
    def speed(self) -> Speed:
        """The roller's."""
        return self.nodes.speed

    @property
    def unseen(self) -> list[str]:
        """What its answers do not tell, as far as this map says, each with the key that would."""
        return [] if self.voltage_enabled is not None else [UNSEEN_POWER]

    @property
    def torques(self) -> tuple[Torque, Torque]:
        """What it reports, and what it is asked for."""
        return self.nodes.torque, self.nodes.target_torque

    @property
    def mode(self) -> int | None:
        """The mode of operation in which torques are followed; None: it has but one."""
        return self.torque_mode

    @model_validator(mode="after")
    def _layout(self) -> "DriveMap":
        problems = _twice_problems(self.told | {"watchdog": self.watchdog} | _named("nodes", self.nodes))
        problems += self.watchdog.problems()
        for key, bit in (("follows_command", self.follows_command), ("voltage_enabled", self.voltage_enabled)):
            if bit is not None:
                problems += bit_problems(key, bit.bit, self.nodes.statusword.type)
        if (self.nodes.mode_displayed is None) != (self.torque_mode is None):
            problems.append("torque_mode: goes with nodes.mode_displayed; allowed: both or none")
        rated = self.nodes.rated_torque
        if rated is not None and rated.unit == "rated torque":
            problems.append("nodes.rated_torque.unit: 'rated torque' of itself says nothing; allowed: Nm, mNm")
        return refuse_together(self, problems)


class Channels(Strict):
    count: Annotated[int, Field(ge=1)]
    tension: Tension
    status: ChannelStatus | None = None


class LoadCellMap(OpcUaMap):
    role: Literal["load-cell"]
    source_time: SourceTimeKind = "sample"
    channel_count: Count
    sample_counter: Count  #: moves with every measurement
    healthy: Flag
    channels: Channels

    @model_validator(mode="after")
    def _layout(self) -> "LoadCellMap":
        shared = self.told | {"channel_count": self.channel_count}
        shared |= {"sample_counter": self.sample_counter, "healthy": self.healthy}
        problems = _twice_problems(shared | _named("channels", self.channels))
        problems += [
            f"{name}.node: {entry.node!r} names a channel; the amplifier has one of it"
            for name, entry in shared.items()
            if "{channel}" in entry.node
        ]
        problems += [
            f"{name}.node: {entry.node!r} has no {{channel}}; every channel needs its own"
            for name, entry in _named("channels", self.channels).items()
            if "{channel}" not in entry.node
        ]
        return refuse_together(self, problems)


class PlcRead(Strict):
    permissive: Flag
    emergency_stop: Flag  #: yes: the emergency stop circuit is open
    running: Flag
    watchdog_tripped: Flag
    local: Flag | None = None  #: yes: the line is not started from elsewhere
    speed: WebSpeed
    life_echo: Count


class PlcWrite(Strict):
    run: Switch
    warning: Switch | None = None  #: lamp and horn before anything moves
    speed: WebSpeed
    life: Count


class PlcMap(OpcUaMap):
    role: Literal["line-plc"]
    read: PlcRead
    write: PlcWrite
    watchdog: WatchdogNode

    @model_validator(mode="after")
    def _layout(self) -> "PlcMap":
        named = self.told | {"watchdog": self.watchdog}
        named |= _named("read", self.read) | _named("write", self.write)
        problems = _twice_problems(named) + self.watchdog.problems()
        problems += [
            f"{name}.node: {entry.node!r} names a channel; a PLC has none"
            for name, entry in named.items()
            if "{channel}" in entry.node
        ]
        problems += range_problems("read.speed", self.read.speed.range)
        problems += range_problems("write.speed", self.write.speed.range)
        return refuse_together(self, problems)


def _named(key: str, table: Strict) -> dict[str, NodeRef]:
    return {f"{key}.{name}": entry for name, entry in table if isinstance(entry, NodeRef)}


def _twice_problems(entries: dict[str, NodeRef]) -> list[str]:
    """A node has one meaning; only flags may be bits of one word."""
    problems: list[str] = []
    taken: dict[str, tuple[str, NodeRef]] = {}
    for name, entry in entries.items():
        other_name, other = taken.setdefault(entry.node, (name, entry))
        bits = isinstance(entry, Flag) and isinstance(other, Flag) and entry.type == other.type != "bool"
        if other is not entry and not bits:
            problems.append(f"{name}.node: {entry.node!r} is already {other_name}")
    return problems
