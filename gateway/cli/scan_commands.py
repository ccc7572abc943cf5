"""`r2rgate scan`: who is on a bus, before there is a line's file. Reads only, whatever is found."""

import json
import sys
from collections.abc import Mapping
from dataclasses import asdict
from ipaddress import ip_address
from math import isfinite
from typing import Annotated, Any, Literal, NoReturn, TypeVar, get_args

import typer
from rich.console import Console, RenderableType

from drivers.device_map import Maps, load_maps
from gateway.cli.scan_view import can_scan, modbus_scan, opcua_scan, register_table
from gateway.cli.waiting import progress, run_until_done
from gateway.core.line import CanopenBus
from gateway.core.line_problem import printable
from gateway.core.line_rules_opcua import host_and_port
from gateway.mailbox.listener import living
from gateway.mailbox.paths import LOOP_SOCKET, running_lines

NOTHING_FOUND, REFUSED, LOOP_RUNS = 1, 2, 3
_LAST_UNIT = 255
_BITRATES: tuple[int, ...] = get_args(CanopenBus.model_fields["bitrate_bit_per_s"].annotation)

app = typer.Typer(
    name="scan",
    help="Who is on a bus: CANopen nodes, Modbus units, OPC UA servers, and which device maps fit. Reads only.",
    no_args_is_help=True,
)

Json = Annotated[bool, typer.Option("--json", help="Print as JSON.")]
OtherBus = Annotated[
    bool, typer.Option("--other-bus", help="A loop runs on this computer, and this is none of its buses.")
]
M = TypeVar("M")


@app.command()
def canopen(
    interface: Annotated[
        Literal["socketcan", "udp_multicast", "virtual"], typer.Option(help="As python-can names it.")
    ] = "socketcan",
    channel: Annotated[str, typer.Option(help="can0, or the multicast group.")] = "can0",
    port: Annotated[int | None, typer.Option(min=1, max=65535, help="udp_multicast only.")] = None,
    bitrate: Annotated[int, typer.Option(help="bit/s, for the load; a CAN card has its own set with `ip link`.")] = (
        1_000_000
    ),
    seconds: Annotated[float, typer.Option(min=0.1, max=600.0, help="How long to listen before asking.")] = 2.0,
    other_bus: OtherBus = False,
    as_json: Json = False,
) -> None:
    """Listen, then ask nodes 1 to 127 what they are (SDO upload of 1000h, 1008h to 100Ah, 1018h).

    Nobody is asked where a master is heard: listening is all then. Exit code: 0 nodes found, 1 none, 2 refused, 3 a
    loop runs here.

    Example: r2rgate scan canopen --interface socketcan --channel can0
    """
    from drivers.canopen.maps import CanMap
    from drivers.canopen.scan import scan

    if bitrate not in _BITRATES:
        _refuse(f"--bitrate {bitrate}; allowed: {', '.join(map(str, _BITRATES))}")
    if port is not None and interface != "udp_multicast":
        _refuse(f"--port is of udp_multicast; {interface} has none")
    if interface == "udp_multicast" and not _is_multicast(channel):
        _refuse(f"--channel {printable(channel)} is no multicast group, which udp_multicast needs; as 239.74.163.2")
    _require_no_loop(other_bus)
    config = CanopenBus.model_validate(
        {
            "name": "scan",
            "protocol": "canopen",
            "interface": interface,
            "channel": channel,
            "port": port,
            "bitrate_bit_per_s": bitrate,
        }
    )
    where = f"{interface} {channel}" + (f":{port}" if port is not None else "")
    maps = _load_maps()
    try:
        with progress() as tell:
            found = run_until_done(scan(config, seconds, _maps_of(CanMap, maps), tell))
    except OSError as error:
        _nothing(str(error))
    if as_json:
        frames = {
            f"{cob_id:03X}h": {"count": seen.count, "rate_hz": seen.rate_hz}
            for cob_id, seen in sorted(found.listening.frames.items())
        }
        nodes = [asdict(node) for node in found.nodes]
        _print_json(
            {
                "bus": where,
                "listened_s": found.listened_s,
                "load": found.load,
                "nodes": nodes,
                "frames": frames,
                "not_asked": found.not_asked,
                "errors": found.errors,
                "unusable_maps": _unusable(maps),
            }
        )
    else:
        _print(can_scan(where, bitrate, found))
    if not found.nodes and not found.listening.frames:
        if interface != "socketcan":
            _nothing(
                f"nobody on {where}: is the simulated line running, on this channel"
                + (
                    " and in this process, beyond which virtual does not reach?"
                    if interface == "virtual"
                    else " and port?"
                )
            )
        _nothing(
            f"nobody on {where}: is the device on, is this its bit rate ({bitrate} bit/s), is the cable plugged and "
            "terminated at both ends (60 ohms between CAN-H and CAN-L), is the interface up (`ip -details link`)?"
        )
    raise typer.Exit(0 if found.nodes else NOTHING_FOUND)


