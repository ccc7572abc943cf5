"""The plants that a first configuration is simulated on, which only the line's file speaks for."""

import numpy as np
import pytest

from safety.believed import prior_corners
from tests.closed_loop.conftest import demo_line

LINE = demo_line()
SHARE = LINE.gate.first_corner_share


def test_corners_of_the_lines_file_are_a_share_of_its_tolerances_away_either_way() -> None:
    rollers, spans = LINE.rollers, LINE.spans
    of_line = {
        "stiffness_n": [LINE.web.stiffness_n],
        "length_m": [span.length_m for span in spans],
        "radius_m": [roller.radius_m for roller in rollers],
        "inertia_kg_m2": [roller.inertia_kg_m2 for roller in rollers],
        "friction_nms_per_rad": [roller.friction_nms_per_rad for roller in rollers],
    }
    plants = prior_corners(LINE, 0.013, seed=1)
    assert 0.0 < SHARE < 1.0 and len(plants) == LINE.gate.corners
    for name, parameters in of_line.items():
        values = np.array([one.value for one in parameters])
        far = SHARE * np.array([one.tolerance for one in parameters])
        sides = set[float]()
        for plant in plants:
            away = (np.atleast_1d(getattr(plant.web, name)) / values - 1.0) / far
            assert away == pytest.approx(np.full(len(away), np.sign(away[0]))), name
            sides.add(float(np.sign(away[0])))
        assert sides == {-1.0, 1.0}, name


def test_corners_of_the_lines_file_leave_friction_and_lag_to_the_stress_and_take_the_latency_that_is_known() -> None:
    for plant in prior_corners(LINE, 0.013, seed=1):
        assert (plant.latency_s, plant.torque_lag_s, plant.coulomb_nm.tolist()) == (0.013, 0.0, [0.0] * 6)
