"""Courses that are drawn: those of the figures, no finer than can be seen, and nothing that is no number."""

import math

import numpy as np
import pytest

from gateway.control.design import design_lqi
from gateway.core.courses import MOST_NUMBERS, MOST_POINTS, DrawnCourse
from gateway.core.deployment import Region
from gateway.core.experiment import Experiment
from gateway.core.proposal import ExperimentChange, ProposalRefused, canonical
from gateway.core.signals import FloatArray
from safety import courses
from safety.courses import courses_of
from tests.safety.case_support import EXAMPLES, gains, proposal, published, verdict_of


@pytest.fixture(scope="module")
def of():
    return published()


@pytest.fixture(scope="module")
def judged(of):
    given = gains(design_lqi(of.task()), of.context())
    return given, verdict_of(given, of.context(), of)


@pytest.fixture(scope="module")
def drawn(of, judged):
    given, verdict = judged
    return {one.scenario: one for one in courses_of(canonical(given), of.context(), of.line, verdict.region).courses}


def error_n(course, whose) -> FloatArray:
    return np.array(course.tension_n[whose]) - np.array(course.setpoint_n)


def test_they_are_those_that_the_figures_are_of(drawn, judged):
    figures = {(one.scenario, one.configuration): one for one in judged[1].figures}
    assert {scenario for scenario, _ in figures} == set(drawn)
    for whose in ("in service", "proposed"):
        moved = error_n(drawn["moves"], whose)
        told = figures["moves", whose].rmse_n
        assert math.isclose(np.sqrt((moved**2).sum() / moved.shape[1]), told, rel_tol=0.05, abs_tol=0.001)
        asked, came = (np.array(one) for one in (drawn["tension"].setpoint_n, drawn["tension"].tension_n[whose]))
        down = int(np.argmax(asked[0] == asked[0].max())) + int((asked[0] == asked[0].max()).sum())
        up_n, down_n = came[:, :down].max(1) - asked.max(1), asked.min(1) - came[:, down:].min(1)
        beyond_n = max(up_n.max(), down_n.max())
        percent, told = 100.0 * beyond_n / np.ptp(asked, axis=1).max(), figures["tension", whose].overshoot_pct
        assert math.isclose(percent, told, rel_tol=0.01, abs_tol=0.02)  # the peak itself is drawn


def test_they_are_no_longer_than_a_message_and_no_finer_than_the_eye(of, drawn):
    for course in drawn.values():
        points = len(course.time_s)
        assert 2 <= points <= MOST_POINTS and course.time_s[0] == 0.0
        assert {len(one) for one in (*course.setpoint_n, *course.tension_n["proposed"])} == {points}
        assert len(course.setpoint_n) == len(course.tension_n["in service"]) == of.line.n
    assert sum(3 * of.line.n * len(one.time_s) for one in drawn.values()) <= MOST_NUMBERS


def test_what_runs_away_is_told_as_no_number(of, judged, monkeypatch):
    def follow(config, plants, way, setup):
        gone = np.full((len(way.course(setup.period_s).tension_n), plants.n), 20.0)
        gone[50:] = np.nan
        return gone

    monkeypatch.setattr(courses, "follow", follow)
    given, verdict = judged
    moves = courses_of(canonical(given), of.context(), of.line, verdict.region).courses[-1]
    assert moves.scenario == "moves"
    for span in moves.tension_n["proposed"]:
        assert set(span) == {20.0, None} and span[-1] is None


def test_without_steps_of_tension_there_are_none_to_draw(of, judged):
    given, verdict = judged
    still = verdict.region.model_copy(update={"tension_step_max_n": 0.0})
    found = courses_of(canonical(given), of.context(), of.line, still).courses
    assert [one.scenario for one in found] == ["velocity"]


def test_an_experiment_has_no_courses_of_two_controllers(of):
    experiment = Experiment.model_validate_json((EXAMPLES / "experiment.json").read_bytes())
    given = proposal(ExperimentChange(experiment=experiment), of.context())
    with pytest.raises(TypeError):
        courses_of(canonical(given), of.context(), of.line, Region())


def test_no_peak_is_lost_between_what_is_drawn(of, judged, monkeypatch):
    for at in range(100, 110):

        def follow(config, plants, way, setup, at=at):
            tension_n = np.full((len(way.course(setup.period_s).tension_n), plants.n), 20.0)
            tension_n[at], tension_n[at + 1, 0] = 29.0, 11.0
            return tension_n

        monkeypatch.setattr(courses, "follow", follow)
        given, verdict = judged
        monkeypatch.setattr(courses, "improvement_courses", lambda judged: {})
        (moves,) = courses_of(canonical(given), of.context(), of.line, verdict.region).courses
        first, *others = moves.tension_n["proposed"]
        peaks = [value for value in first if value != 20.0]
        assert peaks == [29.0, 11.0]
        assert all(sorted(set(span)) == [20.0, 29.0] for span in others)
        assert moves.time_s == sorted(set(moves.time_s)) and len(moves.time_s) <= MOST_POINTS


@pytest.fixture
def handmade(of, judged, monkeypatch):
    """Courses of one move with set-points (k, n), which a configuration goes through as `came` has it: (k, n)."""

    def drawn(setpoint_n, came, region=None, **control):
        asked = []
        monkeypatch.setattr(courses, "_runs", lambda _, judged: asked.append(judged) or {"moves": (setpoint_n, came)})
        line = of.line.model_copy(update={"control": of.line.control.model_copy(update=control)})
        given, verdict = judged
        (found,) = courses_of(canonical(given), of.context(), line, region or verdict.region).courses
        return found, asked[0]

    return drawn


