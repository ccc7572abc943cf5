"""How the loop is closed around plants, and which plants no controller could hold."""

import numpy as np
import pytest

from gateway.control.judged_courses import CornerCourse
from gateway.control.rollout import Course, Setup, course_through
from gateway.core.theta import Noise, Theta
from gateway.core.web_model import WebModel
from safety.simulated import held, holdable, setup_of
from tests.closed_loop.conftest import demo_line

LINE = demo_line()
LEVEL = (20.0, 20.0, 20.0)


def plant(radius_m: float = 0.5, friction_nms_per_rad: float = 0.0, coulomb_nm: float = 0.0) -> Theta:
    """Of three spans, with 20 N before and behind them; at `LEVEL` the web asks for no torque."""
    one = np.ones(3)
    web = WebModel(2000.0, one, radius_m * one, one, friction_nms_per_rad * one, 20.0, 20.0)
    return Theta(web, coulomb_nm * one, 0.0, 0.01)


def through(*parts: tuple[int, tuple[float, ...], float]) -> Course:
    """Each for so many periods at so many newtons and metres a second."""
    return course_through(0.01, [(0.01 * periods, np.array(level), speed) for periods, level, speed in parts])


def test_the_loop_is_that_of_the_line_and_latency_that_of_the_plants() -> None:
    assert setup_of(LINE, Noise(0.2, 3e-4, 4e-3), seed=7, late_share=0.05) == Setup(
        period_s=0.01, latency_s=0.0, substeps=2, torque_nm=60.0, torque_rate_nm_per_s=1000.0, tension_noise_n=0.2,
        speed_noise_m_per_s=3e-4, acceleration_m_per_s1_5=4e-3, seed=7, late_share=0.05,
    )  # fmt: skip


@pytest.mark.parametrize(
    ("longest_step_s", "substeps"), [(0.02, 1), (0.01, 1), (0.0099, 2), (0.005, 2), (0.0049, 3), (0.001, 10)]
)
def test_a_period_is_integrated_in_one_step_or_in_as_many_as_are_short_enough(
    longest_step_s: float, substeps: int
) -> None:
    assert setup_of(LINE, Noise(), 1, 0.0, longest_step_s).substeps == substeps


@pytest.mark.parametrize("at", [0, 1, 2])
def test_torque_has_to_hold_wherever_a_course_stands_even_for_a_single_period(at: int) -> None:
    """The last roller needs 0.5 m * (50 N - 20 N) = 15 Nm there, and nothing elsewhere."""
    levels = [LEVEL, LEVEL, LEVEL]
    levels[at] = (20.0, 20.0, 50.0)
    course, one = through(*((1, level, 0.05) for level in levels)), plant()
    assert holdable([one], course, 16.0) == [one]
    assert holdable([one], course, 15.0) == []


def test_each_roller_needs_the_difference_of_the_spans_that_it_lies_between() -> None:
    """0.5 m times 10 - 30, 30 - 20 and 20 - 20 N: 10 Nm at the most, as 0.95 of 10.6 Nm are."""
    course, one = through((5, (10.0, 30.0, 20.0), 0.05)), plant()
    assert holdable([one], course, 10.6) == [one]
    assert holdable([one], course, 10.5) == []


def test_torque_may_be_needed_up_to_the_share_that_is_looked_at_and_no_further() -> None:
    """0.5 m * 38 N = 19 Nm, 0.95 of 20 Nm."""
    assert len(holdable([plant()], through((5, (20.0, 20.0, 58.0), 0.05)), 20.0)) == 1
    assert holdable([plant()], through((5, (20.0, 20.0, 58.01), 0.05)), 20.0) == []


def test_a_small_drive_holds_what_asks_for_little() -> None:
    """0.01 m * 38 N = 0.38 Nm."""
    course = through((5, (20.0, 20.0, 58.0), 0.05))
    assert len(holdable([plant(radius_m=0.01)], course, 0.41)) == 1
    assert holdable([plant(radius_m=0.01)], course, 0.39) == []


@pytest.mark.parametrize(("speed_m_per_s", "needed_nm"), [(0.05, 5.0), (-0.05, 5.0), (0.0, 0.0)])
def test_friction_needs_torque_against_the_way_that_rollers_turn_and_none_at_standstill(
    speed_m_per_s: float, needed_nm: float
) -> None:
    """3 Nm of Coulomb friction, and 20 Nms/rad * 0.05 m/s / 0.5 m = 2 Nm."""
    course, one = through((5, LEVEL, speed_m_per_s)), plant(friction_nms_per_rad=20.0, coulomb_nm=3.0)
    assert holdable([one], course, (needed_nm + 0.01) / 0.95) == [one]
    assert holdable([one], course, (needed_nm - 0.01) / 0.95) == []


def test_where_torque_holds_none_that_a_course_is_for_one_that_it_holds_stands_in() -> None:
    course = through((5, (20.0, 20.0, 50.0), 0.05))
    weak, strong, other = plant(radius_m=2.0), plant(), plant(radius_m=0.4)
    shared = CornerCourse(course, first=0, every=3)
    assert held([strong, weak, other], shared, 20.0) == [strong]
    assert held([weak, strong, other], shared, 20.0) == [strong]
    assert held([weak, strong, other], CornerCourse(course), 20.0) == [strong, other]
    assert held([weak, weak, weak], shared, 20.0) == []
