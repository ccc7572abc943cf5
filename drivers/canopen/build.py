"""From the devices on CANopen buses to their links: one a bus."""

from collections.abc import Sequence

from drivers.canopen.amplifier import AmplifierNode
from drivers.canopen.configure import DriveSettings, check_target_range, torque_limit_counts
from drivers.canopen.drive import DriveNode
from drivers.canopen.heartbeat import HeartbeatProducer
from drivers.canopen.link import CanopenLink
from drivers.canopen.maps import DriveMap, LoadCellMap, PlcMap
from drivers.canopen.node import Node
from drivers.canopen.plc import PlcNode
from drivers.port import Link
from drivers.wiring import Wired
from gateway.core.line import CanopenBus, Drive, Line, LinePlc, LoadCell
from gateway.core.line_limits import motor_radius_m, motor_torque_limit_nm


def build(line: Line, devices: Sequence[Wired]) -> tuple[list[Link], list[str]]:
    """See `drivers.wiring.Builder`."""
    nodes: dict[str, list[Node]] = {}
    reasons: list[str] = []
    amplifiers: dict[tuple[str, int, str], tuple[LoadCellMap, list[LoadCell]]] = {}
    for wired in devices:
        item, device = wired.item, wired.device
        of_bus = nodes.setdefault(wired.bus.name, [])
        try:
            if isinstance(item, Drive) and isinstance(device, DriveMap):
                of_bus.append(_drive_node(line, item, device))
            elif isinstance(item, LoadCell) and isinstance(device, LoadCellMap):
                _check_channel(item, device)
                amplifiers.setdefault((wired.bus.name, item.address, item.map), (device, []))[1].append(item)
            elif isinstance(item, LinePlc) and isinstance(device, PlcMap):
                of_bus.append(PlcNode(device, item, line.limits.watchdog_s))
        except ValueError as error:
            reasons.append(f"{item.name}: {error}")
    for (bus, _, _), (device, cells) in amplifiers.items():
        nodes[bus].append(AmplifierNode(device, cells))
    buses = {wired.bus.name: wired.bus for wired in devices if isinstance(wired.bus, CanopenBus)}
    links: list[Link] = []
    for name, of_bus in nodes.items():
        if refused := _address_problems(name, of_bus):
            reasons += refused
        else:
            links.append(CanopenLink(buses[name], of_bus, _heartbeat(line, of_bus)))
    return links, reasons


def _drive_node(line: Line, drive: Drive, device: DriveMap) -> DriveNode:
    """Raises ValueError when the line asks for what the drive cannot do."""
    limits = line.limits
    settings = DriveSettings(
        drive.address, drive.rated_torque_nm, motor_torque_limit_nm(line, drive), limits.watchdog_s
    )
    check_target_range(device, settings)
    if device.objects.max_torque is not None and device.objects.max_torque.writable:
        torque_limit_counts(device, settings)
    radius_m = motor_radius_m(line, drive)
    return DriveNode(drive.name, drive.roller - 1, device, settings, radius_m)


def _check_channel(cell: LoadCell, device: LoadCellMap) -> None:
    """Raises ValueError."""
    if cell.channel > device.channels:
        raise ValueError(f"channel {cell.channel}; allowed: 1 to {device.channels}")


def _heartbeat(line: Line, nodes: Sequence[Node]) -> HeartbeatProducer | None:
    numbers = [node.station.listens_to for node in nodes if node.station.listens_to is not None]
    return HeartbeatProducer(numbers[0], line.limits.watchdog_s, line.control.period_s) if numbers else None


def _address_problems(bus: str, nodes: Sequence[Node]) -> list[str]:
    """Nodes that would be mistaken for one another, or for the gateway."""
    reasons: list[str] = []
    ours = {node.station.listens_to: node.station.name for node in nodes if node.station.listens_to is not None}
    if len(ours) > 1:
        listened = ", ".join(f"{name} to {number}" for number, name in ours.items())
        reasons.append(f"bus {bus}: its drives listen to the heartbeats of several nodes ({listened}); allowed: one")
    taken: dict[int, str] = {}
    for node in nodes:
        station = node.station
        if station.node in ours:
            reasons.append(f"{station.name}: node {station.node} is the gateway's own number on bus {bus}")
        for cob_id in node.answers:
            if (other := taken.setdefault(cob_id, station.name)) != station.name:
                reasons.append(f"{station.name}: COB-ID {cob_id:03X}h is already {other}'s on bus {bus}")
    return reasons
