"""From the devices on CANopen buses to their links: one a bus."""

from collections.abc import Sequence

from drivers.canopen.configure import DriveSettings, torque_limit_counts, watchdog_counts
from drivers.canopen.link import CanopenLink
from drivers.canopen.maps import DriveMap
from drivers.canopen.node import DriveNode
from drivers.port import Link
from drivers.wiring import Wired
from gateway.core.line import CanopenBus, Drive, Line


def build(line: Line, devices: Sequence[Wired]) -> tuple[list[Link], list[str]]:
    """See `drivers.wiring.Builder`."""
    nodes: dict[str, list[DriveNode]] = {}
    reasons: list[str] = []
    for wired in devices:
        assert isinstance(wired.item, Drive) and isinstance(wired.device, DriveMap)
        try:
            nodes.setdefault(wired.bus.name, []).append(_drive_node(line, wired.item, wired.device))
        except ValueError as error:
            reasons.append(f"{wired.item.name}: {error}")
    buses = {wired.bus.name: wired.bus for wired in devices if isinstance(wired.bus, CanopenBus)}
    return [CanopenLink(buses[name], of_bus) for name, of_bus in nodes.items()], reasons


def _drive_node(line: Line, drive: Drive, device: DriveMap) -> DriveNode:
    """Raises ValueError when the line asks for what the drive cannot do."""
    limits = line.limits
    settings = DriveSettings(drive.address, drive.rated_torque_nm, limits.torque_nm, limits.watchdog_s)
    watchdog_counts(device.watchdog, limits.watchdog_s)
    if device.objects.max_torque.writable:
        torque_limit_counts(device, settings)
    radius_m = line.rollers[drive.roller - 1].radius_m.value
    return DriveNode(drive.name, drive.roller - 1, device, settings, radius_m)