@app.command("modbus-tcp", hidden=True)
@app.command()
def modbus(
    host: Annotated[str, typer.Argument(help="Name or address.")],
    port: Annotated[int, typer.Option(min=1, max=65535)] = 502,
    units: Annotated[str, typer.Option(help="Unit identifiers, as 1-16,255.")] = "1-16,255",
    register: Annotated[
        int | None, typer.Option(min=0, max=65535, help="Show this register in every way of reading it.")
    ] = None,
    count: Annotated[int, typer.Option(min=1, max=60, help="So many registers, with --register.")] = 1,
    function: Annotated[
        Literal["3", "4"] | None, typer.Option(help="With --register; both are tried where it is left out.")
    ] = None,
    other_bus: OtherBus = False,
    as_json: Json = False,
) -> None:
    """Which units answer, to which functions, and which device maps fit; or what a register holds.

    Exit code: 0 found, 1 nothing, 2 refused, 3 a loop runs here.

    Examples: r2rgate scan modbus 192.168.1.20; r2rgate scan modbus 192.168.1.20 --units 1 --register 16 --count 2
    """
    from drivers.modbus.client import ModbusFailed
    from drivers.modbus.maps import ModbusMap
    from drivers.modbus.scan import FUNCTIONS, registers, scan, usual_float

    numbers = _numbers(units)
    name, colon, last = host.partition(":")
    if colon and last.isdecimal():
        _refuse(f"{printable(host)}: say the port by itself: {printable(name)} --port {last}")
    _require_no_loop(other_bus)
    if register is None:
        maps = _load_maps()
        with progress() as tell:
            found = run_until_done(scan(host, port, numbers, _maps_of(ModbusMap, maps), tell))
        if as_json:
            _print_json({**asdict(found), "unusable_maps": _unusable(maps)})
        elif found.units:
            _print(modbus_scan(found))
        if not found.connected:
            _nothing(
                f"no connection to {found.where}: is it on, is this its address and port, does `ping {printable(host)}`"
                " answer, does a firewall stand between, or has it no connection left (close other tools)?"
            )
        if not found.units:
            _nothing(f"{found.where} takes connections, but none of the units {units} answers; try --units 0-255")
        return
    unit = numbers[0]
    try:
        used, rows = run_until_done(
            registers(host, port, unit, register, count, (int(function),) if function else FUNCTIONS)
        )
    except ModbusFailed as error:
        _nothing(f"unit {unit} at {host}:{port} gives nothing of register {register}: {error}")
    if as_json:
        values = [
            {
                "register": row.register,
                "reading": row.reading,
                "from_zero": _in_json(row.zero),
                "from_one": _in_json(row.one),
                "usual_from_zero": usual_float(row, row.zero),
                "usual_from_one": usual_float(row, row.one),
            }
            for row in rows
        ]
        _print_json({"unit": unit, "function": used, "rows": values})
    else:
        _print(register_table(unit, used, rows))


