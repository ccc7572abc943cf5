"""Rules about what is wired to what: rollers, spans, devices, buses, addresses, device types."""

from collections.abc import Iterable, Iterator, Mapping, Sequence
from ipaddress import ip_address

from gateway.core import can_load
from gateway.core.line import Bus, CanopenBus, Device, Drive, Line, LoadCell, ModbusTcpBus, OpcUaBus
from gateway.core.line_problem import Finding, Problem, key_in_words, odd
from gateway.core.line_rules_opcua import host_and_port, is_host, opcua_endpoint, opcua_security
from gateway.core.nearest import nearest
from gateway.core.toml_places import Path

#: Protocol, role and family of a device type: ("canopen", "drive", ""), ("modbus-tcp", "load-cell", "r2r-rack").
#: Devices of one family may share an address; "" is none.
Role = tuple[str, str, str]
_UNKNOWN: Role = ("", "", "")
_ROLES = {"drives": "drive", "load_cells": "load-cell", "plc": "line-plc"}


def devices(line: Line) -> list[tuple[Path, Device]]:
    """Every device with its path."""
    found: list[tuple[Path, Device]] = [(("drives", i), drive) for i, drive in enumerate(line.drives)]
    found += [(("load_cells", i), cell) for i, cell in enumerate(line.load_cells)]
    return [*found, (("plc",), line.plc)]


def rollers_match_spans(line: Line) -> Iterator[Finding]:
    if len(line.rollers) != len(line.spans):
        yield Finding(
            ("rollers",),
            f"{len(line.rollers)} rollers and {len(line.spans)} spans",
            "one [[rollers]] table per [[spans]] table: span i ends at roller i",
        )


def one_drive_per_roller(line: Line) -> Iterator[Finding]:
    driven: dict[int, Path] = {}
    bare = [roller for roller in range(1, len(line.rollers) + 1) if all(d.roller != roller for d in line.drives)]
    for i, drive in enumerate(line.drives):
        path = ("drives", i, "roller")
        if drive.roller > len(line.rollers):
            yield _no_such(path, "roller", len(line.rollers), bare)
        elif drive.roller in driven:
            taken = f"roller {drive.roller} already has a drive, {key_in_words(driven[drive.roller])}"
            yield Finding(path, taken, "one drive per roller", _first(bare))
        driven.setdefault(drive.roller, ("drives", i))
    for roller in bare:
        yield Finding(
            ("rollers", roller - 1), f"roller {roller} has no drive", f"a [[drives]] table with roller = {roller}"
        )


def one_load_cell_per_span(line: Line) -> Iterator[Finding]:
    """A draw span may have a load cell: it is shown, but nothing depends on it."""
    measured: dict[int, Path] = {}
    bare = [i + 1 for i, s in enumerate(line.spans) if s.control == "tension" and not _measured(line, i + 1)]
    for i, cell in enumerate(line.load_cells):
        path = ("load_cells", i, "span")
        if cell.span > len(line.spans):
            yield _no_such(path, "span", len(line.spans), bare)
        elif cell.span in measured:
            taken = f"span {cell.span} already has a load cell, {key_in_words(measured[cell.span])}"
            yield Finding(path, taken, "one load cell per span", _first(bare))
        elif line.spans[cell.span - 1].control == "draw":
            yield odd(path, f"span {cell.span} is draw-controlled: this load cell only indicates")
        measured.setdefault(cell.span, ("load_cells", i))
    for span in bare:
        yield Finding(
            ("spans", span - 1),
            f"span {span} has no load cell",
            f'a [[load_cells]] table with span = {span}, or control = "draw" on this span',
        )


def _measured(line: Line, span: int) -> bool:
    return any(cell.span == span for cell in line.load_cells)


def _no_such(path: Path, what: str, count: int, bare: list[int]) -> Finding:
    allowed = f"1 to {count}, in the order of the [[{what}s]] tables"
    return Finding(path, f"there is no such {what}", allowed, _first(bare) or str(count))


def _first(numbers: Iterable[int]) -> str:
    return next(map(str, numbers), "")


def unique_names(table: str, line: Line) -> Iterator[Finding]:
    """No two of a table's entries have the same name."""
    named = [((table, i), entry.name) for i, entry in enumerate(getattr(line, table))]
    return _unique(named, f"each of the [[{table}]] its own name")


def unique_device_names(line: Line) -> Iterator[Finding]:
    return _unique([(path, device.name) for path, device in devices(line)], "each device its own name")


def _unique(named: Iterable[tuple[Path, str]], allowed: str) -> Iterator[Finding]:
    first: dict[str, Path] = {}
    for path, name in named:
        if name in first:
            yield Finding((*path, "name"), f"is already the name of {key_in_words(first[name])}", allowed)
        first.setdefault(name, path)


