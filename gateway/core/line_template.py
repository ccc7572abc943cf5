"""The commented line description that `init` writes: a demonstration line, valid as it is, to be filled in."""

from math import ceil

from gateway.core.can_load import ODD_LOAD, fitting_buses
from gateway.core.line_help import HELP

_PERIOD_S = 0.010
_BITRATE_BIT_PER_S = 1_000_000
_TENSION_N = (28, 36, 20, 40, 24, 32)
_MULTICAST_PORT = 43113
_COMMENT_COLUMN = 38
MOST_SPANS = 60

_HEAD = """\
# Line description for r2rgate. SI units throughout; every unit is in the key's name.
# Fill in what differs on your line, then: r2rgate check {out}
#
#   unwinder ~~span 1~~ roller 1{more}
#
# Rollers and spans are numbered by their order in this file. Span i lies between roller i-1 and roller i; roller 0
# is the unwinder: the line PLC drives it, and it is not listed.
"""


def line_template(spans: int = 6, out: str = "line.toml") -> str:
    """The text of a valid line description with `spans` spans, 1 to 60; `out` is the file's name in its comments.

    Raises ValueError for another number of spans.
    """
    if not 1 <= spans <= MOST_SPANS:
        raise ValueError(f"a line has 1 to {MOST_SPANS} spans, not {spans}")
    buses = fitting_buses(spans, _BITRATE_BIT_PER_S, _PERIOD_S, most=ODD_LOAD) or 1
    more = {1: "", 2: " ~~span 2~~ roller 2"}.get(spans, f" ~~span 2~~ ... ~~span {spans}~~ roller {spans}")
    parts = [_HEAD.format(more=more, out=out), _line(spans), _process(spans), _web()]
    parts += [_rollers(spans), _spans(spans), _buses(buses), _drives(spans, buses), _load_cells(spans), _plc()]
    return "\n".join([*parts, _history(), _recipes(spans)])


def _entries(model: str, values: dict[str, str]) -> str:
    """`key = value  # help` for every key; a value that begins with # comments its key out."""
    lines: list[str] = []
    for key, value in values.items():
        entry = f"# {key} = {value[1:]}" if value.startswith("#") else f"{key} = {value}"
        lines.append(f"{entry:<{_COMMENT_COLUMN}}  # {HELP[model][key]}\n")
    return "".join(lines)


def _plain(values: dict[str, str]) -> str:
    return "".join(f"{key} = {value}\n" for key, value in values.items())


def _table(key: str, model: str, values: dict[str, str]) -> str:
    return f"[{key}]  # {HELP['Line'][key]}\n{_entries(model, values)}"


def _tables(key: str, model: str, entries: list[dict[str, str]], comment: str = "") -> str:
    """An array of tables: the first with the help to every key, the others bare."""
    first, *others = entries
    text = f"# {key.replace('_', ' ').capitalize()}: {HELP['Line'][key]}.\n{comment}[[{key}]]\n{_entries(model, first)}"
    return text + "".join(f"\n[[{key}]]\n{_plain(entry)}" for entry in others)


def _parameter(value: str, tolerance: str) -> str:
    return f"{{ value = {value}, tolerance = {tolerance} }}"


def _line(spans: int) -> str:
    description = f'"Demonstration line with {spans} span{"s" if spans > 1 else ""}, simulated"'
    return _entries("Line", {"format": "1", "site": '"demo"', "line": '"line-1"', "description": description})


def _process(spans: int) -> str:
    # Tensioning all spans at once pulls the last roller at rate * sum(L) / (E A): at most half the greatest speed.
    tension_rate = min(20.0, 0.5 * 0.12 * 2400.0 / spans)
    control = {"period_s": "0.010", "latency_s": "0.010", "cpu": "#1", "priority": "60"}
    limits = {
        "torque_nm": "60.0",
        "torque_rate_nm_per_s": "1000.0",
        "tension_min_n": "2.0",
        "tension_max_n": "60.0",
        "tension_margin_n": "1.0",
        "speed_max_m_per_s": "0.12",
        "tension_step_max_n": "24.0",
        "speed_step_max_m_per_s": "0.09",
        "hold_periods": "3",
        "watchdog_s": "0.1",
        "stuck_s": "0.9",
        "tensioning_time_s": "20.0" if spans <= 20 else "40.0",
    }
    moves = {
        "tension_rate_n_per_s": f"{tension_rate:.1f}",
        "speed_rate_m_per_s2": "0.05",
        "stop_rate_m_per_s2": "0.1",
        "stop_time_s": "10.0",
        "torque_off_rate_nm_per_s": "200.0",
    }
    tables = [_table("control", "Control", control), _table("limits", "Limits", limits)]
    return "\n".join([*tables, _table("moves", "Moves", moves)])


