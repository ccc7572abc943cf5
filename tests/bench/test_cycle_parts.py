"""What the timing bench is made of: pairs of files that fit each other, and how periods are counted."""

import tomllib
from pathlib import Path

import numpy as np
import pytest

from gateway.cli.line_commands import known_maps
from gateway.cli.plant_fit import misfits
from gateway.core.line import CanopenBus
from gateway.core.line_file import load_line
from sim_plant.plant import plant_of
from tests.bench.cycle import KINDS
from tests.bench.floor import overruns
from tests.bench.lines import WIRINGS, CanWire, Ports, line_text, plant_text

PORTS = Ports(43113, 5020, 4840)


@pytest.mark.parametrize("period_s", [0.004, 0.01, 0.05])
@pytest.mark.parametrize("kind", sorted(WIRINGS))
def test_every_pair_is_valid_and_fits(kind: str, period_s: float) -> None:
    wiring = WIRINGS[kind]
    line = load_line(line_text(wiring, period_s, PORTS), "line.toml", known_maps())
    plant = plant_of(tomllib.loads(plant_text(wiring)))
    assert line.control.period_s == line.control.latency_s == period_s
    assert not misfits(line, Path("line.toml"), plant, Path("plant.toml"))


def test_a_line_of_few_spans_on_a_socketcan_interface() -> None:
    can = CanWire("socketcan", "vcan0")
    line = load_line(line_text(WIRINGS["canopen"], 0.05, Ports(), can, spans=2), "line.toml", known_maps())
    plant = plant_of(tomllib.loads(plant_text(WIRINGS["canopen"], can, spans=2)))
    assert line.n == plant.spans == 2
    (bus,) = line.buses
    assert isinstance(bus, CanopenBus) and bus.interface == plant.wires.canopen.interface == "socketcan"


def test_wire_time_is_the_plants_alone() -> None:
    plant = plant_of(tomllib.loads(plant_text(WIRINGS["mixed"], CanWire(wire_time=True))))
    assert plant.wires.canopen.wire_time


def test_kinds_of_the_bench_are_wirings() -> None:
    assert set(KINDS) < set(WIRINGS)


def test_overruns_count_whole_periods_as_the_loop_does() -> None:
    assert overruns(np.array([20, 4_999, 5_000, 12_500]), 0.005) == 0 + 0 + 1 + 2
    assert overruns(np.empty(0, dtype=np.int64), 0.005) == 0
