"""Whether a simulated line offers on its wires what a line description expects there."""

from pathlib import Path

from gateway.core.line import CanopenBus, Line, ModbusTcpBus
from sim_plant.plant import Plant


def misfits(line: Line, file: Path, plant: Plant, plant_file: Path) -> list[str]:
    """In what the two files differ, each sentence naming both; empty when they fit."""
    found: list[str] = []
    if line.n != plant.spans:
        found.append(f"{file} has {_spans(line.n)}, {plant_file} has {_spans(plant.spans)}")
    can, modbus = plant.wires.canopen, plant.wires.modbus
    offered = _can_words(can.interface, can.channel, can.port if can.interface == "udp_multicast" else None)
    expected = [_can_words(b.interface, b.channel, b.port) for b in line.buses if isinstance(b, CanopenBus)]
    if expected != [offered]:
        found.append(f"{file} has its drives on {' and '.join(expected) or 'no CAN bus'}, {plant_file} on {offered}")
    ports = sorted({bus.port for bus in line.buses if isinstance(bus, ModbusTcpBus)})
    if ports != [modbus.port]:
        listed = " and ".join(map(str, ports)) or "none"
        found.append(f"{file} has Modbus TCP on port {listed}, {plant_file} on port {modbus.port}")
    return found


def _spans(count: int) -> str:
    return f"{count} span" if count == 1 else f"{count} spans"


def _can_words(interface: str, channel: str, port: int | None) -> str:
    return f"{interface} {channel}" + (f" port {port}" if port is not None else "")