def _web() -> str:
    parameters = (
        "# Physical parameters carry a tolerance, the fraction by which the truth may lie from the value either way.\n"
        "# Be honest: a wide tolerance costs little, a truth outside of it much. Identification narrows it later.\n"
    )
    web = {"stiffness_n": _parameter("2400.0", "0.3"), "tension_before_n": "0.0", "tension_after_n": "0.0"}
    return parameters + _table("web", "Web", web)


def _rollers(spans: int) -> str:
    return _tables(
        "rollers",
        "Roller",
        [
            {
                "name": f'"roller-{i}"',
                "radius_m": _parameter("0.04", "0.2"),
                "inertia_kg_m2": _parameter("0.95", "0.3"),
                "friction_nms_per_rad": _parameter("10.0", "0.75"),
            }
            for i in range(1, spans + 1)
        ],
    )


def _spans(spans: int) -> str:
    return _tables(
        "spans",
        "Span",
        [
            {"name": f'"span-{i}"', "length_m": _parameter("1.0", "0.3"), "control": '"tension"'}
            for i in range(1, spans + 1)
        ],
    )


def _drive_bus(drive: int, buses: int, spans: int) -> tuple[str, int]:
    """Name of the bus and node of a drive (from 0): neighbours on one bus, as the cable runs."""
    bus, position = divmod(drive, ceil(spans / buses))
    return ("drives" if buses == 1 else f"drives-{bus + 1}"), position + 1


def _buses(buses: int) -> str:
    canopen = [
        {
            "name": '"drives"' if buses == 1 else f'"drives-{i + 1}"',
            "protocol": '"canopen"',
            "interface": '"udp_multicast"',
            "channel": '"239.74.163.2"',
            "port": str(_MULTICAST_PORT + i),
            "bitrate_bit_per_s": f"{_BITRATE_BIT_PER_S:_}",
        }
        for i in range(buses)
    ]
    modbus = {"name": '"io"', "protocol": '"modbus-tcp"', "host": '"127.0.0.1"', "port": "5020"}
    real = (
        '# A CAN card is interface = "socketcan" with channel = "can0" and no port. Modbus TCP is mostly on port 502.\n'
        "# A CAN bus carries what fits into a period: check says how much of it that is.\n"
    )
    opcua = {
        "name": '#"server"',
        "protocol": '#"opcua"',
        "endpoint": '#"opc.tcp://127.0.0.1:4840"',
        "security": '#"none"',
        "certificate": '#"/etc/r2rgate/pki/gateway.der"',
        "private_key": '#"/etc/r2rgate/pki/gateway-key.pem"',
        "server_certificate": '#"/etc/r2rgate/pki/server.der"',
    }
    return (
        _tables("buses", "CanopenBus", canopen, real)
        + f"\n[[buses]]\n{_entries('ModbusTcpBus', modbus)}"
        + f"\n# [[buses]]\n{_entries('OpcUaBus', opcua)}"
    )


def _drives(spans: int, buses: int) -> str:
    drives: list[dict[str, str]] = []
    for i in range(spans):
        bus, node = _drive_bus(i, buses, spans)
        drives.append(
            {
                "name": f'"drive-{i + 1}"',
                "bus": f'"{bus}"',
                "map": '"cia402-torque"',
                "address": str(node),
                **({} if i else {"channel": "#1"}),
                "roller": str(i + 1),
                "rated_torque_nm": "60.0",
            }
        )
    return _tables("drives", "Drive", drives)


def _load_cells(spans: int) -> str:
    return _tables(
        "load_cells",
        "LoadCell",
        [
            {
                "name": f'"load-cell-{i}"',
                "bus": '"io"',
                "map": '"loadcell-amp"',
                "address": "1",
                "channel": str(i),
                "span": str(i),
                "capacity_n": "100.0",
            }
            for i in range(1, spans + 1)
        ],
    )


def _plc() -> str:
    return _table("plc", "LinePlc", {"name": '"line-plc"', "bus": '"io"', "map": '"line-plc"', "address": "2"})


def _history() -> str:
    return _table("history", "History", {"keep_days": "90.0", "keep_gb": "20.0", "keep_events_days": "3650.0"})


def _recipes(spans: int) -> str:
    tension_n = ", ".join(f"{_TENSION_N[i % len(_TENSION_N)]:.1f}" for i in range(spans))
    level_n = ", ".join(["30.0"] * spans)
    return _tables(
        "recipes",
        "Recipe",
        [
            {"name": '"tension"', "tension_n": f"[{tension_n}]", "speed_m_per_s": "0.01"},
            {"name": '"velocity"', "tension_n": f"[{level_n}]", "speed_m_per_s": "0.01"},
        ],
    )
