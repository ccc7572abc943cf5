"""Adaptation rehearsed: what rounds through the gate, and without one, tell of the line, and what they are worth."""

import numpy as np
import pytest

from gateway.cli.rehearse import cases_of, rehearse
from gateway.cli.rehearse_adaptations import adapt, first_experiment
from gateway.cli.stepped import SteppedLoop
from gateway.cli.stepped_experiment import run_experiment
from gateway.cli.tiers import A_FAST
from gateway.control.design import design_lqi, task_of
from gateway.core.scenario import Scenario
from tests.closed_loop.recorded import demonstration_line, real_plant

pytestmark = pytest.mark.long

STEP = Scenario(
    name="step",
    tension_n=[30.0, 24.0],
    speed_m_per_s=0.05,
    tension_after_n=[30.0, 34.0],
    change_at_s=0.3,
    duration_s=2.0,
)
TRUTH = {"stiffness_per_length": 2200.0 / 1.2, "radius_per_inertia": 0.035, "friction_per_inertia": 15.0}


def plant_of_two(**tables):
    plant = real_plant().model_copy(update={"spans": 2})
    return plant.model_copy(
        update={name: getattr(plant, name).model_copy(update=values) for name, values in tables.items()}
    )


@pytest.fixture(scope="module")
def rehearsed():
    """A round through the gate, on a line of two spans that believes S_sim while S_real is true."""
    from gateway.cli.rehearse_designs import DESIGNS

    on_truth = [design for design in DESIGNS if design.name in ("truth-lqi", "truth-mpc-observer")]
    return rehearse(
        cases_of(demonstration_line(2), plant_of_two(), [STEP], None), 3, 1, designs=on_truth, adaptations=1
    )


def assert_true(intervals, widths):
    found = {name: intervals[name] for name in TRUTH}
    # Three times the half width: one seed, and three quantities.
    assert all(abs(i.value - TRUTH[name]) < 1.5 * (i.high - i.low) for name, i in found.items())
    assert all(i.high - i.low < widths * i.value for i in found.values())


def test_a_round_goes_through_the_gate_step_by_step_and_tells_the_truth(rehearsed):
    _, (only,) = rehearsed
    assert not only.refused and only.unsafe_events == 0 and only.deployments == 2  # the first one, and the redesign
    went_well = [text for text in only.tried if text.endswith((": kept", ": done"))]
    assert [text.split(",")[0] for text in went_well] == ["first configuration", "experiment", "model", "redesign"]
    assert_true(only.intervals, 0.06)
    assert only.normalised_innovation == pytest.approx(1.0, abs=0.1)


def test_designs_on_what_was_found_are_worth_those_on_the_truth(rehearsed):
    configurations, _ = rehearsed
    rmse = {one.name: one.cases[0].rmse_n for one in configurations}
    adapted = [one for one in configurations if one.model == "identified-1"]
    assert [one.name for one in adapted] == ["adapt1-lqi", "adapt1-mpc-observer"]
    for one in adapted:
        assert one.cases[0].unsafe_events == 0
        assert one.cases[0].rmse_n < 1.02 * rmse[f"truth-{one.name[7:]}"]


def test_a_line_that_tells_nothing_brings_no_model_and_the_gate_says_why():
    frozen = plant_of_two(sensors={"tension_step_n": 5.0})  # load cells that show whole steps of 5 N
    configurations, (only,) = rehearse(
        cases_of(demonstration_line(2), frozen, [STEP], None), 3, 1, designs=(), adaptations=2
    )
    assert configurations == [] and only.refused and only.intervals == {} and only.structure is None
    assert only.tried and not any(text.startswith("redesign") for text in only.tried)


def test_without_a_gate_a_round_tells_the_truth_as_well():
    case = cases_of(demonstration_line(2), plant_of_two(), [STEP], None)[0]
    (only,) = adapt(case.line, case.plant, case.scenario, 3, 1)
    assert only.result.refused == [] and only.result.unsafe_events == 0 and only.result.valid
    assert only.result.data_s == pytest.approx(10.0, rel=0.01) and only.result.tried == []
    assert_true(only.result.intervals, 0.03)
    assert [design.name for design, _ in only.designs] == ["adapt1-lqi", "adapt1-mpc-observer"]


def test_at_a_short_period_noise_ends_no_experiment():
    case = cases_of(demonstration_line(2), plant_of_two(), [STEP], A_FAST)[0]
    first = first_experiment(case.line, case.scenario)
    assert first.abort.saturated_share < 0.7 and first.abort.reversal_share < 0.7  # noise is not what it ends by
    loop = SteppedLoop(case.line, design_lqi(task_of(case.line)), case.plant, 3)
    loop.begin_in_production(np.array(STEP.tension_n), STEP.speed_m_per_s)
    loop.step(round(0.5 / case.line.control.period_s))
    assert run_experiment(loop, first).samples * case.line.control.period_s > 9.9  # or it raises
    assert loop.truth.recorder.unsafe_total == 0
