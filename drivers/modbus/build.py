"""From the devices on Modbus TCP to their links: one a host and port."""

from collections.abc import Sequence

from drivers.modbus.amplifier import Amplifier
from drivers.modbus.link import Device, ModbusLink
from drivers.modbus.maps import LoadCellMap, PlcMap
from drivers.modbus.plc import Plc
from drivers.port import Link
from drivers.wiring import Wired
from gateway.core.line import Line, LinePlc, LoadCell, ModbusTcpBus

Place = tuple[str, int]  #: host and port


def build(line: Line, devices: Sequence[Wired]) -> tuple[list[Link], list[str]]:
    """See `drivers.wiring.Builder`."""
    places: dict[Place, list[Device]] = {}
    names: dict[Place, str] = {}
    reasons: list[str] = []
    amplifiers: dict[tuple[Place, int, str], tuple[LoadCellMap, list[LoadCell]]] = {}
    for wired in devices:
        item, bus, device = wired.item, wired.bus, wired.device
        assert isinstance(bus, ModbusTcpBus)
        place = (bus.host, bus.port)
        names.setdefault(place, bus.name)
        places.setdefault(place, [])
        if isinstance(item, LoadCell) and isinstance(device, LoadCellMap):
            if item.channel > device.channels.count:
                reasons.append(f"{item.name}: channel {item.channel}; allowed: 1 to {device.channels.count}")
            else:
                amplifiers.setdefault((place, item.address, item.map), (device, []))[1].append(item)
        if isinstance(item, LinePlc) and isinstance(device, PlcMap):
            places[place].append(Plc(device, item, line.limits.watchdog_s))
    for (place, _, _), (device, cells) in amplifiers.items():
        places[place].insert(0, Amplifier(device, cells))
    period_s = line.control.period_s
    return [ModbusLink(names[place], *place, of_place, period_s) for place, of_place in places.items()], reasons