def buses_exist(line: Line) -> Iterator[Finding]:
    names = [bus.name for bus in line.buses]
    for path, device in devices(line):
        if device.bus not in names:
            like = nearest(device.bus, names)
            yield Finding(
                (*path, "bus"),
                "there is no such bus",
                "one of " + ", ".join(f'"{name}"' for name in names),
                f'"{like}"' if like else "",
            )


def buses_are_used(line: Line) -> Iterator[Finding]:
    used = {device.bus for _, device in devices(line)}
    if used - {bus.name for bus in line.buses}:
        return  # a mistyped name, which is another rule's, would make its bus look idle
    for i, bus in enumerate(line.buses):
        if bus.name not in used:
            yield Finding(("buses", i, "name"), "no device is on this bus", "a bus that some device names, or no table")


def addresses_differ(line: Line, known_maps: Mapping[str, Role] | None = None) -> Iterator[Finding]:
    """Load cells share the unit of their amplifier and differ in the channel, as do the drives and the load cells of
    one family; all else has an address of its own.

    Where maps are known, a device whose map is none for its kind is left out: it may share an address once that
    mistake, which is another rule's, is mended.
    """
    seats: dict[tuple[str, int], list[tuple[Path, Device]]] = {}
    for path, device in devices(line):
        if known_maps is not None and known_maps.get(device.map, _UNKNOWN)[1] != _ROLES[str(path[0])]:
            continue
        seat = seats.setdefault((device.bus, device.address), [])
        finding = _clash(path, device, seat, line, known_maps or {})
        if finding is not None:
            yield finding
        seat.append((path, device))


def _clash(
    path: Path, device: Device, seat: list[tuple[Path, Device]], line: Line, known_maps: Mapping[str, Role]
) -> Finding | None:
    for other_path, other in seat:
        if _share(device, other, known_maps):
            if type(device) is not type(other) or _channel_of(device) != _channel_of(other):
                continue
            place = (device.bus, device.address)
            alike = [known for _, known in devices(line) if type(known) is type(device)]
            used = {_channel_of(known) for known in alike if (known.bus, known.address) == place}
            taken = f"is already the channel of {key_in_words(other_path)}"
            free = _first(channel for channel in range(1, 61) if channel not in used)
            return Finding((*path, "channel"), taken, "each its own channel of the device they share", free)
        used = {known.address for _, known in devices(line) if known.bus == device.bus}
        taken = f'is already the address of {key_in_words(other_path)} on bus "{device.bus}"'
        free = _first(address for address in range(1, 128) if address not in used)
        return Finding((*path, "address"), taken, "each device its own address on its bus", free)
    return None


def _share(device: Device, other: Device, known_maps: Mapping[str, Role]) -> bool:
    """Whether both are channels of one device (load cells of an amplifier, axes of a drive) or of one family."""
    family = known_maps.get(device.map, _UNKNOWN)[2]
    if family and family == known_maps.get(other.map, _UNKNOWN)[2]:
        return True
    one_device = type(device) is type(other) and device.map == other.map
    return one_device and (isinstance(device, LoadCell) or (_channel_of(device), _channel_of(other)) != (1, 1))


def _channel_of(device: Device) -> int:
    return device.channel if isinstance(device, Drive | LoadCell) else 1


def canopen_addresses(line: Line) -> Iterator[Finding]:
    canopen = {bus.name for bus in line.buses if isinstance(bus, CanopenBus)}
    for path, device in devices(line):
        if device.bus in canopen and device.address > 127:
            yield Finding((*path, "address"), "is no CANopen node", "a whole number from 1 to 127 on a CANopen bus")


def maps_fit(
    line: Line, known_maps: Mapping[str, Role], unusable_maps: Mapping[str, Sequence[Problem]] | None = None
) -> Iterator[Finding]:
    """The map of every device exists, can be used, speaks the protocol of its bus, and is for its kind of device."""
    protocols = {bus.name: bus.protocol for bus in line.buses}
    for path, device in devices(line):
        role, protocol = _ROLES[str(path[0])], protocols.get(device.bus)
        fitting = [name for name in sorted(known_maps) if _map_fits(known_maps[name], role, protocol)]
        if device.map in fitting:
            continue
        if unusable := (unusable_maps or {}).get(device.map):
            mend = "mend the map, or name another" + (f": {', '.join(fitting)}" if fitting else "")
            yield Finding((*path, "map"), f"this map has mistakes: {'; '.join(map(str, unusable))}", mend)
            continue
        known = known_maps.get(device.map)
        wrong = "there is no such map" if known is None else f"is a map for a {known[1]} on {known[0]}"
        names = ", ".join(f'"{name}"' for name in fitting) or "none is known"
        allowed = f"for a {role} on {protocol or 'any bus'}: {names}"
        like = nearest(device.map, fitting) or next(iter(fitting), "")
        yield Finding((*path, "map"), wrong, allowed, f'"{like}"' if like else "")


