"""The `[wires]` of PLANT.toml: on which wire each device of the simulated line is, and where on it.

A wire on which there is no device is not opened, and its table does not matter.
"""

from dataclasses import dataclass
from typing import Annotated, Any, Literal

from pydantic import Discriminator, Field, Tag, ValidationError

from sim_plant.plant_fields import Port, Strict, Unit

Wire = Literal["canopen", "modbus-tcp", "opcua", "rack"]

CHANNELS_PER_CAN_AMPLIFIER = 8
MOST_SPANS_OF_RACK = 14
_NODES = range(1, 128)
_UNITS = range(1, 248)


def _form(value: Any) -> str:
    """Which form of a value is meant, so that a mistake is told of that form alone."""
    return "(list)" if isinstance(value, list) else "(word)"


Node = Annotated[int, Field(ge=_NODES.start, le=_NODES.stop - 1)]
#: One wire for all rollers (spans), or a list with one for each.
WireEach = Annotated[Annotated[Wire, Tag("(word)")] | Annotated[list[Wire], Tag("(list)")], Discriminator(_form)]


class Canopen(Strict):
    interface: Literal["udp_multicast", "virtual", "socketcan"] = "udp_multicast"
    channel: str = "239.74.163.2"
    port: Port = 43113  #: udp_multicast only
    first_node: Node = 1  #: node of the drive of roller 1
    amplifier_node: Node = 101  #: node of the load-cell amplifier of spans 1 to 8; the next eight are on the next node
    plc_node: Node = 120
    bitrate_bit_per_s: Annotated[int, Field(ge=10_000, le=1_000_000)] = 1_000_000
    wire_time: bool = False  #: whether a frame takes its time, where the interface itself takes none


class Modbus(Strict):
    host: str = "127.0.0.1"
    port: Port = 5020
    amplifier_unit: Unit = 1
    plc_unit: Unit = 2
    rack_unit: Unit = 3
    first_drive_unit: Unit = 11  #: unit of the drive of roller 1


class Opcua(Strict):
    host: str = "127.0.0.1"
    port: Port = 4840


@dataclass(frozen=True, slots=True)
class Devices:
    """What is on one wire. Rollers (their drives) and spans (their load cells) count from 1."""

    rollers: tuple[int, ...]
    cells: tuple[int, ...]
    plc: bool

    def __bool__(self) -> bool:
        return bool(self.rollers or self.cells or self.plc)


class Wires(Strict):
    drives: WireEach = "canopen"
    load_cells: WireEach = "modbus-tcp"
    plc: Wire = "modbus-tcp"
    canopen: Canopen = Canopen()
    modbus: Modbus = Modbus()
    opcua: Opcua = Opcua()

    def on(self, wire: Wire, spans: int) -> Devices:
        """The devices on `wire` of a line with so many spans."""
        return Devices(_numbers(self.drives, wire, spans), _numbers(self.load_cells, wire, spans), self.plc == wire)


