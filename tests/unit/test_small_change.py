"""What is small enough to pass by its verdict: distances from what a person approved, in any number of steps."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from gateway.control.design import design_lqi, design_pid, task_of
from gateway.core.experiment import Abort, Experiment, Leg
from gateway.core.proposal import ExperimentChange, GainsChange, ModelChange
from gateway.core.small_change import beyond_small
from tests.unit.model_support import model
from tests.unit.supervisor_support import line_of

LQI = design_lqi(task_of(line_of(2)))


def scaled(factor: float):
    gain = (factor * np.array(LQI.gain_state)).tolist()
    return GainsChange(controller=LQI.model_copy(update={"gain_state": gain}))


@given(st.floats(0.5, 2.0), st.floats(0.01, 0.5))
def test_a_matrix_may_differ_by_the_share_and_no_more(factor: float, share: float) -> None:
    far = abs(factor - 1.0) - share
    if abs(far) > 1e-6:
        assert bool(beyond_small(scaled(1.0), scaled(factor), share)) is (far > 0.0)


def test_another_law_and_another_kind_are_a_persons() -> None:
    pid = GainsChange(controller=design_pid(task_of(line_of(2))))
    assert any("kind is" in text for text in beyond_small(scaled(1.0), pid, 0.9))
    assert beyond_small(scaled(1.0), ModelChange(model=model()), 0.9)


def test_a_model_may_differ_in_what_it_believes_by_the_share() -> None:
    before = ModelChange(model=model())
    given = before.model.parameters
    for factor, small in ((1.05, True), (1.2, False)):
        parameters = given.model_copy(update={"stiffness_n": factor * given.stiffness_n})
        after = ModelChange(model=before.model.model_copy(update={"parameters": parameters}))
        assert (beyond_small(before, after, 0.1) == []) is small


def experiment(**changes) -> ExperimentChange:
    fields = {
        "format": 1, "amplitude_n": [2.0, 2.0], "dwell_s": 0.2, "rate_n_per_s": 50.0, "abort": Abort(deviation_n=8.0),
        "legs": [Leg(duration_s=4.0, speed_m_per_s=0.02)], **changes,
    }  # fmt: skip
    return ExperimentChange(experiment=Experiment(**fields))


@pytest.mark.parametrize(
    ("changes", "why"),
    [
        ({}, ""),
        ({"amplitude_n": [1.0, 2.0], "seed": 7}, ""),
        ({"amplitude_n": [2.0, 2.1]}, "amplitude of span 2 is 2.1 N, in the approved 2"),
        ({"rate_n_per_s": None}, "rate of set-points is inf N/s, in the approved 50"),
        ({"legs": [Leg(duration_s=4.5, speed_m_per_s=0.02)]}, "duration is 4.5 s, in the approved 4"),
        ({"legs": [Leg(duration_s=4.0, speed_m_per_s=0.1)]}, "speeds"),
        ({"abort": Abort(deviation_n=9.0)}, "deviation that ends it is 9 N, in the approved 8"),
    ],
)
def test_an_experiment_goes_no_further_than_the_approved(changes, why) -> None:
    reasons = beyond_small(experiment(), experiment(**changes), 0.5)
    assert (reasons == []) if not why else why in "; ".join(reasons)
