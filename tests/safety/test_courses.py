"""Courses that are drawn: those of the figures, no finer than can be seen, and nothing that is no number."""

import math

import numpy as np
import pytest

from gateway.control.design import design_lqi
from gateway.core.courses import MOST_NUMBERS, MOST_POINTS
from gateway.core.deployment import Region
from gateway.core.experiment import Experiment
from gateway.core.proposal import ExperimentChange, canonical
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