def test_of_three_samples_two_are_drawn_each_where_a_sample_is(handmade):
    setpoint_n = np.full((MOST_POINTS + 6, 2), 20.0)
    found, _ = handmade(setpoint_n, lambda config: setpoint_n, period_s=0.01)
    assert [round(100.0 * time_s, 6) for time_s in found.time_s[:6]] == [0.0, 1.0, 3.0, 4.0, 6.0, 7.0]


def test_it_is_told_to_a_millinewton_and_to_a_tenth_of_a_millisecond(handmade, judged):
    setpoint_n = np.array([[20.12349, 30.0], [20.5, 30.00051], [21.0, 30.0]])
    off_n = np.array([[0.0, 0.0], [0.00049, -1.00051], [math.nan, math.inf]])

    def came(config):
        return setpoint_n + (off_n if config == judged[0].change.controller else 1.0)

    assert handmade(setpoint_n, came, period_s=0.00333)[0] == DrawnCourse(
        scenario="moves",
        time_s=[0.0, 0.0033, 0.0067],
        setpoint_n=[[20.123, 20.5, 21.0], [30.0, 30.001, 30.0]],
        tension_n={
            "in service": [[21.123, 21.5, 22.0], [31.0, 31.001, 31.0]],
            "proposed": [[20.123, 20.5, None], [30.0, 29.0, None]],
        },
    )


def test_of_a_long_course_there_are_two_points_of_each_stretch_and_all_of_one_that_just_fits(of, handmade, monkeypatch):
    setpoint_n = np.array([[10.0] * 4 + [12.0] * 7]).T
    came_n = np.array([[10.0, 9.0, 10.0, 13.0, 12.0, 12.0, 12.5, 12.0, 12.0, 11.5, 12.0]]).T

    def drawn(points):
        """Where an answer may have no more numbers: of each point a set-point and two tensions of each span."""
        monkeypatch.setattr(courses, "MOST_NUMBERS", points * 3 * of.line.n)
        found, _ = handmade(setpoint_n, lambda config: came_n)
        assert found.tension_n["in service"] == found.tension_n["proposed"]
        return found.time_s, found.setpoint_n[0], found.tension_n["proposed"][0]

    in_full = [round(0.01 * k, 4) for k in range(11)], setpoint_n[:, 0].tolist(), came_n[:, 0].tolist()
    assert drawn(11) == in_full
    assert drawn(4) == ([0.0, 0.03, 0.06, 0.09], [10.0, 12.0, 12.0, 12.0], [9.0, 13.0, 12.5, 11.5])


def test_of_the_stretch_in_which_it_runs_away_the_extreme_before_is_drawn(of, handmade, monkeypatch):
    gone = [math.nan] * 4
    came_n = np.array([[10.0, 13.0, 9.0, *gone], [10.0, 9.0, 13.0, *gone]]).T
    monkeypatch.setattr(courses, "MOST_NUMBERS", 2 * 3 * of.line.n)
    found, _ = handmade(np.full((7, 2), 10.0), lambda config: came_n)
    assert found.tension_n["proposed"] == [[13.0, None], [9.0, None]]


def test_a_span_that_runs_away_takes_no_other_from_the_drawing(of, handmade, monkeypatch):
    gone = [math.nan] * 4
    came_n = np.array([[10.0, 13.0, 9.0, *gone], [10.0, 9.0, 13.0, 12.0, 11.0, 12.0, 11.5]]).T
    monkeypatch.setattr(courses, "MOST_NUMBERS", 2 * 3 * of.line.n)
    found, _ = handmade(np.full((7, 2), 10.0), lambda config: came_n)
    assert found.tension_n["proposed"] == [[13.0, None], [9.0, 13.0]]


def test_numbers_without_end_are_none_and_nothing_to_warn_of(handmade):
    setpoint_n = np.full((2, 1), 1e308)
    found, _ = handmade(setpoint_n, lambda config: setpoint_n * [[1.0], [10.0]])
    assert found.tension_n["proposed"] == [[1e308, None]]


def test_they_are_as_large_as_what_it_was_judged_for_or_else_as_the_line_permits(of, handmade):
    def judged_for(region):
        _, asked = handmade(np.full((2, 1), 20.0), lambda config: np.full((2, 1), 20.0), region)
        assert asked.tension_n.tolist() == of.context().state.tension_n
        return asked.speed_max_m_per_s, asked.tension_step_n, asked.speed_step_m_per_s

    narrow = Region(speed_max_m_per_s=0.03, tension_step_max_n=5.0, speed_step_max_m_per_s=0.01)
    assert judged_for(narrow) == (0.03, 5.0, 0.01)
    limits = of.line.limits
    assert judged_for(Region()) == (
        limits.speed_max_m_per_s, limits.tension_step_max_n, limits.speed_step_max_m_per_s,
    ) == (0.12, 24.0, 0.09)  # fmt: skip


def test_what_is_larger_than_the_line_takes_is_not_drawn(of, judged):
    payload = canonical(judged[0])

    def drawn(most_bytes):
        gate = of.line.gate.model_copy(update={"proposal_max_bytes": most_bytes})
        still = judged[1].region.model_copy(update={"tension_step_max_n": 0.0})
        return courses_of(payload, of.context(), of.line.model_copy(update={"gate": gate}), still).courses

    assert len(drawn(len(payload))) == 1
    with pytest.raises(ProposalRefused, match=f"allowed: {len(payload) - 1}"):
        drawn(len(payload) - 1)