@app.command()
def opcua(
    endpoint: Annotated[str, typer.Argument(help="opc.tcp://HOST:PORT")],
    under: Annotated[str, typer.Option(help="Variables below this node only, as ns=2;s=Name or i=85.")] = "",
    most: Annotated[int, typer.Option(min=1, max=5000, help="At most so many variables.")] = 200,
    other_bus: OtherBus = False,
    as_json: Json = False,
) -> None:
    """Endpoints with their security, namespaces, variables with values, and which device maps fit.

    Exit code: 0 a server answers, 1 none, 2 refused, 3 a loop runs here.

    Example: r2rgate scan opcua opc.tcp://192.168.1.30:4840 --under "ns=2;s=Axis1"
    """
    if host_and_port(endpoint)[1] is None:
        _refuse(f"{printable(endpoint)} is no endpoint; allowed: opc.tcp://HOST:PORT, with a path or without")
    _require_no_loop(other_bus)
    from drivers.opcua.maps import OpcUaMap
    from drivers.opcua.scan import ScanFailed, is_node_id, scan

    if under and not is_node_id(under):
        _refuse(f"--under {printable(under)} is no node; allowed: as ns=2;s=Name or i=85")
    maps = _load_maps()
    try:
        with progress() as tell:
            found = run_until_done(scan(endpoint, under, _maps_of(OpcUaMap, maps), tell, most))
    except ScanFailed as error:
        _nothing(
            f"{endpoint}: {printable(str(error))}: is the server on, is this its address and port, does a firewall "
            "stand between?"
        )
    if as_json:
        _print_json({**asdict(found), "unusable_maps": _unusable(maps)})
    else:
        _print(opcua_scan(found))


def _maps_of(kind: type[M], maps: Maps) -> Mapping[str, M]:
    """The usable maps of one protocol by name."""
    return {name: device for name, device in maps.usable.items() if isinstance(device, kind)}


def _load_maps() -> Maps:
    """All maps; what is wrong with those that cannot be used goes to standard error, and the scan goes on."""
    maps = load_maps()
    for reason in _unusable(maps):
        print(f"this device map is not usable, and not compared: {reason}", file=sys.stderr)
    return maps


def _unusable(maps: Maps) -> list[str]:
    return [str(problem) for problems in maps.unusable.values() for problem in problems]


def _is_multicast(channel: str) -> bool:
    try:
        return ip_address(channel).is_multicast
    except ValueError:
        return False


def _numbers(units: str) -> list[int]:
    """1-3,255 as [1, 2, 3, 255], each once."""
    numbers: dict[int, None] = {}
    for part in units.split(","):
        first, dash, last = part.strip().partition("-")
        if not first.isdecimal() or (dash and not last.isdecimal()):
            _refuse(f"--units {printable(units)}: {part.strip()!r} is no number and no range; allowed: as 1-16,255")
        low, high = int(first), int(last if dash else first)
        if not low <= high <= _LAST_UNIT:
            _refuse(f"--units {printable(units)}: {part.strip()!r}; allowed: 0 to {_LAST_UNIT}, rising")
        numbers |= dict.fromkeys(range(low, high + 1))
    return list(numbers)


def _require_no_loop(other_bus: bool) -> None:
    """Devices that a loop commands are left alone: many take few connections, and one SDO client."""
    loops = [folder for folder in running_lines() if living(folder / LOOP_SOCKET)]
    if loops and not other_bus:
        print(
            f"a loop runs on this computer ({loops[0]}), and a scan could disturb its devices: end it first, ask "
            "`r2rgate doctor LINE.toml` what it says of them, or say --other-bus if this is none of its buses",
            file=sys.stderr,
        )
        raise typer.Exit(LOOP_RUNS)


def _in_json(value: int | float | None) -> int | float | str | None:
    """JSON has no NaN and no infinity: they are told as text."""
    return str(value) if isinstance(value, float) and not isfinite(value) else value


def _print(shown: RenderableType) -> None:
    Console(highlight=False).print(shown)


def _print_json(found: Any) -> None:
    typer.echo(json.dumps(found, indent=2))


def _nothing(text: str) -> NoReturn:
    print(text, file=sys.stderr)
    raise typer.Exit(NOTHING_FOUND)


def _refuse(text: str) -> NoReturn:
    print(text, file=sys.stderr)
    raise typer.Exit(REFUSED)
