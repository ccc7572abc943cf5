"""From a line description to the links that carry it: device types are looked up, each protocol builds its links."""

from pathlib import Path

import numpy as np

from drivers.canopen import build as canopen
from drivers.canopen.map_drive import DriveMap as CanopenDriveMap
from drivers.device_map import MAPS, DeviceMap, MapRefused, load_map, map_names
from drivers.modbus import build as modbus
from drivers.modbus.maps import ModbusMap
from drivers.opcua import build as opcua
from drivers.opcua.maps import OpcUaMap
from drivers.port import Link
from drivers.scaling import speed_step, torque_step
from drivers.wiring import Builder, Wired
from gateway.core.drive_tells import DriveTells, profile_tells
from gateway.core.line import Drive, Line, LinePlc, LoadCell
from gateway.core.line_limits import motor_radius_m
from gateway.core.nearest import nearest
from gateway.core.signals import FloatArray

BUILDERS: dict[str, Builder] = {"canopen": canopen.build, "modbus-tcp": modbus.build, "opcua": opcua.build}

_ROLES = {Drive: ("drive", "drives"), LoadCell: ("load-cell", "load_cells"), LinePlc: ("line-plc", "plc")}


class LinksRefused(ValueError):
    """The line cannot be carried by the drivers. `reasons` name the device, what is allowed and the nearest."""

    def __init__(self, reasons: list[str]) -> None:
        super().__init__("; ".join(reasons))
        self.reasons = reasons


def build_links(line: Line, folder: Path = MAPS) -> list[Link]:
    """The links of every bus, not yet open, for a line that has passed its own checks.

    Raises LinksRefused with every reason.
    """
    wired, reasons = _Lookup(line, folder).devices()
    links: list[Link] = []
    for protocol, build in BUILDERS.items():
        built, refused = build(line, [device for device in wired if device.bus.protocol == protocol])
        links += built
        reasons += refused
    if reasons:
        raise LinksRefused(reasons)
    return links


def map_files(line: Line, folder: Path = MAPS) -> dict[str, bytes]:
    """The bytes of the files of every device map that the line names; of one that cannot be read, none."""
    found: dict[str, bytes] = {}
    for name in {item.map for item in (*line.drives, *line.load_cells, line.plc)}:
        try:
            found[name] = (folder / f"{name}.toml").read_bytes()
        except OSError:
            found[name] = b""
    return found


def speed_steps_m_per_s(line: Line, folder: Path = MAPS) -> FloatArray:
    """What one count of each drive's speed is worth (n,), for a line that `build_links` takes."""
    steps = np.zeros(line.n)
    for wired in _Lookup(line, folder).devices()[0]:
        if isinstance(wired.item, Drive) and wired.device.role == "drive":
            speed, i = wired.device.speed, wired.item.roller - 1
            steps[i] = speed_step(speed.type, speed.unit, speed.scale, motor_radius_m(line, wired.item))
    return steps


def drive_tells(line: Line, folder: Path = MAPS) -> DriveTells:
    """What each drive's answers are worth, by its map, for a line that `build_links` takes."""
    tells = profile_tells(line.n)
    for wired in _Lookup(line, folder).devices()[0]:
        drive, device = wired.item, wired.device
        if isinstance(drive, Drive) and device.role == "drive":
            i, rated_nm = drive.roller - 1, drive.rated_torque_nm
            tells.torque_step_nm[i] = (
                max(torque_step(t.type, t.unit, t.scale, rated_nm) for t in device.torques) * drive.gear
            )
            tells.mode[i] = tells.mode[i] if device.mode is None else device.mode
            tells.torque_accuracy[i], tells.torque_filter_s[i] = device.torque_accuracy, device.torque_filter_s
            tells.power_bit[i] = tells.power_bit[i] if device.voltage_enabled is None else device.voltage_enabled.bit
    return tells


def unseen(line: Line, folder: Path = MAPS) -> list[str]:
    """What cannot be seen of the line's drives because their maps do not say where, in words, each with its drives."""
    found: dict[str, list[str]] = {}
    for wired in _Lookup(line, folder).devices()[0]:
        if isinstance(wired.item, Drive) and wired.device.role == "drive":
            for what in wired.device.unseen:
                found.setdefault(what, []).append(wired.item.name)
    return [f"{', '.join(names)}: {what} cannot be seen" for what, names in found.items()]


def unnamed_reactions(line: Line, folder: Path = MAPS) -> list[str]:
    """Device maps that name no option code, each with its devices: what their watchdogs do, the drill alone shows."""
    found: dict[str, list[str]] = {}
    for wired in _Lookup(line, folder).devices()[0]:
        item, device = wired.item, wired.device
        if not isinstance(item, LoadCell) and not (isinstance(device, CanopenDriveMap) and device.names_reaction):
            found.setdefault(item.map, []).append(item.name)
    return [f"{name} ({', '.join(names)})" for name, names in found.items()]


def nameless(line: Line, folder: Path = MAPS) -> list[str]:
    """Devices whose maps name no serial number: nobody sees that one of them is exchanged. A CANopen node has 1018h."""
    wired = _Lookup(line, folder).devices()[0]
    return [
        each.item.name for each in wired if isinstance(each.device, ModbusMap | OpcUaMap) and each.device.serial is None
    ]


class _Lookup:
    """Finds bus and device type of every device, and collects the reasons why there is none."""

    def __init__(self, line: Line, folder: Path) -> None:
        self._line = line
        self._folder = folder
        self._maps: dict[str, DeviceMap | None] = {}
        self._buses = {bus.name: bus for bus in line.buses}
        self._reasons: list[str] = []

    def devices(self) -> tuple[list[Wired], list[str]]:
        items = [*self._line.drives, *self._line.load_cells, self._line.plc]
        found = [wired for item in items if (wired := self._wired(item)) is not None]
        return found, self._reasons

    def _wired(self, item: Drive | LoadCell | LinePlc) -> Wired | None:
        device = self._load(item)
        role, table = _ROLES[type(item)]
        if device is not None and device.role != role:
            fitting = [name for name in map_names(self._folder) if self._role_of(name) == role]
            self._reasons.append(
                f"{item.name}: map {item.map!r} is for a {device.role}, not for {table}; allowed: {', '.join(fitting)}"
            )
            device = None
        bus = self._buses.get(item.bus)
        if bus is None:
            self._reasons.append(f"{item.name}: bus {item.bus!r} is unknown; allowed: {', '.join(self._buses)}")
        elif device is not None and device.protocol != bus.protocol:
            self._reasons.append(
                f"{item.name}: map {item.map!r} speaks {device.protocol}, bus {bus.name!r} is {bus.protocol}"
            )
        elif device is not None:
            return Wired(item, bus, device)
        return None

    def _load(self, item: Drive | LoadCell | LinePlc) -> DeviceMap | None:
        if item.map in self._maps:
            return self._maps[item.map]
        self._maps[item.map] = None
        try:
            if item.map not in (known := map_names(self._folder)):
                near = nearest(item.map, known)
                hint = f"; did you mean {near!r}?" if near else ""
                self._reasons.append(f"{item.name}: map {item.map!r} is unknown; allowed: {', '.join(known)}{hint}")
                return None
            self._maps[item.map] = load_map(self._folder / f"{item.map}.toml")
        except MapRefused as refusal:
            self._reasons += refusal.reasons
        return self._maps[item.map]

    def _role_of(self, name: str) -> str:
        try:
            return load_map(self._folder / f"{name}.toml").role
        except MapRefused:
            return ""
