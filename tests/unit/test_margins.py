"""Margins against a simulation in time, and a design's noise against a long rollout."""

import numpy as np
import pytest

from gateway.control.design import (
    DesignLimits,
    DesignRefused,
    DesignTask,
    LqgWeights,
    design_lqg,
    design_lqi,
    design_lqr,
    design_pid,
    margins,
    require_margin,
)  # fmt: skip
from gateway.control.rollout import Course, Setup, plants_of, simulate
from tests.unit.control_support import model


def task(**changes):
    values = {"period_s": 0.01, "latency_s": 0.01, "limits": DesignLimits()} | changes
    return DesignTask(model(), tension_n=np.full(6, 30.0), unwind_speed_m_per_s=0.05, **values)


@pytest.mark.parametrize("design", [design_pid, design_lqr, design_lqi, design_lqg])
def test_the_delay_margin_is_where_the_loop_begins_to_grow(design):
    config = design(task())
    found = margins(config, task())
    assert found.spectral_radius < 1.0 and found.delay_margin_s > 0.0
    tension = np.full((1000, 6), 30.0)
    tension[10:, 2] += 1e-4  # so small that nothing but the linear loop is seen
    plants = plants_of([model()])
    last = []
    for extra_s in (found.delay_margin_s - 0.0005, found.delay_margin_s + 0.001):
        loop = Setup(0.01, round(0.01 + extra_s, 4), 20)
        swing = simulate(config, plants, Course(tension, np.full(1000, 0.05)), loop, record=True).torque_nm[0]
        last.append(np.ptp(swing[700:], axis=0).max() / np.ptp(swing[300:600], axis=0).max())
    assert last[0] < 1.0 < last[1]


@pytest.mark.parametrize("design", [design_pid, design_lqr, design_lqi, design_lqg])
def test_chatter_and_floor_are_those_of_a_long_run(design):
    config, wanted = design(task()), margins(design(task()), task())
    noise = task().noise
    loop = Setup(
        0.01, 0.01, 1, np.inf, np.inf, noise.tension_n, noise.speed_m_per_s, noise.acceleration_m_per_s1_5, seed=4
    )
    still = Course(np.full((40_000, 6), 30.0), np.full(40_000, 0.05))
    found = simulate(config, plants_of([model()]), still, loop, record=True)
    chatter = np.diff(found.torque_nm[0, 1000:], axis=0).std(axis=0).max()
    assert chatter == pytest.approx(wanted.chatter_nm, rel=0.03)
    error = found.tension_n[0, 1000:] - 30.0
    assert np.sqrt(np.mean(np.sum(error**2, axis=1))) == pytest.approx(wanted.noise_floor_n, rel=0.1)


def test_a_hasty_observer_is_not_offered():
    hasty = design_lqg(task(), LqgWeights(torque_per_nm2=1e-5, disturbance_nm_per_sqrt_s=2000.0))
    with pytest.raises(DesignRefused, match="ms more delay"):
        require_margin(margins(hasty, task()))


def test_what_cannot_be_held_is_refused_with_the_reason():
    with pytest.raises(DesignRefused, match="roller 1 needs .* Nm to keep 0.1 m/s"):
        design_lqi(task(limits=DesignLimits(torque_nm=10.0, speed_max_m_per_s=0.1)))
    with pytest.raises(DesignRefused, match="latency_s"):
        design_lqi(task(latency_s=float("nan")))
    with pytest.raises(DesignRefused, match="would tear"):
        DesignTask(model(), 0.01, 0.01, np.full(6, 3000.0), 0.05) and design_lqi(
            DesignTask(model(), 0.01, 0.01, np.full(6, 3000.0), 0.05)
        )
