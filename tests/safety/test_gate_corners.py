"""Rules that simulate the corners of what is believed, and the paper's criterion on them."""

from dataclasses import replace
from math import inf, nan

import numpy as np
import pytest

from gateway.control.design import MpcWeights, design_lqi, design_mpc
from gateway.control.judged_courses import corner_courses, improvement_courses, programme_courses
from gateway.control.rollout import Rollouts
from gateway.core.line_scales import line_scales
from gateway.loop.setpoints import STEP_PAUSE
from safety import corner_runs, programme
from safety.findings import at_least, at_most, told
from safety.rules import corners, paper, roller_speed
from safety.rules.corners import Worst
from safety.simulated import holdable, judged_of, stressed
from tests.safety.case_support import case_of, gains, refused


def rollouts(low=3.0, high=59.0, swing=0.9, error=2.9, chatter=4.9):
    one = np.ones((1, 6))
    return Rollouts(one, low * one, high * one, one, one, one, one, one, one, tail_swing_n=swing * one,
                    tail_error_n=error * one, chatter_nm=chatter * one)  # fmt: skip


def test_corners_at_each_limit(of, context, redesigned, monkeypatch):
    case = case_of(gains(redesigned, context), context, of)

    def found(**figures):
        monkeypatch.setattr(corner_runs, "rollouts", lambda *_: rollouts(**figures))
        return [one.rule for one in corners.check(replace(case)) if not one.passed]

    assert found() == []
    assert found(low=2.0, high=60.0, swing=1.0, error=3.0, chatter=5.0) == []
    assert found(low=1.99) == ["corners: lowest tension"]
    assert found(high=60.01) == ["corners: highest tension"]
    assert found(swing=1.01) == ["corners: oscillation"]
    assert found(error=3.01) == ["corners: error"]
    assert found(chatter=5.01) == ["corners: chatter"]
    assert len(found(low=-inf, high=inf, swing=inf, error=inf, chatter=inf)) == 5
    assert len(found(low=nan, high=nan, swing=nan, error=nan, chatter=nan)) == 5


def test_corners_that_nobody_could_hold_are_left_out_and_told(of, context, redesigned):
    case = case_of(gains(redesigned, context), context, of)
    plants, courses = [stressed(theta, of.line.gate) for theta in case.corners], corner_courses(judged_of(case))

    def kept(torque_nm):
        return [len(holdable(plants, one.course, torque_nm)) for one in courses.values()]

    some_nm = next(torque for torque in np.arange(20.0, 40.0, 0.02).tolist() if min(kept(torque)) > 0)
    assert min(kept(some_nm)) < 8
    weak = of.line.limits.model_copy(update={"torque_nm": some_nm})
    text = corners.check(replace(case, line=of.line.model_copy(update={"limits": weak})))[-1].text
    assert "left out, because no controller holds them with 2" in text
    none = of.line.limits.model_copy(update={"torque_nm": 5.0})
    assert (
        "none of 8 plants" in refused(corners.check(replace(case, line=of.line.model_copy(update={"limits": none}))))[0]
    )


@pytest.mark.parametrize("together", [1.0, 2.5, 4.0, 60.0])
def test_no_course_asks_for_more_than_the_loop_permits(case, together):
    limits = case.line.limits.model_copy(update={"steps_together": together})
    judged = replace(judged_of(case), line=case.line.model_copy(update={"limits": limits}))
    pause, most_n = line_scales(case.line).periods(STEP_PAUSE), limits.tension_step_max_n
    for course in [*(one.course for one in programme_courses(judged).values()), *improvement_courses(judged).values()]:
        steps = np.abs(np.diff(course.tension_n, axis=0))
        lately = np.lib.stride_tricks.sliding_window_view(steps, min(pause, len(steps)), axis=0)
        assert lately.sum(axis=(1, 2)).max() <= together * most_n + 1e-9
        assert steps.max() <= most_n + 1e-9
        assert (lately > 0.0).sum(axis=2).max(initial=0) <= 1, "one span steps again only when the last step is over"
        low, high = limits.tension_min_n + limits.tension_margin_n, limits.tension_max_n - limits.tension_margin_n
        assert low <= course.tension_n.min() and course.tension_n.max() <= high


