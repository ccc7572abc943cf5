"""What a judge does before its first verdict: it runs what verdicts need, once, on a line as it will be."""

import numpy as np
import pytest

from gateway.control.prediction import Unpredictable
from safety import judge as judging


@pytest.fixture
def line(of):
    """With recipes that are unlike each other."""
    one = of.line.recipes[0]
    other = one.model_copy(
        update={"tension_n": [tension + 3.0 for tension in one.tension_n], "speed_m_per_s": 2.0 * one.speed_m_per_s}
    )
    return of.line.model_copy(update={"recipes": [one, other]})


@pytest.fixture
def came_of(monkeypatch):
    """Arguments and results of what is called by its name in the judge."""

    def watch(name):
        plain, found = getattr(judging, name), []

        def watched(*given):
            found.append((given, plain(*given)))
            return found[-1][1]

        monkeypatch.setattr(judging, name, watched)
        return found

    return watch


def test_a_short_loop_is_closed_on_a_stressed_plant_at_the_first_recipe(line, came_of):
    loops = came_of("simulate")
    judging.warm_up(line)
    (((config, plants, course, setup), rollouts),) = loops
    assert config.kind == "lqi" and not rollouts.diverged.any()
    assert (plants.effects.coulomb_nm >= line.gate.stress_coulomb_nm).all()
    assert (plants.effects.eccentricity == line.gate.stress_eccentricity).all()
    assert (course.tension_n == line.recipes[0].tension_n).all()
    assert course.periods * setup.period_s == pytest.approx(0.1)
    assert (course.unwind_speed_m_per_s == 0.01).all() and setup.late_share == line.gate.stress_late_share


def test_a_second_of_the_line_at_its_first_recipe_is_predicted_with_round_rollers_and_with_others(line, came_of):
    predictions = came_of("predict")
    judging.warm_up(line)
    recipe = line.recipes[0]
    for (_, _, stretch), predicted in predictions:
        recording = stretch.recording
        assert recording.samples == 100 and (recording.time_s == pytest.approx(0.01 * np.arange(100)))
        assert (recording.tension_n == recipe.tension_n).all()
        assert (recording.speed_m_per_s == recipe.speed_m_per_s).all()
        assert (recording.unwind_speed_m_per_s == recipe.speed_m_per_s).all()
        assert np.isfinite(predicted.whitened).all()
    (round_, _, _), (eccentric, _, _) = (given for given, _ in predictions)
    assert (round_.eccentricity == 0.0).all() and (eccentric.eccentricity == 0.001).all()


def test_a_line_that_cannot_be_predicted_is_no_reason_not_to_judge(line, monkeypatch):
    def predict(*_):
        raise Unpredictable("the latency is longer than torques are known")

    monkeypatch.setattr(judging, "predict", predict)
    judging.warm_up(line)
