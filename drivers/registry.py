"""From a line description to the links that carry it: device types are looked up, devices grouped by bus."""

from collections.abc import Iterable
from pathlib import Path
from typing import TypeVar

from drivers.canopen.configure import DriveSettings, torque_limit_counts, watchdog_counts
from drivers.canopen.link import CanopenLink
from drivers.canopen.node import DriveNode
from drivers.device_map import MAPS, DeviceMap, DriveMap, LoadCellMap, MapRefused, PlcMap, load_map, map_names
from drivers.modbus.amplifier import Amplifier
from drivers.modbus.link import Device as ModbusDevice
from drivers.modbus.link import ModbusLink
from drivers.modbus.plc import Plc
from drivers.port import Link
from gateway.core.line import CanopenBus, Device, Drive, Line, LoadCell, ModbusTcpBus
from gateway.core.nearest import nearest

M = TypeVar("M", DriveMap, LoadCellMap, PlcMap)
B = TypeVar("B", CanopenBus, ModbusTcpBus)


class LinksRefused(ValueError):
    """The line cannot be carried by the drivers. `reasons` name the device, what is allowed and the nearest."""

    def __init__(self, reasons: list[str]) -> None:
        super().__init__("; ".join(reasons))
        self.reasons = reasons


def build_links(line: Line, folder: Path = MAPS) -> list[Link]:
    """One link a CANopen bus and one a Modbus TCP address, not yet open, for a line that has passed its own checks.

    Raises LinksRefused with every reason.
    """
    builder = _Builder(line, folder)
    links: list[Link] = [*builder.canopen_links(), *builder.modbus_links()]
    if builder.reasons:
        raise LinksRefused(builder.reasons)
    return links


class _Builder:
    """Collects links and the reasons why there cannot be any."""

    def __init__(self, line: Line, folder: Path) -> None:
        self.reasons: list[str] = []
        self._line = line
        self._folder = folder
        self._maps: dict[str, DeviceMap | None] = {}
        self._buses = {bus.name: bus for bus in line.buses}

    def canopen_links(self) -> list[CanopenLink]:
        nodes: dict[str, list[DriveNode]] = {}
        for drive in self._line.drives:
            device = self._map_of(drive, "drives", DriveMap)
            bus = self._bus_of(drive, CanopenBus, device)
            if device is not None and bus is not None:
                node = self._drive_node(drive, device)
                if node is not None:
                    nodes.setdefault(bus.name, []).append(node)
        buses = (bus for bus in self._line.buses if isinstance(bus, CanopenBus) and bus.name in nodes)
        return [CanopenLink(bus, nodes[bus.name]) for bus in buses]

    def modbus_links(self) -> list[ModbusLink]:
        devices: dict[tuple[str, int], list[ModbusDevice]] = {}
        names: dict[tuple[str, int], str] = {}
        for place, bus, device in [*self._amplifiers(), *self._plc()]:
            devices.setdefault(place, []).append(device)
            names.setdefault(place, bus)
        period_s = self._line.control.period_s
        return [ModbusLink(names[place], *place, devices[place], period_s) for place in devices]

    def _drive_node(self, drive: Drive, device: DriveMap) -> DriveNode | None:
        limits = self._line.limits
        settings = DriveSettings(drive.address, drive.rated_torque_nm, limits.torque_nm, limits.watchdog_s)
        try:
            watchdog_counts(device.watchdog, limits.watchdog_s)
            if device.objects.max_torque.writable:
                torque_limit_counts(device, settings)
        except ValueError as error:
            self.reasons.append(f"{drive.name}: {error}")
            return None
        radius_m = self._line.rollers[drive.roller - 1].radius_m.value
        return DriveNode(drive.name, drive.roller - 1, device, settings, radius_m)

    def _amplifiers(self) -> Iterable[tuple[tuple[str, int], str, Amplifier]]:
        """The load cells, one amplifier a unit."""
        units: dict[tuple[str, int, int, str], tuple[ModbusTcpBus, LoadCellMap, list[LoadCell]]] = {}
        for cell in self._line.load_cells:
            device = self._map_of(cell, "load_cells", LoadCellMap)
            bus = self._bus_of(cell, ModbusTcpBus, device)
            if device is None or bus is None:
                continue
            if cell.channel > device.channels.count:
                self.reasons.append(f"{cell.name}: channel {cell.channel}; allowed: 1 to {device.channels.count}")
                continue
            units.setdefault((bus.host, bus.port, cell.address, cell.map), (bus, device, []))[2].append(cell)
        for bus, device, cells in units.values():
            yield (bus.host, bus.port), bus.name, Amplifier(device, cells)

    def _plc(self) -> Iterable[tuple[tuple[str, int], str, Plc]]:
        plc = self._line.plc
        device = self._map_of(plc, "plc", PlcMap)
        bus = self._bus_of(plc, ModbusTcpBus, device)
        if device is not None and bus is not None:
            yield (bus.host, bus.port), bus.name, Plc(device, plc, self._line.limits.watchdog_s)

    def _map_of(self, item: Device, table: str, model: type[M]) -> M | None:
        """The map of a device, if it is of the kind that stands in `table`."""
        device = self._load(item)
        if device is None or isinstance(device, model):
            return device
        fitting = [name for name in map_names(self._folder) if isinstance(self._load_quietly(name), model)]
        self.reasons.append(
            f"{item.name}: map {item.map!r} is for a {device.role}, not for {table}; allowed: {', '.join(fitting)}"
        )
        return None

    def _load(self, item: Device) -> DeviceMap | None:
        if item.map in self._maps:
            return self._maps[item.map]
        self._maps[item.map] = None
        if item.map not in (known := map_names(self._folder)):
            near = nearest(item.map, known)
            hint = f"; did you mean {near!r}?" if near else ""
            self.reasons.append(f"{item.name}: map {item.map!r} is unknown; allowed: {', '.join(known)}{hint}")
            return None
        try:
            self._maps[item.map] = load_map(self._folder / f"{item.map}.toml")
        except MapRefused as refusal:
            self.reasons += refusal.reasons
        return self._maps[item.map]

    def _load_quietly(self, name: str) -> DeviceMap | None:
        try:
            return load_map(self._folder / f"{name}.toml")
        except MapRefused:
            return None

    def _bus_of(self, item: Device, kind: type[B], device: DeviceMap | None) -> B | None:
        bus = self._buses.get(item.bus)
        if bus is None:
            self.reasons.append(f"{item.name}: bus {item.bus!r} is unknown; allowed: {', '.join(self._buses)}")
        elif isinstance(bus, kind):
            return bus
        elif device is not None:
            self.reasons.append(
                f"{item.name}: map {item.map!r} speaks {device.protocol}, bus {bus.name!r} is {bus.protocol}"
            )
        return None
