"""What the commissioning chain proposes: every candidate holds its line, and an experiment keeps to the limits."""

import pytest

from gateway.commissioning.architectures import ARCHITECTURES
from gateway.commissioning.candidates import (
    FIRST_LAWS,
    Law,
    NotOffered,
    at_end,
    configuration,
    experiment,
    fastest_m_per_s,
    values_of,
)
from gateway.commissioning.redesign import CALM_PREDICTIVE, LAWS, PREDICTIVE
from gateway.control.design import is_stable, task_of
from tests.unit.chain_support import FIRST_M_PER_S, LINE


@pytest.mark.parametrize("law", [*FIRST_LAWS, *LAWS, *PREDICTIVE, *CALM_PREDICTIVE], ids=lambda law: law.text)
def test_every_candidate_holds_the_line_that_it_is_made_for(law):
    assert is_stable(configuration(LINE, None, 0.02, law), task_of(LINE))


def test_a_knob_that_ends_before_somebodys_number_says_so():
    knob = next(one for one in ARCHITECTURES["lqi"].knobs if one.name == "torque_per_nm2")
    law = Law("lqi", (("torque_per_nm2", 1e12), ("integral_per_n2s2", 1.0)))
    (said,) = at_end(LINE, None, FIRST_M_PER_S, law)
    assert f"torque_per_nm2 ends at {knob.most:g}" in said
    assert values_of(task_of(LINE), law)["torque_per_nm2"] == knob.most
    assert not at_end(LINE, None, FIRST_M_PER_S, Law("lqi", (("torque_per_nm2", 2.0),)))


def test_the_line_goes_as_fast_as_its_drives_hold():
    most = fastest_m_per_s(LINE, None)
    weak = LINE.model_copy(update={"limits": LINE.limits.model_copy(update={"torque_nm": 20.0})})
    assert 0.0 < fastest_m_per_s(weak, None) < most <= LINE.limits.speed_max_m_per_s
    roller = LINE.rollers[0]
    omega_per_s = fastest_m_per_s(weak, None) / roller.radius_m.value
    assert roller.friction_nms_per_rad.value * omega_per_s < 0.9 * 20.0


@pytest.mark.slow
def test_a_first_experiment_keeps_to_the_steps_of_a_first_configuration_and_is_refused_where_it_cannot():
    config = configuration(LINE, None, 0.02, FIRST_LAWS[0])
    given = (LINE, None, config, LINE.recipes[0].tension_n, 0.01)
    found = experiment(*given, [0.01, 0.02], size=8.0)
    assert found.step_max_n == LINE.gate.first_step_max_n and [leg.speed_m_per_s for leg in found.legs] == [0.01, 0.02]
    assert found.abort.deviation_n > max(found.amplitude_n) and found.rate_n_per_s is None
    with pytest.raises(NotOffered, match="allowed"):
        experiment(*given, [0.01, 2.0 * LINE.limits.speed_max_m_per_s])


@pytest.mark.slow
def test_on_a_slow_line_set_points_of_an_experiment_move_on_ramps():
    """The rollers of a line for 0.03 m/s may run ahead of the web by no more than 0.018 m/s at 0.02 m/s."""
    slow = LINE.model_copy(update={"limits": LINE.limits.model_copy(update={"speed_max_m_per_s": 0.03})})
    config = configuration(slow, None, 0.02, FIRST_LAWS[0])
    found = experiment(slow, None, config, LINE.recipes[0].tension_n, 0.01, [0.01, 0.02])
    assert found.rate_n_per_s is not None and 1.0 < found.rate_n_per_s < LINE.moves.tension_rate_n_per_s
    assert found.dwell_s > 2.0 * max(found.amplitude_n) / found.rate_n_per_s
    assert max(found.amplitude_n) > 0.5
