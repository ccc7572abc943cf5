"""Virtual lines of every wiring. The client of OPC UA lives in the line's own event loop: time is not its process's."""

from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory
from unittest.mock import patch

from drivers.opcua.build import build_on
from drivers.opcua.inprocess import EngineChannel
from drivers.port import Link
from drivers.registry import BUILDERS, build_links
from gateway.cli.line_commands import known_maps
from gateway.core.line import Line
from gateway.core.line_file import load_line
from sim_plant.plant import Plant, load_plant
from tests.bench.faults_rows import T
from tests.bench.lines import WIRINGS, Ports, line_text, plant_text
from tests.closed_loop.conftest import demo_line
from tests.closed_loop.virtual_line import VirtualLine

DEMO = "demo"


def virtual_line(wiring: str, seed: int, start_warning_s: float = 0.0, watchdog_s: float | None = None) -> VirtualLine:
    """Not yet entered. `wiring` is one of `lines.WIRINGS`. Frames of OPC UA cannot be touched there.

    `watchdog_s` None: as a line's file has it when nobody has set it.
    """
    if wiring == DEMO:
        return VirtualLine(_with_watchdog(demo_line(), watchdog_s), seed=seed)
    plant = _plant(wiring)
    wires = plant.wires
    ports = Ports(wires.canopen.port, wires.modbus.port, wires.opcua.port)
    line = load_line(line_text(WIRINGS[wiring], T, ports), "line.toml", known_maps())
    stages = line.stages.model_copy(update={"start_warning_s": start_warning_s})
    line = _with_watchdog(line.model_copy(update={"stages": stages}), watchdog_s)
    return VirtualLine(line, plant, seed=seed, build=_links)


def _with_watchdog(line: Line, watchdog_s: float | None) -> Line:
    if watchdog_s is None:
        return line
    return line.model_copy(update={"limits": line.limits.model_copy(update={"watchdog_s": watchdog_s})})


def _plant(wiring: str) -> Plant:
    with TemporaryDirectory() as folder:
        file = Path(folder) / "plant.toml"
        file.write_text(plant_text(WIRINGS[wiring]), encoding="utf-8")
        return load_plant(str(file))


def _links(line: Line) -> list[Link]:
    with patch.dict(BUILDERS, {"opcua": partial(build_on, channel=EngineChannel)}):
        return build_links(line)
