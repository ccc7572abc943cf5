"""The oracle of the control benchmark against an independent study, and one quadratic solver against another."""

import numpy as np
import pytest

from gateway.core.scenario import PAPER
from sim_plant.plant import load_plant
from tests.bench.oracle import Terms, by_clarabel, by_piqp, oracle, rk4_with_derivative

TIER_A = Terms(0.010, 0.010, 60.0, 1000.0)
STUDY_N = {"tension": 1.8348, "velocity": 1.0867}


@pytest.mark.slow
@pytest.mark.parametrize("case", PAPER, ids=lambda case: case.name)
def test_it_is_that_of_an_independent_study(case):
    found = oracle(case, load_plant("sim_plant/plants/s_real.toml").parameters(), TIER_A, by_piqp)
    assert found.rmse_n == pytest.approx(STUDY_N[case.name], rel=5e-3)
    assert np.abs(found.torque_nm).max() <= 60.0 + 1e-6
    assert np.abs(np.diff(found.torque_nm, axis=0)).max() <= 10.0 + 1e-6


@pytest.mark.slow
def test_a_second_solver_finds_the_same():
    truth = load_plant("sim_plant/plants/s_sim.toml").parameters()
    found = [oracle(PAPER[1], truth, TIER_A, solve).rmse_n for solve in (by_piqp, by_clarabel)]
    assert found[0] == pytest.approx(found[1], rel=1e-6)


def test_its_derivatives_are_those_of_the_equations():
    plant = load_plant("sim_plant/plants/s_real.toml").parameters()
    generator = np.random.default_rng(1)
    state = np.concatenate((generator.uniform(20, 40, 6), generator.uniform(0.01, 0.1, 6)))
    torque = generator.uniform(-20, 20, 6)
    _, of_state, of_torque = rk4_with_derivative(plant, state, torque, 0.05)
    for k in range(12):
        step = np.zeros(12)
        step[k] = 1e-5
        ends = [rk4_with_derivative(plant, state + sign * step, torque, 0.05)[0] for sign in (1, -1)]
        assert np.allclose((ends[0] - ends[1]) / 2e-5, of_state[:, k], rtol=1e-6, atol=1e-7)
    for k in range(6):
        step = np.zeros(6)
        step[k] = 1e-3
        ends = [rk4_with_derivative(plant, state, torque + sign * step, 0.05)[0] for sign in (1, -1)]
        assert np.allclose((ends[0] - ends[1]) / 2e-3, of_torque[:, k], rtol=1e-6, atol=1e-9)
