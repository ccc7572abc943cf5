"""When an adaptation is over: what a measurement asks for, and what is made of what it shows."""

from dataclasses import replace

import numpy as np
import pytest

from gateway.commissioning.candidates import NotOffered
from gateway.commissioning.convergence import (
    DWELL_S,
    STEPS,
    Convergence,
    SpanFigures,
    convergence,
    measurement,
)
from gateway.control.design import design_lqi, task_on
from gateway.core.deployment import Region
from gateway.core.experiment import reasons_against, setpoints
from gateway.core.line_model import model_of, noise_of, parameters_of, theta_of
from gateway.core.recording import Recording
from gateway.core.theta import nominal_theta
from tests.unit.supervisor_support import line_of

LINE = line_of(2)
TENSION_N = [28.0, 36.0]
SPEEDS_M_PER_S = (0.03, 0.06)


def model(stiffer=1.0):
    theta = nominal_theta(LINE)
    theta = replace(theta, web=replace(theta.web, stiffness_n=stiffer * theta.web.stiffness_n))
    return model_of(
        {
            "format": 1, "site": LINE.site, "line": LINE.line, "created": "2026-01-05T06:00:00+00:00",
            "program_version": "0", "method": "test",
            "structure": {"per_roller": False, "coulomb": False, "torque_lag": False},
            "parameters": parameters_of(theta),
            "noise": {"tension_n": 0.1, "speed_m_per_s": 1e-4, "acceleration_m_per_s1_5": 1.6e-3},
            "intervals": {}, "data": {"digest": "0" * 64, "source": "test", "samples": 1000, "period_s": 0.01},
            "region": {
                "speed_from_m_per_s": 0.01, "speed_to_m_per_s": 0.12,
                "tension_from_n": [20.0, 20.0], "tension_to_n": [40.0, 40.0],
            },
        }
    )  # fmt: skip


MODEL = model()
CONFIG = design_lqi(task_on(LINE, theta_of(MODEL), noise_of(MODEL)))


def recording(tension_n, setpoint_n, speed_m_per_s):
    """As if it had been measured."""
    k = len(setpoint_n)
    zeros = np.zeros_like(setpoint_n)
    return Recording(
        0.01 * np.arange(k), tension_n, setpoint_n, zeros, zeros, zeros, speed_m_per_s, np.ones(k, bool), 0.01, "test"
    )


def stepped(off_n=0.0):
    """A span 1 that goes from 28 to 30 N with a lag of 50 ms and stands `off_n` from there, and one that stands."""
    setpoint = np.tile(TENSION_N, (900, 1))
    setpoint[300:, 0] = 30.0
    tension = setpoint.copy()
    tension[300:, 0] += off_n - 2.0 * np.exp(-0.01 * np.arange(600) / 0.05)
    return recording(tension, setpoint, np.full(900, 0.06))


def test_every_span_steps_at_each_speed_within_what_the_line_and_the_region_permit():
    region = Region(speed_max_m_per_s=0.06, tension_step_max_n=2.0)
    asked = measurement(LINE, region, TENSION_N, SPEEDS_M_PER_S, 1.0, 3)
    assert asked.amplitude_n == [1.0, 1.0] and reasons_against(asked, LINE, np.array(TENSION_N), 0.01) == []
    wide = measurement(LINE, None, TENSION_N, SPEEDS_M_PER_S, 1.0, 3)
    assert wide.amplitude_n == pytest.approx([1.6, 1.6]) and wide.abort.deviation_n > 2.0 * max(wide.amplitude_n)
    moved = setpoints(asked, np.array(TENSION_N), 0.01).reshape(2, -1, 2)
    assert moved.shape[1] == round(STEPS * DWELL_S / 0.01) and (np.ptp(moved, axis=1) > 0.0).all()
    with pytest.raises(NotOffered, match="narrow"):
        measurement(LINE, Region(tension_step_max_n=0.0), TENSION_N, SPEEDS_M_PER_S, 1.0, 3)


