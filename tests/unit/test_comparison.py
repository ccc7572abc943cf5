"""Free runs against an integrator of the tests' own, and what the comparison says of estimates."""

from dataclasses import replace

import numpy as np
import pytest

from gateway.core.line_file import load_line
from gateway.core.line_template import line_template
from gateway.core.theta import Noise, Theta, nominal_theta
from gateway.identification.comparison import compare
from gateway.identification.estimate import Estimate, Structure
from gateway.identification.free_run import periods_before, run_freely, windows_of
from tests.unit.regression_support import shaken, true_model


def line_of(n=3, latency_s=0.01):
    line = load_line(line_template(n, "line.toml"), "line.toml")
    return line.model_copy(update={"control": line.control.model_copy(update={"latency_s": latency_s})})


def truth(n=3, latency_s=0.01, coulomb_nm=0.0, lag_s=0.0):
    return Theta(true_model(n), np.full(n, coulomb_nm), lag_s, latency_s)


def of(theta, method="truth"):
    return Estimate(method, Structure(), theta, None, {}, 0)


@pytest.mark.parametrize("latency_s", [0.0, 0.01, 0.013, 0.027])
def test_a_free_run_of_the_truth_is_what_happened(latency_s):
    line, theta = line_of(3, latency_s), truth(3, latency_s, coulomb_nm=1.5)
    data = shaken(line, theta.web, 2.0, coulomb_nm=1.5)
    windows = windows_of([data], 100, periods_before(theta, 0.01), 25)
    tension, speed = run_freely(theta, windows)
    # A torque that changes within a step of 5 ms counts as its mean over the step.
    most = 1e-5 if latency_s in (0.0, 0.01) else 2e-2
    np.testing.assert_allclose(tension, windows.tension_n[:, 1:], atol=most)
    np.testing.assert_allclose(speed, windows.speed_m_per_s[:, 1:], atol=most / 50.0)


def test_a_lag_acts_as_a_first_order_filter_of_the_torque():
    """Against the lag's own solution: a roller without friction and web, whose torque jumps."""
    lag_s, h = 0.02, 0.01
    web = replace(true_model(1), stiffness_n=0.0, friction_nms_per_rad=np.zeros(1), radius_m=np.full(1, 1e-3))
    theta = Theta(web, np.zeros(1), lag_s, h)
    data = shaken(line_of(1), true_model(1), 1.0)
    torque = np.where(np.arange(100) < 50, 0.0, 1.0)[:, None]
    data = replace(data, torque_nm=torque, speed_m_per_s=np.full((100, 1), 0.05), tension_n=np.zeros((100, 1)))
    before = periods_before(theta, h)
    assert before == 12
    windows = windows_of([data], 60, before, 1)
    at = 30 - before  # the window that begins at sample 30
    _, speed = run_freely(theta, windows)
    t = h * (30 + 1 + np.arange(60)) - 51 * h  # the jump acts from sample 51 on
    expected = np.where(t > 0.0, t - lag_s * (1.0 - np.exp(-t / lag_s)), 0.0) * web.radius_m[0] / web.inertia_kg_m2[0]
    np.testing.assert_allclose(speed[at, :, 0] - 0.05, expected, atol=1e-9)


def test_the_better_theta_is_first_and_a_worse_one_far_behind():
    line = line_of()
    data = shaken(line, true_model(3), 5.0, Noise())
    near = truth()
    near = replace(near, web=replace(near.web, friction_nms_per_rad=near.web.friction_nms_per_rad * 1.0001))
    estimates = [
        (of(nominal_theta(line), "file"), 0.0), (of(truth(lag_s=0.005), "lag"), 0.2),
        (of(near, "near"), 0.3), (of(truth()), 0.4),
    ]  # fmt: skip
    found = compare(estimates, [data])
    assert [row.estimate.method for row in found.rows][2:] == ["lag", "file"]
    assert found.best is found.rows[0]
    assert found.best.behind == 0.0
    assert found.rows[1].behind < 2.0  # a friction that is off by 0.01 % is not worse, for all one can say
    assert found.rows[2].behind > 2.0
    assert found.rows[3].seconds == 0.0
    assert found.rows[2].seconds == 0.2
    assert found.steps == 494  # five samples of torque come before the first for whoever believes in the lag
    assert found.windows == 16


def test_errors_of_the_truth_are_noise():
    line = line_of()
    quiet = Noise(acceleration_m_per_s1_5=0.0)
    found = compare([(of(truth()), 0.0)], [shaken(line, true_model(3), 5.0, quiet)])
    assert found.best.one_step.tension == pytest.approx(np.sqrt(2.0), rel=0.05)
    assert found.best.one_step.speed == pytest.approx(np.sqrt(1.0 + np.exp(-0.3)), rel=0.05)
    assert found.best.free_run.tension < 2.0
    assert found.best.score == found.best.free_run.both


def test_a_theta_that_runs_away_is_last():
    line = line_of()
    wild = truth()
    wild = replace(wild, web=replace(wild.web, friction_nms_per_rad=np.full(3, -4e4)))
    found = compare([(of(wild, "wild"), 0.0), (of(truth()), 0.0)], [shaken(line, true_model(3), 3.0, Noise())])
    assert [row.estimate.method for row in found.rows] == ["truth", "wild"]
    assert found.rows[1].score == np.inf
    assert found.rows[1].behind == np.inf


def test_a_span_without_load_cell_is_not_judged():
    line = line_of()
    data = shaken(line, true_model(3), 3.0)
    data.tension_n[:, 1] = np.nan
    found = compare([(of(truth()), 0.0)], [data])
    assert np.isfinite(found.best.score)


def test_what_is_refused():
    data = shaken(line_of(2), true_model(2), 0.5)
    with pytest.raises(ValueError, match="0 estimates and 1 recordings"):
        compare([], [data])
    with pytest.raises(ValueError, match="truth: is of 3 spans, shaken of 2"):
        compare([(of(truth(3)), 0.0)], [data])
    with pytest.raises(ValueError, match="shaken: nothing is known and under control for 103 periods in a row"):
        compare([(of(truth(2)), 0.0)], [data])
    with pytest.raises(ValueError, match=r"recordings differ: 2 spans at 0.01 s, 3 spans at 0.01 s"):
        compare([(of(truth(2)), 0.0)], [data, shaken(line_of(3), true_model(3), 0.5)])