def _map_fits(known: Role, role: str, protocol: str | None) -> bool:
    """A bus that does not exist, which is another rule's, fits every protocol."""
    return known[1] == role and protocol in (known[0], None)


def buses_are_reachable(line: Line) -> Iterator[Finding]:
    """What a bus needs to be found, and no two tables for one wire."""
    wires: dict[tuple[str, str, int | None], Path] = {}
    for i, bus in enumerate(line.buses):
        path = ("buses", i)
        yield from _reach(bus, path)
        key, wire = _wire(bus)
        if wire in wires:
            yield Finding((*path, key), f"is the same wire as {key_in_words(wires[wire])}", "one table per wire")
        wires.setdefault(wire, path)


def _reach(bus: Bus, path: Path) -> Iterator[Finding]:
    match bus:
        case CanopenBus():
            yield from _channel(bus, path)
        case ModbusTcpBus():
            yield from _host(bus, path)
        case OpcUaBus():
            yield from opcua_endpoint(bus, path)
            yield from opcua_security(bus, path)


def _wire(bus: Bus) -> tuple[str, tuple[str, str, int | None]]:
    """What tells two wires apart, and the key that says it."""
    match bus:
        case CanopenBus():
            return "channel", (bus.interface, bus.channel, bus.port)
        case ModbusTcpBus():
            return "host", (bus.protocol, bus.host, bus.port)
        case OpcUaBus():
            return "endpoint", (bus.protocol, *host_and_port(bus.endpoint))


def _host(bus: ModbusTcpBus, path: Path) -> Iterator[Finding]:
    if not is_host(bus.host):
        host = bus.host.split("://")[-1].split("/")[0].strip()
        plain = f'"{host}"' if host and host != bus.host else ""
        yield Finding((*path, "host"), "is no host", 'an address or a name, as "192.168.0.10"', plain)


def _channel(bus: CanopenBus, path: Path) -> Iterator[Finding]:
    if bus.interface == "udp_multicast":
        if not _is_multicast(bus.channel):
            allowed = "224.0.0.0 to 239.255.255.255, or ff00:: and following"
            yield Finding((*path, "channel"), "is no multicast address", allowed, '"239.74.163.2"')
        if bus.port is None:
            yield Finding((*path, "port"), "is missing", "a whole number from 1 to 65535 (udp_multicast needs it)")
    elif bus.port is not None:
        yield Finding((*path, "port"), f'interface "{bus.interface}" has no port', "no such key")
    if bus.interface == "socketcan" and not (0 < len(bus.channel) <= 15 and bus.channel.isalnum()):
        yield Finding((*path, "channel"), "is no CAN network interface", 'its name, as "can0"', '"can0"')
    if bus.interface == "virtual" and not bus.channel:
        yield Finding((*path, "channel"), "is empty", "any name, the same on both sides")


def _is_multicast(address: str) -> bool:
    try:
        return ip_address(address).is_multicast
    except ValueError:
        return False


def can_buses_have_room(line: Line) -> Iterator[Finding]:
    for i, bus in enumerate(line.buses):
        if isinstance(bus, CanopenBus):
            load = can_load.bus_load(line, bus)
            path = ("buses", i, "bitrate_bit_per_s")
            says = f"the bus is loaded to {load:.0%} at a period of {1e3 * line.control.period_s:g} ms"
            if load > can_load.REFUSED_LOAD:
                yield Finding(path, says, f"at most {can_load.REFUSED_LOAD:.0%}: {_what_fits(line, bus)}")
            elif load > can_load.ODD_LOAD:
                yield odd(path, f"{says}; above {can_load.REFUSED_LOAD:.0%} it would be refused", _what_fits(line, bus))


def _what_fits(line: Line, bus: CanopenBus) -> str:
    drives, others = can_load.bus_devices(line, bus)
    ways: list[str] = []
    if bus.bitrate_bit_per_s < 1_000_000:
        ways.append("a higher bitrate")
    period = can_load.fitting_period_s(drives, others, bus.bitrate_bit_per_s)
    if period is not None and period > line.control.period_s:
        ways.append(f"control.period_s = {period:g} or longer")
    buses = can_load.fitting_buses(drives, bus.bitrate_bit_per_s, line.control.period_s)
    if buses is not None and buses > 1:
        ways.append(f"the drives spread over {buses} buses")
    return ", or ".join(ways) or "fewer devices on this bus"
