"""The wires of the line template: which device is on which, in any mix of what the simulated line offers."""

from dataclasses import dataclass
from math import ceil
from typing import Literal

from gateway.core.can_load import ODD_LOAD, fitting_buses
from gateway.core.line_template_tables import array, entries, heading, table, tables

#: A rack is one Modbus TCP unit that carries drives, load cells and line control of a small line.
Wire = Literal["canopen", "modbus-tcp", "opcua", "rack"]

MOST_SPANS_OF_RACK = 14
_PERIOD_S = 0.010
_BITRATE_BIT_PER_S = 1_000_000
_MULTICAST_PORT = 43113
_SPANS_ON_ONE_BUS = 8  #: of which a CAN bus carries drives, load cells and PLC
_AMPLIFIER_NODE, _CHANNELS_PER_NODE, _PLC_NODE = 101, 8, 120
_AMPLIFIER_UNIT, _PLC_UNIT, _RACK_UNIT, _FIRST_DRIVE_UNIT = 1, 2, 3, 11

Values = dict[str, str]


@dataclass(frozen=True, slots=True)
class Wiring:
    """On which wire each role is."""

    drives: Wire = "canopen"
    load_cells: Wire = "modbus-tcp"
    plc: Wire = "modbus-tcp"

    def uses(self, *wires: Wire) -> bool:
        return any(wire in wires for wire in (self.drives, self.load_cells, self.plc))


DEMONSTRATION = Wiring()


def wired_tables(wiring: Wiring, spans: int) -> list[str]:
    """Buses, drives, load cells and PLC. Raises ValueError for a rack with too many spans."""
    if wiring.uses("rack") and spans > MOST_SPANS_OF_RACK:
        raise ValueError(f"a rack carries at most {MOST_SPANS_OF_RACK} spans, not {spans}: use several kinds of wire")
    can_buses = fitting_buses(spans, _BITRATE_BIT_PER_S, _PERIOD_S, most=ODD_LOAD) or 1
    # Other nodes are on the drives' bus where there is room, else on one of their own.
    can = "drives" if wiring.drives == "canopen" and spans <= _SPANS_ON_ONE_BUS else "can"
    drives = _drives(wiring, spans, can_buses)
    return [_buses(wiring, can_buses, can), drives, _load_cells(wiring, spans, can), _plc(wiring, can)]


def _buses(wiring: Wiring, can_buses: int, can: str) -> str:
    real = (
        '# A CAN card is interface = "socketcan" with channel = "can0" and no port. Modbus TCP is mostly on port 502.\n'
        "# A CAN bus carries what fits into a period: check says how much of it that is.\n"
    )
    can_tables = [_can_bus(_can_name(i, can_buses), i) for i in range(can_buses)] if wiring.drives == "canopen" else []
    if can == "can" and "canopen" in (wiring.load_cells, wiring.plc):
        can_tables.append(_can_bus(can, len(can_tables)))
    kinds: list[tuple[str, list[Values]]] = [
        ("CanopenBus", can_tables),
        ("ModbusTcpBus", [_MODBUS] if wiring.uses("modbus-tcp", "rack") else []),
        ("OpcUaBus", [_OPCUA] if wiring.uses("opcua") else []),
    ]
    parts = [array("buses", model, buses) for model, buses in kinds if buses]
    unused = [_commented(model, _EXAMPLES[model]) for model, buses in kinds if not buses]
    return heading("buses") + real + "\n".join([*parts, *unused])


def _can_bus(name: str, number: int) -> Values:
    return {
        "name": f'"{name}"',
        "protocol": '"canopen"',
        "interface": '"udp_multicast"',
        "channel": '"239.74.163.2"',
        "port": str(_MULTICAST_PORT + number),
        "bitrate_bit_per_s": f"{_BITRATE_BIT_PER_S:_}",
    }


