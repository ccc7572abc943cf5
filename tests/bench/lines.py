"""Pairs of files for every way of wiring a line: LINE.toml for the gateway, PLANT.toml for the simulated line.

The process part of either is the demonstration's; only wires, devices and the period differ.
"""

from dataclasses import dataclass
from pathlib import Path

from gateway.core.line_template import line_template

PLANT = Path("sim_plant/plants/s_real.toml")
AMPLIFIER_NODE, CHANNELS_PER_NODE, PLC_NODE = 101, 8, 120
AMPLIFIER_UNIT, PLC_UNIT, RACK_UNIT, FIRST_DRIVE_UNIT = 1, 2, 3, 11


@dataclass(frozen=True, slots=True)
class Wiring:
    """On which wire each role is, in the words of the plant's [wires]: canopen, modbus-tcp, rack or opcua."""

    drives: str
    load_cells: str
    plc: str

    def uses(self, *words: str) -> bool:
        return bool({self.drives, self.load_cells, self.plc} & set(words))


WIRINGS = {
    "canopen": Wiring("canopen", "canopen", "canopen"),
    "modbus": Wiring("rack", "rack", "rack"),
    "opcua": Wiring("opcua", "opcua", "opcua"),
    "mixed": Wiring("canopen", "modbus-tcp", "opcua"),
    "demo": Wiring("canopen", "modbus-tcp", "modbus-tcp"),
}


@dataclass(frozen=True, slots=True)
class CanWire:
    """`wire_time`: whether a frame takes its time on the simulated bus."""

    interface: str = "udp_multicast"
    channel: str = "239.74.163.2"
    wire_time: bool = False


@dataclass(frozen=True, slots=True)
class Ports:
    """Where the wires are; None where there is no such wire."""

    can: int | None = None
    modbus: int | None = None
    opcua: int | None = None


UDP_MULTICAST = CanWire()


def plant_text(wiring: Wiring, can: CanWire = UDP_MULTICAST, spans: int = 6) -> str:
    """PLANT.toml. Ports are given to the simulated line's process."""
    process, _, _ = _parted(PLANT.read_text(encoding="utf-8"), "\n[wires]")
    before, _, after = _parted(process, "\nspans = 6\n")
    process = f"{before}\nspans = {spans}\n{after}"
    wires = f'drives = "{wiring.drives}"\nload_cells = "{wiring.load_cells}"\nplc = "{wiring.plc}"\n'
    bus = f'interface = "{can.interface}"\nchannel = "{can.channel}"\nwire_time = {str(can.wire_time).lower()}\n'
    return f"{process}\n[wires]\n{wires}\n[wires.canopen]\n{bus}"


def line_text(wiring: Wiring, period_s: float, ports: Ports, can: CanWire = UDP_MULTICAST, spans: int = 6) -> str:
    """LINE.toml, for a period and a latency of one period; a start waits for no warning: nobody is near."""
    text = line_template(spans)
    for key, value in (("period_s", period_s), ("latency_s", period_s), ("start_warning_s", 0.0)):
        before, _, after = _parted(text, f"\n{key} = ")
        text = f"{before}\n{key} = {value}\n{after.partition(chr(10))[2]}"
    process, _, rest = _parted(text, "\n# Buses:")
    _, history, rest = _parted(rest, "\n[history]")
    devices = [*_buses(wiring, ports, can), *_drives(wiring, spans), *_load_cells(wiring, spans), _plc(wiring)]
    return "\n".join([process, *devices]) + history + rest


def _parted(text: str, mark: str) -> tuple[str, str, str]:
    parts = text.partition(mark)
    if not parts[1]:
        raise ValueError(f"the text does not hold {mark!r} any more")
    return parts


def _table(head: str, **values: str | int | float | None) -> str:
    rows = [f'{key} = "{value}"' if isinstance(value, str) else f"{key} = {value}" for key, value in values.items()]
    return "\n".join([head, *(row for row in rows if not row.endswith("= None"))]) + "\n"


def _buses(wiring: Wiring, ports: Ports, can: CanWire) -> list[str]:
    buses: list[str] = []
    if wiring.uses("canopen"):
        bus = {"interface": can.interface, "channel": can.channel, "port": ports.can, "bitrate_bit_per_s": 1_000_000}
        buses.append(_table("[[buses]]", name="can", protocol="canopen", **bus))
    if wiring.uses("modbus-tcp", "rack"):
        buses.append(_table("[[buses]]", name="io", protocol="modbus-tcp", host="127.0.0.1", port=ports.modbus))
    if wiring.uses("opcua"):
        endpoint = f"opc.tcp://127.0.0.1:{ports.opcua}"
        buses.append(_table("[[buses]]", name="server", protocol="opcua", endpoint=endpoint))
    return buses


def _drives(wiring: Wiring, spans: int) -> list[str]:
    def wired(i: int) -> dict[str, str | int]:
        return {
            "canopen": {"bus": "can", "map": "cia402-torque", "address": i},
            "modbus-tcp": {"bus": "io", "map": "r2r-drive-modbus", "address": FIRST_DRIVE_UNIT + i - 1},
            "rack": {"bus": "io", "map": "r2r-rack-drive", "address": RACK_UNIT, "channel": i},
            "opcua": {"bus": "server", "map": "r2r-opcua-drive", "address": 1, "channel": i},
        }[wiring.drives]

    return [
        _table("[[drives]]", name=f"drive-{i}", **wired(i), roller=i, rated_torque_nm=60.0) for i in range(1, spans + 1)
    ]


def _load_cells(wiring: Wiring, spans: int) -> list[str]:
    def wired(i: int) -> dict[str, str | int]:
        node, channel = divmod(i - 1, CHANNELS_PER_NODE)
        return {
            "canopen": {"bus": "can", "map": "r2r-cell-can", "address": AMPLIFIER_NODE + node, "channel": channel + 1},
            "modbus-tcp": {"bus": "io", "map": "loadcell-amp", "address": AMPLIFIER_UNIT, "channel": i},
            "rack": {"bus": "io", "map": "r2r-rack-cells", "address": RACK_UNIT, "channel": i},
            "opcua": {"bus": "server", "map": "r2r-opcua-amplifier", "address": 1, "channel": i},
        }[wiring.load_cells]

    return [
        _table("[[load_cells]]", name=f"load-cell-{i}", **wired(i), span=i, capacity_n=100.0)
        for i in range(1, spans + 1)
    ]


def _plc(wiring: Wiring) -> str:
    wired: dict[str, str | int] = {
        "canopen": {"bus": "can", "map": "line-plc-can", "address": PLC_NODE},
        "modbus-tcp": {"bus": "io", "map": "line-plc", "address": PLC_UNIT},
        "rack": {"bus": "io", "map": "r2r-rack-plc", "address": RACK_UNIT},
        "opcua": {"bus": "server", "map": "r2r-opcua-plc", "address": 1},
    }[wiring.plc]
    return _table("[plc]", name="line-plc", **wired)