def can_amplifiers(cells: tuple[int, ...]) -> list[int]:
    """Numbers, from 0, of the CANopen amplifiers that these load cells need."""
    return sorted({(cell - 1) // CHANNELS_PER_CAN_AMPLIFIER for cell in cells})


def wires_rules(document: dict[str, Any], spans: int) -> list[str]:
    """What values of the `[wires]` table break together, one sentence each.

    Nothing while there are single mistakes in the table: those are told by its validation.
    """
    try:
        wires = Wires.model_validate(document)
    except ValidationError:
        return []
    lengths = [
        f"wires.{key}: has {len(value)} entries; give one word, or a list of {spans} (spans = {spans})"
        for key, value in (("drives", wires.drives), ("load_cells", wires.load_cells))
        if isinstance(value, list) and len(value) != spans
    ]
    if lengths:
        return lengths
    nodes, units = _nodes(wires, spans), _units(wires, spans)
    return [
        *_beyond(nodes, "wires.canopen", "node", _NODES),
        *_clashes(nodes, "wires.canopen", "node"),
        *_beyond(units, "wires.modbus", "unit", _UNITS),
        *_clashes(units, "wires.modbus", "unit"),
        *_rack_rules(wires, spans),
        *_port_rules(wires, spans),
    ]


@dataclass(frozen=True, slots=True)
class _Address:
    """Where a device is: the key that says so, its offset from what stands there, and the device in words."""

    key: str
    first: int
    offset: int
    device: str

    @property
    def value(self) -> int:
        return self.first + self.offset


def _numbers(each: str | list[Wire], wire: Wire, spans: int) -> tuple[int, ...]:
    words = [each] * spans if isinstance(each, str) else each
    return tuple(number for number, word in enumerate(words, start=1) if word == wire)


def _nodes(wires: Wires, spans: int) -> list[_Address]:
    wire, there = wires.canopen, wires.on("canopen", spans)
    nodes = [_Address("first_node", wire.first_node, i - 1, f"the drive of roller {i}") for i in there.rollers]
    for a in can_amplifiers(there.cells):
        nodes.append(_Address("amplifier_node", wire.amplifier_node, a, f"load-cell amplifier {a + 1}"))
    if there.plc:
        nodes.append(_Address("plc_node", wire.plc_node, 0, "the line PLC"))
    return nodes


def _units(wires: Wires, spans: int) -> list[_Address]:
    wire, there = wires.modbus, wires.on("modbus-tcp", spans)
    key, first = "first_drive_unit", wire.first_drive_unit
    units = [_Address(key, first, i - 1, f"the drive of roller {i}") for i in there.rollers]
    if there.cells:
        units.append(_Address("amplifier_unit", wire.amplifier_unit, 0, "the load-cell amplifier"))
    if there.plc:
        units.append(_Address("plc_unit", wire.plc_unit, 0, "the line PLC"))
    if wires.on("rack", spans):
        units.append(_Address("rack_unit", wire.rack_unit, 0, "the rack"))
    return units


def _beyond(addresses: list[_Address], table: str, kind: str, allowed: range) -> list[str]:
    last = {address.key: address for address in addresses}  # of each key the one with the largest offset
    return [
        f"{table}.{key}: is {address.first}, at most {allowed.stop - 1 - address.offset} for "
        f"{address.offset + 1} {kind}s ({allowed.start} to {allowed.stop - 1})"
        for key, address in last.items()
        if address.value >= allowed.stop
    ]


def _clashes(addresses: list[_Address], table: str, kind: str) -> list[str]:
    """One sentence for each pair of keys whose devices meet, with the first meeting."""
    told: dict[tuple[str, str], str] = {}
    by_value: dict[int, _Address] = {}
    for address in addresses:
        other = by_value.setdefault(address.value, address)
        if other is not address:
            text = (
                f"{table}.{address.key}: is {address.first}, and so {address.device} has {kind} {address.value}, "
                f"as {other.device} has ({other.key} = {other.first}); give each device a {kind} of its own"
            )
            told.setdefault((other.key, address.key), text)
    return list(told.values())


def _rack_rules(wires: Wires, spans: int) -> list[str]:
    if spans <= MOST_SPANS_OF_RACK or not (there := wires.on("rack", spans)):
        return []
    key = "drives" if there.rollers else "load_cells" if there.cells else "plc"
    return [f"wires.{key}: is 'rack', which carries at most {MOST_SPANS_OF_RACK} spans; the plant has {spans}"]


def _port_rules(wires: Wires, spans: int) -> list[str]:
    uses_modbus = bool(_units(wires, spans))
    same = (wires.opcua.host, wires.opcua.port) == (wires.modbus.host, wires.modbus.port)
    if uses_modbus and same and wires.on("opcua", spans):
        return [f"wires.opcua.port: is {wires.opcua.port}, as wires.modbus.port; give each a port of its own"]
    return []
