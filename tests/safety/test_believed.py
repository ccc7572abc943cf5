"""What is believed of a line: by its file, for a first configuration, or by intervals where there is no posterior."""

from math import exp

import numpy as np
import pytest

from gateway.core.line_model import LineModel, ModelInterval
from safety.believed import Unbelievable, posterior_of, prior_corners
from tests.closed_loop.conftest import demo_line
from tests.safety.case_support import published

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


def with_intervals(**deviations: float) -> LineModel:
    """Of logarithms by name, each around 1, with as many standard deviations as 95 per cent are; no posterior."""
    intervals = {
        name: ModelInterval(value=1.0, low=exp(-1.96 * one), high=exp(1.96 * one)) for name, one in deviations.items()
    }
    return published().model.model_copy(update={"posterior": None, "intervals": intervals})


def test_intervals_of_single_rollers_stand_in_for_a_posterior_and_combinations_do_not() -> None:
    """The names are those of the model's file, with the number of the roller or span."""
    by_number = [f"{name}[{i}]" for name in ("length_m", "radius_m", "inertia_kg_m2") for i in range(1, 7)]
    each = {name: 0.01 * place for place, name in enumerate(by_number, 1)}
    all_of = {"stiffness_n": 0.1, "friction_nms_per_rad": 0.2}
    found = posterior_of(with_intervals(**all_of, **each, friction_per_inertia=0.5, latency_s=0.6))
    assert found.names == [*all_of, *each]
    assert np.array(found.covariance) == pytest.approx(np.diag([0.01, 0.04, *(1e-4 * np.arange(1, 19) ** 2)]))


@pytest.mark.parametrize("left_out", [1, 6])
def test_an_interval_of_one_roller_says_nothing_of_the_others(left_out: int) -> None:
    known = {"stiffness_n": 0.1, "length_m": 0.1, "inertia_kg_m2": 0.1, "friction_nms_per_rad": 0.1}
    radii = {f"radius_m[{i}]": 0.1 for i in range(1, 7)}
    assert posterior_of(with_intervals(**known, **radii)).names == [*known, *radii]
    del radii[f"radius_m[{left_out}]"]
    with pytest.raises(Unbelievable, match="an interval of radius_m:"):
        posterior_of(with_intervals(**known, **radii))


def test_what_neither_a_posterior_nor_an_interval_above_0_tells_of_is_named() -> None:
    def said(model: LineModel) -> str:
        with pytest.raises(Unbelievable) as told:
            posterior_of(model)
        return str(told.value)

    known = {"stiffness_n": 0.1, "length_m": 0.1, "inertia_kg_m2": 0.1, "friction_nms_per_rad": 0.1}
    assert said(with_intervals(**known)) == (
        "the model has neither a posterior nor an interval of radius_m: nobody knows how wrong it may be; "
        "identify again"
    )
    assert "interval of stiffness_n, length_m, inertia_kg_m2, friction_nms_per_rad:" in said(
        with_intervals(**{f"radius_m[{i}]": 0.1 for i in range(1, 7)})
    )
    down_to_0 = with_intervals(**known, radius_m=0.1)
    down_to_0.intervals["length_m"] = ModelInterval(value=1.0, low=0.0, high=2.0)
    down_to_0.intervals["radius_m"] = ModelInterval(value=1.0, low=0.0, high=2.0)
    assert said(down_to_0) == (
        "the model has neither a posterior nor an interval of length_m, radius_m: nobody knows how wrong it may be; "
        "identify again"
    )
