"""From the devices on Modbus TCP to their links: one a host and port, with one unit a unit identifier."""

from collections.abc import Sequence

from drivers.modbus.amplifier import Amplifier
from drivers.modbus.axis import Axis, axis_settings
from drivers.modbus.device import Device
from drivers.modbus.link import ModbusLink
from drivers.modbus.maps import DriveMap, LoadCellMap, ModbusMap, PlcMap
from drivers.modbus.plc import Plc
from drivers.modbus.unit import Unit
from drivers.port import Link
from drivers.wiring import Wired
from gateway.core.line import Drive, Line, LinePlc, LoadCell, ModbusTcpBus
from gateway.core.line_limits import motor_radius_m, motor_torque_limit_nm

Place = tuple[str, int]  #: host and port
Seat = tuple[Place, int, str]  #: with the unit identifier and what shares it: a family, or a device type


def build(line: Line, devices: Sequence[Wired]) -> tuple[list[Link], list[str]]:
    """See `drivers.wiring.Builder`."""
    seats: dict[Seat, list[Wired]] = {}
    names: dict[Place, str] = {}
    reasons: list[str] = []
    for wired in devices:
        assert isinstance(wired.bus, ModbusTcpBus) and isinstance(wired.device, ModbusMap)
        place = (wired.bus.host, wired.bus.port)
        names.setdefault(place, wired.bus.name)
        if reason := _channel_problem(wired):
            reasons.append(reason)
        else:
            seats.setdefault((place, wired.item.address, wired.device.family or wired.item.map), []).append(wired)
    units: dict[Place, list[Unit]] = {place: [] for place in names}
    for (place, address, _), of_seat in seats.items():
        try:
            units[place].append(_unit(line, address, of_seat))
        except ValueError as error:
            reasons.append(str(error))
    period_s = line.control.period_s
    return [ModbusLink(names[place], *place, of_place, period_s) for place, of_place in units.items()], reasons


def _channel_problem(wired: Wired) -> str:
    item, device = wired.item, wired.device
    count = 1
    if isinstance(device, LoadCellMap):
        count = device.channels.count
    elif isinstance(device, DriveMap) and device.axes is not None:
        count = device.axes.count
    if isinstance(item, LinePlc) or item.channel <= count:
        return ""
    return f"{item.name}: channel {item.channel}; allowed: 1 to {count}"


def _unit(line: Line, address: int, wired: Sequence[Wired]) -> Unit:
    """Raises ValueError, with the name of the device, when the line asks for what it cannot do."""
    maps = [of_one.device for of_one in wired if isinstance(of_one.device, ModbusMap)]
    functions = sorted({device.read_function for device in maps})
    if len(functions) > 1:
        names = ", ".join(of_one.item.name for of_one in wired)
        raise ValueError(f"{names}: share unit {address}, and their maps differ in read_function")
    together = functions == [3] and all(device.function_23 for device in maps)
    return Unit(address, functions[0], _devices(line, wired), together)


def _devices(line: Line, wired: Sequence[Wired]) -> list[Device]:
    """One for each drive and PLC, and one for all cells of an amplifier, in the order of the line's file."""
    devices: list[Device] = []
    amplifiers: set[str] = set()
    for of_one in wired:
        item, device = of_one.item, of_one.device
        if isinstance(item, LoadCell) and isinstance(device, LoadCellMap) and item.map not in amplifiers:
            amplifiers.add(item.map)
            cells = [other.item for other in wired if isinstance(other.item, LoadCell)]
            devices.append(Amplifier(device, [cell for cell in cells if cell.map == item.map]))
        elif isinstance(item, Drive) and isinstance(device, DriveMap):
            devices.append(_axis(line, item, device))
        elif isinstance(item, LinePlc) and isinstance(device, PlcMap):
            devices.append(_plc(line, item, device))
    return devices


def _axis(line: Line, drive: Drive, device: DriveMap) -> Axis:
    radius_m = motor_radius_m(line, drive)
    try:
        torque_nm, watchdog_s = motor_torque_limit_nm(line, drive), line.limits.watchdog_s
        return Axis(drive.name, drive.roller - 1, device, axis_settings(drive, torque_nm, watchdog_s, radius_m))
    except ValueError as error:
        raise ValueError(f"{drive.name}: {error}") from error


def _plc(line: Line, plc: LinePlc, device: PlcMap) -> Plc:
    try:
        return Plc(device, plc, line.limits.watchdog_s)
    except ValueError as error:
        raise ValueError(f"{plc.name}: {error}") from error