def test_a_loop_is_simulated_as_late_as_its_delay_margin_says(case, monkeypatch):
    seen = []

    def simulate(config, plants, course, setup):
        seen.append((plants, setup))
        return rollouts(low=1.0 if setup.step_s == pytest.approx(0.001) else 20.0)

    for module in (corners, corner_runs):
        monkeypatch.setattr(module, "simulate", simulate)
    (low,) = [one for one in corners.check(case) if not one.passed]
    assert low.rule == "corners: lowest tension" and "late" in low.text
    late = [plants for plants, setup in seen if setup.step_s == pytest.approx(0.001)]
    assert len(late) == 4 and all(
        plants.effects.latency_s == pytest.approx(case.latency_s + case.line.gate.delay_margin_min_s) for plants in late
    )


@pytest.mark.slow
def test_a_late_loop_is_not_looked_at_where_no_torque_holds_it(case, monkeypatch):
    steps_s: list[float] = []

    def simulate(config, plants, course, setup):
        steps_s.append(setup.step_s)
        return rollouts()

    for module in (corners, corner_runs):
        monkeypatch.setattr(module, "simulate", simulate)

    def looked_at(torque_nm):
        steps_s.clear()
        limits = case.line.limits.model_copy(update={"torque_nm": torque_nm})
        found = corners.check(replace(case, line=case.line.model_copy(update={"limits": limits})))
        late = sum(step_s == pytest.approx(0.001) for step_s in steps_s)
        return late if "none of" not in found[0].text else None

    seen = [looked_at(torque_nm) for torque_nm in np.arange(20.0, 40.0, 0.1).tolist()]
    assert seen[0] is None and seen[-1] == 4
    assert {1, 2, 3} & set(seen), "some corner is held in every course, and what is believed is not"


def test_a_predictive_controller_runs_whole_on_some_corners_and_says_what_is_lost(of, context, monkeypatch):
    mpc = design_mpc(of.task(), MpcWeights())
    whole: list[int] = []

    def counted(config, plants, course, setup):
        if config == mpc:
            whole.append(plants.count)
            config = design_lqi(of.task())
        return corners.simulate(config, plants, course, setup)

    monkeypatch.setattr(programme, "simulate", counted)
    case = case_of(gains(mpc, context), context, of)
    found = corners.check(case)
    assert refused(roller_speed.check(case)) == []
    assert sorted(whole) == [1] * 6 + [4] * 4  # once for both rules
    assert found[-1].rule == "corners: what is lost"
    assert refused(found) == []


def test_the_worst_over_corners_knows_where_it_was():
    worst = Worst(np.full(2, 1.0), np.full(2, 10.0))
    one = np.ones((1, 2))
    for name, swing in (("first", 0.5), ("second", 0.7)):
        worst.take(Rollouts(one, 3 * one, 9 * one, one, one, one, one, one, one, tail_swing_n=swing * one,
                            tail_error_n=one, chatter_nm=one), name, [0, 1])  # fmt: skip
    assert (
        worst.swing_n == (0.7, "second")
        and worst.lowest_n == (2.0, "first", 0)
        and worst.highest_n == (1.0, "first", 0)
    )


def test_corners_that_torque_does_not_hold_leave_the_papers_criterion_open(of, context, case):
    weak = of.line.model_copy(update={"limits": of.line.limits.model_copy(update={"torque_nm": 5.0})})
    assert any("no corner is held" in text for text in refused(paper.check(replace(case, line=weak))))


def first_case(of, redesigned):
    """Up to 0.02 m/s and steps of 4 N, on 8 corners."""
    context = of.context(model=None, data=[])
    return case_of(gains(redesigned, context), context, of)