@pytest.mark.parametrize(
    ("one", "other", "converged"),
    [((0.2, 5.0, 0.5), (0.1, 5.0, 0.5), True), ((1.4, 20.0, 2.0), (0.1, 5.0, 0.5), True),
     ((1.41, 5.0, 0.5), (0.1, 5.0, 0.5), False), ((0.2, 20.1, 0.5), (0.1, 5.0, 0.5), False),
     ((0.2, 5.0, 2.01), (0.1, 5.0, 0.5), False), ((0.2, 5.0, None), (0.1, 5.0, 0.5), False)],
)  # fmt: skip
def test_the_criteria_hold_for_every_span(one, other, converged):
    def figures(rmse, overshoot, settling):
        return SpanFigures(rmse_n=rmse, overshoot_pct=overshoot, settling_s=settling, setpoint_n=28.0)

    found = Convergence(spans={"1": figures(*one), "2": figures(*other)}, predicted={}, rmse_n=1.0, gap=-0.09)
    assert found.converged is converged and found.settled is converged
    assert not found.model_copy(update={"gap": 0.11}).settled


def test_figures_are_those_of_the_worst_change_and_smooth_noise_away():
    found = convergence(LINE, stepped(), CONFIG, MODEL)
    assert found.converged
    # 2 exp(-t / 50 ms), sampled every 10 ms over 6 s; it is within 0.6 N from 61 ms on, and a mean over 50 ms later.
    assert found.spans["1"].rmse_n == pytest.approx(2.0 * np.sqrt(1.0 / (1.0 - np.exp(-0.4)) / 600), rel=1e-6)
    assert found.spans["1"].settling_s == pytest.approx(0.09, abs=0.02)
    assert found.spans["2"].rmse_n == 0.0 and found.spans["1"].setpoint_n == 30.0
    slow = convergence(LINE, stepped(off_n=0.7), CONFIG, MODEL)
    assert slow.spans["1"].settling_s is None and not slow.converged and "span 1" in slow.text
    noisy = stepped()
    noisy.tension_n[:] += 0.1 * np.random.default_rng(1).standard_normal(noisy.tension_n.shape)
    assert convergence(LINE, noisy, CONFIG, MODEL).spans["2"].overshoot_pct < 1.0  # 0.9 % are 3 sigma


def test_a_move_is_looked_at_from_its_begin_and_as_a_whole():
    setpoint = np.tile(TENSION_N, (900, 1))
    setpoint[300:320, 0] = np.linspace(28.1, 30.0, 20)
    setpoint[320:, 0] = 30.0
    tension = setpoint.copy()
    tension[320:, 0] += 0.4 * np.exp(-0.01 * np.arange(580) / 0.3)
    found = convergence(LINE, recording(tension, setpoint, np.full(900, 0.06)), CONFIG, MODEL).spans["1"]
    assert found.overshoot_pct == pytest.approx(19.0, abs=3.0)  # 0.4 N of 2 N, smoothed
    assert found.settling_s == pytest.approx(0.16, abs=0.05)  # from 28 N until within 0.6 N of 30 N


def test_a_line_that_does_otherwise_than_foreseen_has_something_to_gain():
    asked = measurement(LINE, None, TENSION_N, SPEEDS_M_PER_S, 1.0, 3)
    moved = setpoints(asked, np.array(TENSION_N), 0.01)
    course = np.vstack((np.tile(TENSION_N, (100, 1)), moved))
    ideal = convergence(LINE, recording(course, course, np.full(len(course), 0.06)), CONFIG, MODEL)
    assert ideal.converged and ideal.gap < -0.9 and ideal.gains and not ideal.settled
    assert 0.0 < ideal.predicted["1"].rmse_n < 1.0 and ideal.predicted["1"].settling_s is not None


def test_while_the_speed_moves_nothing_is_looked_at():
    setpoint = stepped().tension_setpoint_n
    with pytest.raises(NotOffered, match="speed"):
        convergence(LINE, recording(setpoint, setpoint, np.linspace(0.01, 0.1, 900)), CONFIG, MODEL)


@pytest.mark.parametrize("lost", [slice(100, 102), slice(297, 299), slice(0, 60)])
def test_samples_that_were_lost_before_a_step_take_nothing_from_it(lost):
    whole, holed = stepped(), stepped()
    holed.tension_n[lost] = np.nan
    expected = convergence(LINE, whole, CONFIG, MODEL).spans
    found = convergence(LINE, holed, CONFIG, MODEL).spans
    for name, one in expected.items():
        assert found[name].model_dump() == pytest.approx(one.model_dump(), abs=1e-9)
    holed.tension_n[500, 1] = np.nan
    with pytest.raises(NotOffered):
        convergence(LINE, holed, CONFIG, MODEL)