_MODBUS: Values = {"name": '"io"', "protocol": '"modbus-tcp"', "host": '"127.0.0.1"', "port": "5020"}
_OPCUA: Values = {
    "name": '"server"',
    "protocol": '"opcua"',
    "endpoint": '"opc.tcp://127.0.0.1:4840"',
    "security": '"none"',
    "certificate": '#"/etc/r2rgate/pki/gateway.der"',
    "private_key": '#"/etc/r2rgate/pki/gateway-key.pem"',
    "server_certificate": '#"/etc/r2rgate/pki/server.der"',
}
_EXAMPLES = {"CanopenBus": _can_bus("drives", 0), "ModbusTcpBus": _MODBUS, "OpcUaBus": _OPCUA}


def _commented(model: str, values: Values) -> str:
    """A table as an example only."""
    return "# [[buses]]\n" + entries(model, {key: f"#{value.removeprefix('#')}" for key, value in values.items()})


def _can_name(number: int, buses: int) -> str:
    return "drives" if buses == 1 else f"drives-{number + 1}"


def _drives(wiring: Wiring, spans: int, can_buses: int) -> str:
    def wired(i: int) -> Values:
        match wiring.drives:
            case "canopen":  # neighbours on one bus, as the cable runs
                bus, position = divmod(i, ceil(spans / can_buses))
                return _wired(_can_name(bus, can_buses), "cia402-torque", position + 1)
            case "modbus-tcp":
                return _wired("io", "r2r-drive-modbus", _FIRST_DRIVE_UNIT + i)
            case "rack":
                return _wired("io", "r2r-rack-drive", _RACK_UNIT, i + 1)
            case "opcua":
                return _wired("server", "r2r-opcua-drive", 1, i + 1)

    def drive(i: int) -> Values:
        example = {} if i or "channel" in wired(i) else {"channel": "#1"}
        # Light rollers with stiff bearings: they stand at once. A reel or a heavy roller wants its brake.
        brake = {} if i else {"braking_torque_nm": "#60.0", "braking_power_w": "#500.0", "braking_energy_j": "#5000.0"}
        return {
            "name": f'"drive-{i + 1}"',
            **wired(i),
            **example,
            "roller": str(i + 1),
            "rated_torque_nm": "60.0",
            **({} if i else {"direction": '#"reversed"', "gear": "#1.0"}),
            **brake,
        }

    return tables("drives", "Drive", [drive(i) for i in range(spans)])


def _load_cells(wiring: Wiring, spans: int, can: str) -> str:
    def wired(i: int) -> Values:
        match wiring.load_cells:
            case "canopen":
                node, channel = divmod(i, _CHANNELS_PER_NODE)
                return _wired(can, "r2r-cell-can", _AMPLIFIER_NODE + node, channel + 1)
            case "modbus-tcp":
                return _wired("io", "loadcell-amp", _AMPLIFIER_UNIT, i + 1)
            case "rack":
                return _wired("io", "r2r-rack-cells", _RACK_UNIT, i + 1)
            case "opcua":
                return _wired("server", "r2r-opcua-amplifier", 1, i + 1)

    cells = [
        {
            "name": f'"load-cell-{i + 1}"',
            **wired(i),
            "span": str(i + 1),
            "capacity_n": "100.0",
            **({} if i else {"sign": '#"inverted"'}),
        }
        for i in range(spans)
    ]
    return tables("load_cells", "LoadCell", cells)


def _plc(wiring: Wiring, can: str) -> str:
    wired: dict[Wire, Values] = {
        "canopen": _wired(can, "line-plc-can", _PLC_NODE),
        "modbus-tcp": _wired("io", "line-plc", _PLC_UNIT),
        "rack": _wired("io", "r2r-rack-plc", _RACK_UNIT),
        "opcua": _wired("server", "r2r-opcua-plc", 1),
    }
    return table("plc", "LinePlc", {"name": '"line-plc"', **wired[wiring.plc], "speed_lag_s": "#0.02"})


def _wired(bus: str, device: str, address: int, channel: int | None = None) -> Values:
    values = {"bus": f'"{bus}"', "map": f'"{device}"', "address": str(address)}
    return values if channel is None else {**values, "channel": str(channel)}
