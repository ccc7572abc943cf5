"""Predictive control in the judge: what its programme is put through, and what its plan keeps clear of."""

from dataclasses import replace
from math import inf, nan

import numpy as np
import pytest

from gateway.control.design import MpcWeights, design_mpc
from gateway.control.judged_courses import OTHERS_LOW, CornerCourses, corner_courses, programme_courses
from gateway.control.rollout import Rollouts, course_through, plants_of_thetas, simulate
from safety import corner_runs, programme
from safety.findings import told
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
        course = programme_courses(judged, 0.02 * programme.LASTING, 0.02 * programme.TAIL)[OTHERS_LOW]
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


def test_small_moves_are_no_larger_than_a_newton_and_two_millimetres_a_second(of, context, clear):
    case = case_of(gains(clear, context), context, of)
    assert case.tension_step_n > 1.0 and case.speed_step_m_per_s > 0.002
    courses = [one.course for one in programme.small_courses(case).values()]
    assert max(np.abs(np.diff(one.tension_n, axis=0)).max() for one in courses) == pytest.approx(1.0)
    assert max(np.abs(np.diff(one.unwind_speed_m_per_s)).max() for one in courses) == pytest.approx(0.002)


def test_changes_that_the_programme_makes_itself_last_two_seconds_and_are_looked_at_for_the_last_of_it(
    of, context, clear, monkeypatch
):
    courses: CornerCourses = {}
    monkeypatch.setattr(programme, "in_courses", lambda case, asked: courses.update(asked))
    programme.by_itself(case_of(gains(clear, context), context, of))
    assert {one.course.tail for one in courses.values()} == {60}
    lasting = {name: one.course.periods - one.course.changes[-2] for name, one in courses.items()}
    assert lasting["speed change"] == lasting[OTHERS_LOW] == 200


@pytest.mark.parametrize("kind", ["lqi", "mpc"])
def test_courses_of_either_kind_of_law_last_as_long_as_is_asked_and_have_no_tail_where_none_is(
    of, context, redesigned, clear, kind
):
    case = case_of(gains({"lqi": redesigned, "mpc": clear}[kind], context), context, of)
    judged = judged_of(case)

    def change_of(courses):
        return courses["speed change"].course.periods, courses["speed change"].course.tail

    # 0.3 s before the change, and a second at each speed; the tail is the end of the last one
    assert change_of(corner_runs.courses_through(case, judged, 1.0, 0.0)) == (230, 0)
    whole = corner_runs.courses_through(case, judged, 1.0, 0.5)
    assert change_of(whole) == (230, 50) and (OTHERS_LOW in whole) is (kind == "mpc")


def in_small_of(**figures):
    """Of seven plants; what is given is of one span of some of them, by their number, else 0."""
    found = {name: np.zeros((7, 6)) for name in ("swing", "chatter", "beyond")}
    for span, (name, values) in enumerate(figures.items()):
        for plant, value in values.items():
            found[name][plant, span] = value
    one = np.ones((7, 6))
    return Rollouts(one, one, one, one, found["beyond"], one, one, one, one, tail_swing_n=found["swing"],
                    tail_error_n=one, chatter_nm=found["chatter"])  # fmt: skip


@pytest.mark.parametrize(
    ("figures", "worst"),
    [
        ({"swing": {1: 3.0, 5: 1.0}, "chatter": {2: 4.0}, "beyond": {3: 5.0}}, [3, 2, 1, 5]),
        # What adds up is the sum, and one that is no number, or has run away, comes before any that is.
        ({"swing": {1: 3.0, 4: 0.9}, "chatter": {2: 4.0, 4: 0.9}, "beyond": {3: 5.0, 4: 0.9, 6: nan}}, [6, 3, 2, 1]),
        ({"swing": {1: 3.0, 4: 1.1}, "chatter": {2: 4.0, 4: 1.1}, "beyond": {3: 1.0, 4: 1.1, 5: inf}}, [5, 2, 4, 1]),
    ],
)
def test_the_programme_itself_runs_on_the_corners_where_small_moves_are_worst(
    of, context, clear, monkeypatch, figures, worst
):
    """On one of those that share a course out; where none is held, the other courses are looked at all the same."""
    case = case_of(gains(clear, context), context, of)
    stiffness = [2000.0 + i for i in range(7)]
    held = [replace(case.believed, web=replace(case.believed.web, stiffness_n=one)) for one in stiffness]
    course = programme_courses(judged_of(case))["speed change"]
    courses = {"held by none": course, "of all": course, "shared": replace(course, every=2)}
    monkeypatch.setattr(programme, "corners_held", lambda case: {"held by none": [], "of all": held, "shared": held})
    monkeypatch.setattr(programme, "in_small", lambda case: dict.fromkeys(("of all", "shared"), in_small_of(**figures)))
    whole = []

    def simulated(config, plants, asked, setup):
        assert config == clear and asked is course.course
        whole.append([stiffness.index(one) for one in plants.stiffness_n[:, 0]])
        return rollouts()

    monkeypatch.setattr(programme, "simulate", simulated)
    assert list(programme.in_courses(case, courses)) == ["of all", "shared"]
    assert whole == [worst, worst[:1]]


@pytest.mark.parametrize(
    ("figures", "fails"),
    [
        ({"low": 2.0, "high": 60.0, "swing": 1.0, "error": 3.0, "chatter": 5.0}, False),
        ({"low": 1.99}, True),
        ({"high": 60.01}, True),
        ({"swing": 1.01}, True),
        ({"error": 3.01}, True),
        ({"chatter": 5.01}, True),
    ],
)
def test_small_moves_fail_beyond_any_limit_and_not_at_it(of, context, clear, monkeypatch, figures, fails):
    monkeypatch.setattr(programme, "simulate", lambda *_: rollouts(**figures))
    assert programme.fails_in_small(case_of(gains(clear, context), context, of)) is fails


def test_where_small_moves_leave_the_band_large_ones_are_not_looked_at(of, context, clear, monkeypatch):
    monkeypatch.setattr(programme, "simulate", lambda *_: rollouts(low=1.9))
    case = case_of(gains(clear, context), context, of)
    monkeypatch.setattr(programme, "by_itself", lambda _: pytest.fail("large moves"))
    found = corners.check(case)
    assert "no large ones" in found[-1].text and refused(found)
    for rule in (roller_speed, paper):
        assert all("not looked at" in text for text in refused(rule.check(case)))
    assert {text.split(":")[1].split(",")[0] for text in refused(improvement.check(case))} == {" without end", " never"}


@pytest.mark.parametrize(
    ("fails", "lost"),
    [
        (True, "it is refused for its small moves: no large ones were looked at"),
        (
            False,
            "the programme itself was simulated on 4 corners, and for shorter; on the others only small moves, by the "
            "law that it is where no limit is reached: how it plans at its limits there has not been seen",
        ),
    ],
    ids=["refused before", "looked at"],
)
def test_what_was_not_looked_at_of_a_programme_is_told_and_is_nothing_against_it(
    of, context, clear, monkeypatch, fails, lost
):
    monkeypatch.setattr(programme, "fails_in_small", lambda _: fails)
    for name in ("in_small", "by_itself"):
        monkeypatch.setattr(programme, name, lambda _: {})
    found = corners.check(case_of(gains(clear, context), context, of))
    assert found[-1] == told("corners: what is lost", True, lost)


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