def told_of(case, monkeypatch, held):
    """What is told of corners, of which `held` torque holds: by course, and of others all. Nothing else is refused."""
    courses = corner_courses(judged_of(case))
    kept = {name: held.get(name, list(one.of(case.corners))) for name, one in courses.items()}
    monkeypatch.setattr(corners, "corners_held", lambda _: kept)
    monkeypatch.setattr(corners, "in_largest_steps", lambda _: {"speed change": rollouts()})
    return corners.check(case)


def test_what_a_law_has_been_put_through_is_told(of, redesigned, monkeypatch):
    case = first_case(of, redesigned)
    assert len(case.corners) == 8
    assert told_of(case, monkeypatch, {})[-1] == told(
        "corners", True,
        "8 plants that the line may be, and 2 late, 3 courses each, 6 shared out, up to 0.02 m/s and steps of 4 N",
    )  # fmt: skip


def test_plants_that_nobody_could_hold_are_told_by_course_and_by_how_many(of, redesigned, monkeypatch):
    """Of a course that is shared out so many are missing as it is for; one that it is not for may stand in."""
    case = first_case(of, redesigned)
    held = {
        "neighbours": case.corners[:3], "one after another": case.corners[:7], "span 5 alone, slow": case.corners[:1],
        "span 3 alone, slow": case.corners[:4],
    }  # fmt: skip
    assert told_of(case, monkeypatch, held)[-1] == told(
        "corners", True,
        "8 plants that the line may be, and 2 late, 3 courses each, 6 shared out, up to 0.02 m/s and steps of 4 N; "
        "left out, because no controller holds them with 60 Nm: 1 of span 5 alone, slow, 1 of one after another, "
        "5 of neighbours",
    )  # fmt: skip


def test_the_first_course_in_which_no_plant_is_held_is_told(of, redesigned, monkeypatch):
    found = told_of(first_case(of, redesigned), monkeypatch, {"one after another": [], "neighbours": []})
    assert found == [
        told(
            "corners", False,
            "none of 8 plants that the line may be is held with 60 Nm (one after another, up to 0.02 m/s): a lower "
            "speed, or larger drives",
        )
    ]  # fmt: skip


def test_each_limit_is_told_with_the_worst_and_the_course_it_was_in(of, redesigned, monkeypatch):
    monkeypatch.setattr(corners, "simulate", lambda *_: rollouts(low=1.504, high=61.256, swing=inf))
    assert told_of(first_case(of, redesigned), monkeypatch, {})[:-1] == [
        at_least(
            "corners: lowest tension", 1.504, 2.0, "N",
            "tension falls to 1.50 N (speed change, late); allowed: down to 2 N",
        ),
        at_most(
            "corners: highest tension", 61.256, 60.0, "N",
            "tension rises to 61.26 N (speed change, late); allowed: up to 60 N",
        ),
        at_most(
            "corners: oscillation", inf, 1.0, "N",
            "tension swings by no end where it should stand (speed change, late); allowed: "
            "gate.tail_oscillation_max_n, 1 N",
        ),
        at_most(
            "corners: error", 2.9, 3.0, "N",
            "tension stands 2.90 N from its set-point (speed change, late); allowed: gate.tail_error_max_n, 3 N",
        ),
        at_most(
            "corners: chatter", 4.9, 5.0, "Nm",
            "torque moves by 4.90 Nm rms from period to period (speed change, late); allowed: "
            "gate.chatter_max_nm, 5 Nm",
        ),
    ]  # fmt: skip


def test_a_late_loop_has_the_lag_that_is_believed_and_not_that_of_the_corners(of, context, redesigned, monkeypatch):
    model = of.model.model_copy(update={"parameters": of.model.parameters.model_copy(update={"torque_lag_s": 0.003})})
    context, lags_s = context.model_copy(update={"model": model}), set()

    def simulate(config, plants, course, setup):
        lags_s.update(plants.effects.torque_lag_s.tolist())
        return rollouts()

    monkeypatch.setattr(corners, "simulate", simulate)
    monkeypatch.setattr(corner_runs, "simulate", lambda *_: rollouts())
    corners.check(case_of(gains(redesigned, context), context, of))
    assert lags_s == {0.003} and of.line.gate.stress_torque_lag_s == 0.005
