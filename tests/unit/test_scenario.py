"""Scenarios: what they ask of a line, and which are refused."""

import numpy as np
import pytest

from gateway.cli.scenarios import load_scenario
from gateway.control.reference import MinimumJerk
from gateway.core.line_file import load_line
from gateway.core.line_template import line_template
from gateway.core.scenario import PAPER, TENSION, VELOCITY, Scenario, ScenarioRefused, scenario_of

GRADE = {"name": "grade", "tension_n": [30.0, 20.0], "speed_m_per_s": 0.05, "tension_after_n": [36.0, 32.0]}


def test_the_paper_cases_step_once_and_fit_the_demonstration_line():
    line = load_line(line_template(6, "line.toml"), "line.toml")
    time = np.array([0.0, 0.999, 1.0, 15.0])
    assert TENSION.setpoints_n(time)[:, 2].tolist() == [20.0, 20.0, 44.0, 44.0]
    assert (TENSION.speeds_m_per_s(time) == 0.01).all()
    assert VELOCITY.speeds_m_per_s(time) == pytest.approx([0.01, 0.01, 0.1, 0.1])
    assert (VELOCITY.setpoints_n(time) == 30.0).all()
    assert [command.model_dump() for command in TENSION.commands()] == [
        {"command": "set", "span": 3, "tension_n": 44.0, "step": True}
    ]
    for scenario in PAPER:
        assert scenario.reasons_against(6, line.limits) == []
        assert any("6 spans" in reason for reason in scenario.reasons_against(4, line.limits))


def test_a_move_is_the_curve_that_the_loop_drives_along():
    """Each span at the rate at which the greatest change takes `move_s`."""
    scenario = scenario_of(GRADE | {"move_s": 0.5})
    curve = MinimumJerk(np.array([30.0, 20.0]))
    for span, target in enumerate([36.0, 32.0]):
        curve.move(span, target, MinimumJerk.PEAK * 12.0 / 0.5, 1.0, 0.2)
    time = np.linspace(1.0, 2.0, 101)
    wanted = np.array([curve.at(t)[0] for t in time])
    assert scenario.setpoints_n(time) == pytest.approx(wanted, abs=1e-12)
    assert not any(command.step for command in scenario.commands())


@pytest.mark.parametrize(
    ("change", "says"),
    [
        ({"tension_after_n": [36.0]}, "tension_after_n has 1 entries, tension_n 2"),
        ({"tension_after_n": [30.0, 20.0]}, "nothing changes"),
        ({"change_at_s": 14.9, "move_s": 0.5}, "the scenario ends before"),
        ({"tension_n": [30.0, float("nan")]}, "tension_n.1"),
        ({"speed_m_per_s": True}, "speed_m_per_s"),
        ({"colour": 1}, "colour"),
    ],
)
def test_what_is_wrong_is_named(change, says):
    with pytest.raises(ScenarioRefused, match=says):
        scenario_of(GRADE | change)


def test_what_a_line_cannot_run_is_named_at_once():
    line = load_line(line_template(2, "line.toml"), "line.toml")
    wild = Scenario(
        name="wild", tension_n=[30.0, 20.0], speed_m_per_s=0.01, tension_after_n=[59.5, 20.0], speed_after_m_per_s=0.2
    )
    reasons = "; ".join(wild.reasons_against(2, line.limits))
    assert "59.5 N; allowed: 3 to 59 N" in reasons and "0.2 m/s; allowed: up to 0.12" in reasons
    all_at_once = TENSION.model_copy(update={"tension_after_n": [48.0, 16.0, 40.0, 20.0, 44.0, 52.0]})
    (reason,) = all_at_once.reasons_against(6, line.limits)
    assert "steps by 120 N in all spans together" in reason and "96 N" in reason
    assert "steps by 29.5 N" in reasons and "steps by 0.19 m/s" in reasons


def test_a_file_is_read_and_what_is_none_is_refused(tmp_path):
    assert load_scenario("velocity") is VELOCITY
    assert load_scenario("docs/examples/scenario.toml").move_s == 0.5
    with pytest.raises(ScenarioRefused, match="allowed: tension, velocity, or a TOML file"):
        load_scenario(str(tmp_path / "nowhere.toml"))
    (tmp_path / "bad.toml").write_text("name = ")
    with pytest.raises(ScenarioRefused, match="is no TOML"):
        load_scenario(str(tmp_path / "bad.toml"))
