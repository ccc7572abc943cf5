"""Rollouts: the kernel against the laws themselves, and both against an integrator that shares no code."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from gateway.control.design import (
    DesignLimits,
    DesignTask,
    design_lqg,
    design_lqi,
    design_lqr,
    design_mpc,
    design_pid,
)  # fmt: skip
from gateway.control.rollout import Course, Setup, plants_of, simulate, simulate_slowly
from gateway.core.web_model import WebModel
from sim_plant.physics import WebParameters
from tests.bench.oracle import Terms, simulated
from tests.unit.control_support import model

LINEAR = [design_pid, design_lqr, design_lqi, design_lqg]


def task(n=6, period_s=0.01, latency_s=0.01, draw=()):
    limits = DesignLimits(60.0, 1000.0, 2.0, 60.0, 0.1)
    return DesignTask(model(n), period_s, latency_s, np.full(n, 30.0), 0.05, draw, limits=limits)


def random_plants(count, n=6, seed=0, share_of_box=0.2):
    """Every roller and span of its own. A loop that grows would make the last digit of a number into the first."""
    generator = np.random.default_rng(seed)

    def spread(value, share):
        return value * (1.0 + share_of_box * share * generator.uniform(-1.0, 1.0, n))

    return plants_of(
        [
            WebModel(
                float(spread(2400.0, 0.2)[0]),
                spread(1.0, 0.2),
                spread(0.04, 0.15),
                spread(0.95, 0.2),
                spread(10.0, 0.5),
            )
            for _ in range(count)
        ]
    )


def course(n=6, periods=200):
    tension = np.full((periods, n), 30.0)
    tension[periods // 4 :, n // 2] += 14.0
    unwind = np.where(np.arange(periods) < periods // 2, 0.01, 0.05)
    return Course(tension, unwind, periods // 4)


@pytest.mark.parametrize("design", LINEAR)
@pytest.mark.parametrize(("latency_s", "substeps"), [(0.0, 1), (0.01, 1), (0.004, 5), (0.026, 5)])
def test_the_kernel_does_what_the_laws_do(design, latency_s, substeps):
    config = design(task(latency_s=latency_s))
    setup = Setup(0.01, latency_s, substeps, 60.0, 1000.0, 0.1, 1e-4, 1.6e-3, seed=3)
    fast, slow = (run(config, random_plants(11), course(), setup, record=True) for run in (simulate, simulate_slowly))
    for name in vars(slow):
        if name == "settled":
            continue
        assert np.allclose(getattr(fast, name), getattr(slow, name), rtol=1e-9, atol=1e-9), name
    assert (fast.settled == slow.settled).mean() > 0.95  # a sample on the edge of the band may fall on either side


@pytest.mark.parametrize("design", LINEAR)
def test_draw_spans_go_through_the_kernel_as_well(design):
    config = design(task(4, draw=(1,)))
    setup = Setup(0.01, 0.01, 1, 60.0, 1000.0, 0.1, 1e-4, 1.6e-3, seed=3)
    fast, slow = (
        run(config, random_plants(3, 4), course(4), setup, record=True) for run in (simulate, simulate_slowly)
    )
    assert np.allclose(fast.tension_n, slow.tension_n, rtol=1e-9, atol=1e-9)


def test_quantisation_is_that_of_the_samples():
    config, plants = design_lqi(task()), random_plants(8)
    setup = Setup(0.01, 0.01, 1, 60.0, 1000.0, tension_step_n=0.5, speed_step_m_per_s=1e-3)
    fast, slow = (run(config, plants, course(), setup, record=True) for run in (simulate, simulate_slowly))
    assert np.abs(fast.tension_n - slow.tension_n).max() < 1.0  # one sample on an edge, and they part
    assert np.median(np.abs(fast.tension_n - slow.tension_n)) < 1e-6
    free = simulate(config, plants, course(), Setup(0.01, 0.01, 1, 60.0, 1000.0))
    assert (fast.rmse_n != free.rmse_n).all()


def test_the_plant_is_that_of_the_simulated_line():
    """The torques that a loop has applied, on the simulated line's own integrator."""
    theta, (one,) = model(), [random_plants(1, seed=5)]
    theta = one.model(0)
    found = simulate(design_lqi(task()), one, course(periods=100), Setup(0.01, 0.01, 10, 60.0, 1000.0), record=True)
    truth = WebParameters(
        np.full(6, theta.stiffness_n), theta.length_m, theta.radius_m, theta.inertia_kg_m2, theta.friction_nms_per_rad,
        np.zeros(6),
    )  # fmt: skip
    from gateway.control.rollout import start

    (state,), (torque,) = start(one, course(periods=100))
    acting = np.vstack((torque, found.torque_nm[0]))[:50]  # a period late, and up to the unwinder's step
    tension = simulated(truth, state, acting, 0.01, Terms(0.01, 0.01, 60.0, 1000.0))
    assert np.allclose(tension[9:-1:10], found.tension_n[0, 1:50], atol=1e-6)


@settings(max_examples=25)
@given(st.integers(0, 10_000), st.sampled_from([*LINEAR, design_mpc]))
def test_torque_never_leaves_its_limits_and_designs_hold_on_the_box(seed, design):
    found = simulate(
        design(task()), random_plants(4, seed=seed), course(periods=300),
        Setup(0.01, 0.01, 1, 60.0, 1000.0, 0.1, 1e-4, 1.6e-3, seed=seed), record=True,
    )  # fmt: skip
    assert found.torque_max_nm.max() <= 60.0 and found.torque_step_max_nm.max() <= 10.0 + 1e-9
    assert np.abs(found.tension_n[:, -20:] - 30.0 - 14.0 * (np.arange(6) == 3)).max() < 10.0


@pytest.mark.parametrize(
    ("setup", "says"),
    [(Setup(0.02, 0.0), "period"), (Setup(0.01, 0.003, 2), "latency")],
)
def test_what_does_not_fit_is_refused(setup, says):
    with pytest.raises(ValueError, match=says):
        simulate(design_lqi(task()), random_plants(1), course(), setup)


def test_the_start_is_each_plants_own_equilibrium():
    from gateway.control.rollout import rate, start

    plants = random_plants(5)
    states, torques = start(plants, course())
    for b in range(plants.count):
        assert np.abs(rate(plants.model(b), states[b], torques[b], 0.01)).max() < 1e-9
