"""From the devices on OPC UA servers to their links: one an endpoint."""

from collections.abc import Callable, Sequence

from drivers.opcua.amplifier import Amplifier
from drivers.opcua.channel import Channel
from drivers.opcua.drive import Axis, AxisSettings
from drivers.opcua.link import OpcUaLink
from drivers.opcua.maps import DriveMap, LoadCellMap, PlcMap
from drivers.opcua.messages import Plan
from drivers.opcua.nodes import NodeTable
from drivers.opcua.plc import Plc
from drivers.opcua.prepare import Device
from drivers.opcua.process import ProcessChannel
from drivers.port import Link
from drivers.wiring import Wired
from gateway.core.line import Drive, Line, LinePlc, LoadCell, OpcUaBus
from gateway.core.line_limits import motor_radius_m, motor_torque_limit_nm


def build(line: Line, devices: Sequence[Wired]) -> tuple[list[Link], list[str]]:
    """See `drivers.wiring.Builder`. Each link has its client in a process of its own."""
    return build_on(line, devices, lambda plan: ProcessChannel(plan, line.control.cpu, line.control.priority))


def build_on(line: Line, devices: Sequence[Wired], channel: Callable[[Plan], Channel]) -> tuple[list[Link], list[str]]:
    """The same on channels of the caller's choice."""
    links: list[Link] = []
    reasons: list[str] = []
    servers = {wired.bus.name: wired.bus for wired in devices if isinstance(wired.bus, OpcUaBus)}
    for bus in servers.values():
        table = NodeTable()
        behind = _Server(line, table)
        for wired in devices:
            if wired.bus is bus:
                behind.add(wired)
        reasons += behind.reasons
        plan = Plan(
            bus.endpoint,
            bus.security,
            bus.certificate or "",
            bus.private_key or "",
            bus.server_certificate or "",
            table.nodes,
        )
        links.append(OpcUaLink(bus.name, bus.endpoint, behind.devices(), channel(plan), line.control.period_s))
    return links, reasons


class _Server:
    """The devices behind one server, and why there cannot be some."""

    def __init__(self, line: Line, table: NodeTable) -> None:
        self.reasons: list[str] = []
        self._line = line
        self._table = table
        self._devices: list[Device] = []
        self._amplifiers: dict[tuple[int, str], tuple[LoadCellMap, list[LoadCell]]] = {}

    def add(self, wired: Wired) -> None:
        item, device = wired.item, wired.device
        try:
            if isinstance(item, Drive) and isinstance(device, DriveMap):
                self._devices.append(Axis(device, self._settings(item), self._table))
            elif isinstance(item, LinePlc) and isinstance(device, PlcMap):
                self._devices.append(Plc(device, item, self._line.limits.watchdog_s, self._table))
            elif isinstance(item, LoadCell) and isinstance(device, LoadCellMap):
                self._add_cell(item, device)
        except ValueError as error:
            self.reasons.append(f"{item.name}: {error}")

    def devices(self) -> list[Device]:
        """All of them; load cells by amplifier."""
        amplifiers: list[Device] = []
        for device, cells in self._amplifiers.values():
            try:
                amplifiers.append(Amplifier(device, cells, self._table))
            except ValueError as error:
                self.reasons.append(f"{', '.join(cell.name for cell in cells)}: {error}")
        return [*amplifiers, *self._devices]

    def _add_cell(self, cell: LoadCell, device: LoadCellMap) -> None:
        """Raises ValueError."""
        if cell.channel > device.channels.count:
            raise ValueError(f"channel {cell.channel}; allowed: 1 to {device.channels.count}")
        self._amplifiers.setdefault((cell.address, cell.map), (device, []))[1].append(cell)

    def _settings(self, drive: Drive) -> AxisSettings:
        limits = self._line.limits
        return AxisSettings(
            name=drive.name,
            index=drive.roller - 1,
            address=drive.address,
            channel=drive.channel,
            rated_torque_nm=drive.rated_torque_nm,
            torque_limit_nm=motor_torque_limit_nm(self._line, drive),
            watchdog_s=limits.watchdog_s,
            radius_m=motor_radius_m(self._line, drive),
        )
