"""What bench-identify is made of."""

import numpy as np

from gateway.core.theta import Noise
from gateway.identification.estimate import Structure
from gateway.identification.prediction_error import fit
from gateway.identification.prior import prior_of
from sim_plant.plant import Plant
from tests.bench.identify_runs import against_truth, drawn_plant
from tests.closed_loop.recorded import demonstration_line, real_plant, recorded
from tests.closed_loop.truths import altered, true_values, truth_of, with_friction_and_lag


def test_plants_are_drawn_from_the_prior_of_the_file():
    prior = prior_of(demonstration_line(), Structure())
    drawn = np.array([prior.parameters.logs(truth_of(drawn_plant(seed))) for seed in range(300)])
    deviation = np.sqrt(np.diag(prior.covariance))
    assert np.abs((drawn.mean(axis=0) - prior.mean) / deviation).max() < 4.0 / np.sqrt(300.0)
    assert np.allclose(drawn.std(axis=0) / deviation, 1.0, atol=0.15)
    assert drawn_plant(7) == drawn_plant(7) != drawn_plant(8)


def test_the_truth_has_the_names_of_the_estimate():
    plant = with_friction_and_lag(real_plant())
    truth = true_values(plant, Structure(coulomb=True, torque_lag=True))
    assert np.isclose(truth["coulomb_nm"], 2.0) and np.isclose(truth["torque_lag_s"], 0.005)
    assert np.isclose(truth["stiffness_per_length"], 2200.0 / 1.2)
    assert isinstance(altered(plant, {"drives": {"torque_lag_s": 0.0}}), Plant)


def test_an_estimate_is_held_against_the_truth():
    plant = real_plant()
    fitted = fit([recorded(plant, 2, 2.0)], prior_of(demonstration_line(), Structure()), Noise())
    found = against_truth(fitted, plant)
    interval = fitted.interval("inertia_kg_m2")
    assert found.error["inertia_kg_m2"] == interval.value / 1.0 - 1.0
    assert found.covered["inertia_kg_m2"] == (interval.low <= 1.0 <= interval.high)
    assert found.converged and set(found.error) == set(found.half_width) == set(fitted.parameters.maps)
