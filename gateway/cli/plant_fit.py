"""Whether a simulated line offers on its wires what a line description expects there."""

from dataclasses import dataclass
from pathlib import Path
from urllib.parse import urlsplit

from gateway.core.line import Bus, CanopenBus, Drive, Line, LinePlc, LoadCell, ModbusTcpBus
from sim_plant.plant import Plant
from sim_plant.plant_wires import CHANNELS_PER_CAN_AMPLIFIER, Wire


@dataclass(frozen=True, order=True)
class Seat:
    """Where a device is: its wire in words, and its place there. An address that a protocol does not have is None."""

    wire: str
    address: int | None
    channel: int

    def __str__(self) -> str:
        address = "" if self.address is None else f" address {self.address}"
        return f"{self.wire}{address}" + (f" channel {self.channel}" if self.channel > 1 else "")


def misfits(line: Line, file: Path, plant: Plant, plant_file: Path) -> list[str]:
    """In what the two files differ, each sentence naming both; empty when they fit."""
    found: list[str] = []
    if line.n != plant.spans:
        found.append(f"{file} has {_spans(line.n)}, {plant_file} has {_spans(plant.spans)}")
    buses = {bus.name: bus for bus in line.buses}
    wires: dict[tuple[str, str], list[str]] = {}
    keys: dict[tuple[str, str], list[str]] = {}
    seats: list[str] = []
    for item in [*line.drives, *line.load_cells, line.plc]:
        number = _number(item)
        if number > plant.spans:
            continue  # told above
        expected, offered = _expected(item, buses[item.bus]), _offered(plant, item, number)
        if expected.wire != offered.wire:
            pair = expected.wire, offered.wire
            wires.setdefault(pair, []).append(item.name)
            keys.setdefault(pair, []).extend(_keys(item, buses[item.bus], plant, number))
        elif (expected.address, expected.channel) != (offered.address, offered.channel):
            seats.append(f"{file} has {item.name} at {expected}, {plant_file} at {offered}")
    for pair, names in wires.items():
        change = " and ".join(dict.fromkeys(keys[pair]))
        found.append(
            f"{file} has {_listed(names)} on {pair[0]}, {plant_file} on {pair[1]} (for the plant to fit: {change})"
        )
    return found + seats[:3] + ([f"and {len(seats) - 3} more devices at other addresses"] if len(seats) > 3 else [])


def _number(item: Drive | LoadCell | LinePlc) -> int:
    """Roller or span, from 1; 1 for the PLC."""
    return item.roller if isinstance(item, Drive) else item.span if isinstance(item, LoadCell) else 1


def _expected(item: Drive | LoadCell | LinePlc, bus: Bus) -> Seat:
    channel = 1 if isinstance(item, LinePlc) else item.channel
    if isinstance(bus, CanopenBus):
        return Seat(_can(bus.interface, bus.channel, bus.port), item.address, channel)
    if isinstance(bus, ModbusTcpBus):
        return Seat(f"Modbus TCP port {bus.port}", item.address, channel)
    return Seat(f"OPC UA port {urlsplit(bus.endpoint).port or 4840}", None, channel)


def _offered(plant: Plant, item: Drive | LoadCell | LinePlc, number: int) -> Seat:
    wires = plant.wires
    wire = _wire(plant, item, number)
    can, modbus = wires.canopen, wires.modbus
    if wire == "opcua":
        return Seat(f"OPC UA port {wires.opcua.port}", None, number)
    if wire == "rack":
        return Seat(f"Modbus TCP port {modbus.port}", modbus.rack_unit, number)
    if wire == "canopen":
        port = can.port if can.interface == "udp_multicast" else None
        return Seat(_can(can.interface, can.channel, port), *_own_seat(item, number, plant, wire))
    return Seat(f"Modbus TCP port {modbus.port}", *_own_seat(item, number, plant, wire))


def _wire(plant: Plant, item: Drive | LoadCell | LinePlc, number: int) -> Wire:
    wires = plant.wires
    if isinstance(item, LinePlc):
        return wires.plc
    each = wires.drives if isinstance(item, Drive) else wires.load_cells
    return each if isinstance(each, str) else each[number - 1]


def _keys(item: Drive | LoadCell | LinePlc, bus: Bus, plant: Plant, number: int) -> list[str]:
    """What the plant's file needs so that it has the device on this bus."""
    role = "drives" if isinstance(item, Drive) else "load_cells" if isinstance(item, LoadCell) else "plc"
    if isinstance(bus, CanopenBus):
        port = "" if bus.port is None else f" port = {bus.port}"
        word, key = "canopen", f'[wires.canopen] interface = "{bus.interface}" channel = "{bus.channel}"{port}'
    elif isinstance(bus, ModbusTcpBus):
        word, key = "rack" if "rack" in item.map else "modbus-tcp", f"[wires.modbus] port = {bus.port}"
    else:
        word, key = "opcua", f"[wires.opcua] port = {urlsplit(bus.endpoint).port or 4840}"
    if _wire(plant, item, number) == word:
        return [key]
    changed = [f'[wires] {role} = "{word}"']
    as_it_would_be = plant.model_copy(update={"wires": plant.wires.model_copy(update={role: word})})
    if _offered(as_it_would_be, item, number).wire != _expected(item, bus).wire:
        changed.append(key)
    return changed


def _own_seat(item: Drive | LoadCell | LinePlc, number: int, plant: Plant, wire: Wire) -> tuple[int, int]:
    """Address and channel of a device that has its own."""
    can, modbus = plant.wires.canopen, plant.wires.modbus
    if isinstance(item, Drive):
        return (can.first_node if wire == "canopen" else modbus.first_drive_unit) + number - 1, 1
    if isinstance(item, LinePlc):
        return can.plc_node if wire == "canopen" else modbus.plc_unit, 1
    if wire == "canopen":
        amplifier, channel = divmod(number - 1, CHANNELS_PER_CAN_AMPLIFIER)
        return can.amplifier_node + amplifier, channel + 1
    return modbus.amplifier_unit, number


def _listed(names: list[str]) -> str:
    return names[0] if len(names) == 1 else f"{names[0]} to {names[-1]}" if len(names) > 2 else " and ".join(names)


def _spans(count: int) -> str:
    return f"{count} span" if count == 1 else f"{count} spans"


def _can(interface: str, channel: str, port: int | None) -> str:
    return f"{interface} {channel}" + (f" port {port}" if port is not None else "")
