"""Predictive control in the judge: what its programme is put through, and what its plan keeps clear of."""

from dataclasses import replace

import numpy as np
import pytest

from gateway.control.design import MpcWeights, design_mpc
from gateway.control.judged_courses import OTHERS_LOW, corner_courses, programme_courses
from gateway.control.rollout import course_through, plants_of_thetas, simulate
from safety import corner_runs, programme
from safety.rules import corners, improvement, paper, roller_speed
from safety.simulated import judged_of, setup_of
from tests.safety.case_support import case_of, gains, refused
from tests.safety.test_gate_corners import rollouts


@pytest.fixture(scope="module")
def clear(of):
    """As it is designed."""
    return design_mpc(of.task())


def riding(config):
    """The same with a plan down to the limits themselves, which it leaves more readily."""
    return config.model_copy(update={"tension_min_n": 2.0, "tension_max_n": 60.0, "weight_tension_limit": 10.0})


def test_a_plan_that_rides_the_limits_lets_spans_fall_that_stand_low_while_others_step(of, context, clear):
    def lowest_n(config):
        case = case_of(gains(config, context), context, of)
        judged = judged_of(case)
        course = programme_courses(judged, programme.LASTING_S, programme.TAIL_S)[OTHERS_LOW]
        assert OTHERS_LOW not in corner_courses(judged)
        return programme.in_courses(case, {OTHERS_LOW: course})[OTHERS_LOW].tension_min_n.min()

    assert lowest_n(riding(clear)) < of.line.limits.tension_min_n < lowest_n(clear) - 1.0


@pytest.mark.parametrize("tension_n", [3.1, 58.9])
def test_set_points_that_the_plan_keeps_clear_of_are_held(of, context, clear, tension_n):
    assert not clear.tension_min_n < tension_n < clear.tension_max_n
    case = case_of(gains(clear, context), context, of)
    course = course_through(0.01, [(2.5, np.full(6, tension_n), 0.05)], 1.5)
    found = simulate(clear, plants_of_thetas([case.believed]), course, setup_of(of.line, case.noise, 3, 0.0))
    assert found.tail_error_n.max() < 0.1 and found.tail_swing_n.max() < 0.6


def test_where_small_moves_leave_the_band_large_ones_are_not_looked_at(of, context, clear, monkeypatch):
    monkeypatch.setattr(programme, "simulate", lambda *_: rollouts(low=1.9))
    case = case_of(gains(clear, context), context, of)
    monkeypatch.setattr(programme, "by_itself", lambda _: pytest.fail("large moves"))
    found = corners.check(case)
    assert "no large ones" in found[-1].text and refused(found)
    for rule in (roller_speed, paper):
        assert all("not looked at" in text for text in refused(rule.check(case)))
    assert {text.split(":")[1].split(",")[0] for text in refused(improvement.check(case))} == {" without end", " never"}


def test_a_first_predictive_configuration_is_looked_at_on_all_corners(of, clear, monkeypatch):
    context = of.context(model=None, data=[])
    case, counts = case_of(gains(clear, context), context, of), []

    def counted(line, config, thetas, course, noise, seed):
        counts.append((config.kind, len(thetas)))
        return corner_runs.rollouts(line, config, thetas, course, noise, seed)

    monkeypatch.setattr(roller_speed, "rollouts", counted)
    found = roller_speed.steps_let(case)
    whole = [count for kind, count in counts[: len(found.share)] if kind == "lqg"]
    assert len(whole) == len(found.share) and max(whole) == len(case.corners)
    assert OTHERS_LOW in found.share


def test_rollers_of_a_programme_that_torque_holds_on_no_corner_are_refused_with_a_reason(of, context, clear):
    weak = of.line.model_copy(update={"limits": of.line.limits.model_copy(update={"torque_nm": 1.0})})
    found = roller_speed.check(replace(case_of(gains(clear, context), context, of), line=weak))
    assert "rollers run away, or none is held (speed change)" in refused(found)[0]


def test_weights_may_let_the_plan_leave_its_band_more_readily(of, clear):
    assert clear.weight_tension_limit == 100.0
    assert design_mpc(of.task(), MpcWeights(tension_limit_per_n2=1.0)).weight_tension_limit == 1.0


def test_a_linear_law_has_no_programme(case):
    assert not programme.fails_in_small(case)
    with pytest.raises(TypeError, match="lqi has no programme"):
        programme.in_small(case)
