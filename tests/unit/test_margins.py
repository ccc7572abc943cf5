"""Margins against a simulation in time, and a design's noise against a long rollout."""

from dataclasses import replace

import numpy as np
import pytest

from gateway.control.design import (
    DesignLimits,
    DesignRefused,
    DesignTask,
    LqgWeights,
    MpcWeights,
    design_lqg,
    design_lqi,
    design_lqr,
    design_mpc,
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


def test_a_disturbance_that_nothing_corrects_does_not_make_a_loop_unstable():
    """The baseline MPC has no offset to take away: its margins are those of one whose estimate hardly moves."""
    still, slow = (margins(design_mpc(task(), MpcWeights(disturbance_nm_per_sqrt_s=d)), task()) for d in (0.0, 1e-4))
    assert still.spectral_radius < 1.0
    assert still.delay_margin_s == pytest.approx(slow.delay_margin_s, abs=0.0006)
    assert still.chatter_nm == pytest.approx(slow.chatter_nm, rel=0.02)


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


@pytest.mark.parametrize("design", [design_pid, design_lqr, design_lqi, design_lqg, design_mpc])
@pytest.mark.parametrize(
    ("changes", "says"),
    [
        ({"draw_spans": (6,)}, r"draw_spans is \[6\]; allowed: whole numbers from 0 to 5, ascending, each once"),
        ({"draw_spans": (-1,)}, r"draw_spans is \[-1\]"),
        ({"draw_spans": (2, 1)}, "ascending"),
        ({"draw_spans": (1, 1)}, "each once"),
        ({"draw_spans": (0.5,)}, "whole numbers"),
        ({"limits": DesignLimits(tension_min_n=50.0, tension_max_n=40.0)}, "tension_min_n is 50; allowed: below .* 40"),
        ({"limits": DesignLimits(tension_min_n=-1.0)}, "tension_min_n is -1; allowed: 0 and above"),
        ({"limits": DesignLimits(tension_max_n=float("nan"))}, "tension_max_n is nan; allowed: above 0"),
        ({"limits": DesignLimits(speed_max_m_per_s=float("nan"))}, "speed_max_m_per_s is nan"),
        ({"period_s": float("inf")}, "period_s is inf; allowed: above 0, finite"),
        (
            {"draw_spans": (1,), "unwind_speed_m_per_s": 0.0},
            "span 2 is draw-controlled: .* design for a speed at which",
        ),
    ],
)
def test_every_design_refuses_a_task_that_is_none(design, changes, says):
    with pytest.raises(DesignRefused, match=says):
        design(replace(task(), **changes))


@pytest.mark.parametrize("design", [design_pid, design_lqr, design_lqi, design_lqg])
def test_a_draw_line_designed_for_its_speed_also_stands(design):
    """What the refusal of a design for standstill says to do."""
    config = design(replace(task(), draw_spans=(1,)))
    loop = Setup(0.01, 0.01, 1, 60.0, 1000.0, 0.1, 1e-4, 1.6e-3, seed=2)
    unwind = np.concatenate((np.full(100, 0.05), np.linspace(0.05, 0.0, 100), np.zeros(800)))
    found = simulate(config, plants_of([model()]), Course(np.full((1000, 6), 30.0), unwind), loop, record=True)
    error = np.abs(found.tension_n[0, 300:] - 30.0).max(axis=0)
    assert np.delete(error, 1).max() < 1.0 and error[1] < 10.0  # the draw span keeps the tension that it came with
