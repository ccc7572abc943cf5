"""What a count of a drive's speed is worth, on every protocol."""

from math import pi

import numpy as np
import pytest

from drivers.registry import MAPS, speed_steps_m_per_s
from drivers.scaling import speed_step
from gateway.cli.line_commands import known_maps
from gateway.core.line_file import load_line
from tests.bench.lines import WIRINGS, Ports, line_text


@pytest.mark.parametrize(
    ("kind", "unit", "scale", "step_m_per_s"),
    [
        ("i32", "um/s", 1.0, 1e-6),
        ("i32", "rpm", 1.0, 2 * pi / 60 * 0.04),
        ("i16", "m/min", 0.1, 0.1 / 60),
        ("f32", "m/s", 1.0, 0.0),
        ("f64", "rad/s", 1.0, 0.0),
    ],
)
def test_what_a_count_is_worth(kind: str, unit: str, scale: float, step_m_per_s: float) -> None:
    assert speed_step(kind, unit, scale, radius_m=0.04) == pytest.approx(step_m_per_s)


@pytest.mark.parametrize(("wiring", "step_m_per_s"), [("canopen", 1e-6), ("modbus", 1e-6), ("opcua", 0.0)])
def test_every_protocol_tells_it_for_every_roller(wiring: str, step_m_per_s: float) -> None:
    line = load_line(line_text(WIRINGS[wiring], 0.01, Ports(1, 2, 3)), "line.toml", known_maps())
    assert speed_steps_m_per_s(line, MAPS) == pytest.approx(np.full(6, step_m_per_s))
