"""The recursive estimator on the paper's two equations, without and with noise; what it does without data."""

from dataclasses import replace

import numpy as np
import pytest

from gateway.core.line import Line
from gateway.core.line_file import load_line
from gateway.core.line_template import line_template
from gateway.core.theta import Noise
from gateway.identification.estimate import Structure
from gateway.identification.recursive import (
    METHOD,
    Sample,
    Settings,
    begin,
    estimate,
    estimated_recursively,
    samples_of,
    update,
)
from gateway.identification.recursive_kernel import age
from tests.closed_loop.recorded import without
from tests.unit.regression_support import shaken, true_model

STRONG = {"stiffness_per_length": 2200.0 / 1.2, "radius_per_inertia": 0.035, "friction_per_inertia": 15.0}
QUIET = Noise(tension_n=1e-6, speed_m_per_s=1e-9, acceleration_m_per_s1_5=1e-9)


def line_of(n=6, latency_s=0.01) -> Line:
    line = load_line(line_template(n, "line.toml"), "line.toml")
    return line.model_copy(update={"control": line.control.model_copy(update={"latency_s": latency_s})})


def worst(found, truth=None):
    """Largest relative error of the strong combinations."""
    return max(abs(found.intervals[name].value / value - 1.0) for name, value in (truth or STRONG).items())


@pytest.mark.parametrize("latency_s", [0.0, 0.004, 0.01, 0.015])
def test_exact_data_give_the_truth_whatever_the_latency(latency_s):
    line = line_of(3, latency_s)
    found = estimated_recursively(Settings(line, QUIET), shaken(line, true_model(3)))
    assert worst(found) < (5e-3 if latency_s % 0.01 else 3e-4)  # a speed that bends within a period
    assert found.method == METHOD
    assert found.samples == 500
    assert found.theta.latency_s == latency_s
    np.testing.assert_allclose(found.theta.web.stiffness_n, 2200.0, rtol=2e-3)
    np.testing.assert_allclose(found.theta.web.radius_m, 0.035, rtol=2e-2)


def test_a_lag_that_is_known_is_taken_into_account():
    """The same torques, as they would have been sent to drives with a lag of 20 ms to give what was given."""
    line, lag_s, h = line_of(3), 0.02, 0.01
    data = shaken(line, true_model(3))
    left = np.exp(-h / lag_s)
    target, given = [data.torque_nm[0]], data.torque_nm[0]
    lagging = Settings(line, QUIET, torque_lag_s=lag_s)
    weight = begin(lagging).withheld
    for torque in data.torque_nm[1:]:  # whose first period counts as `torque`
        target.append((torque - weight * given) / (1.0 - weight))
        given = target[-1] + left * (given - target[-1])
    sent = replace(data, torque_nm=np.array(target))
    found = estimated_recursively(lagging, sent)
    assert worst(found) < 3e-4
    assert found.theta.torque_lag_s == lag_s
    assert worst(estimated_recursively(Settings(line, QUIET), sent)) > 0.05


def test_a_latency_from_elsewhere_goes_before_that_of_the_file():
    line, data = line_of(3), shaken(line_of(3, 0.02), true_model(3))
    found = estimated_recursively(Settings(line, QUIET, latency_s=0.02), data)
    assert worst(found) < 3e-4
    assert found.theta.latency_s == 0.02
    assert worst(estimated_recursively(Settings(line, QUIET), data)) > 0.05


def test_rollers_that_differ():
    line, model = line_of(3), true_model(3, spread=0.1)
    found = estimated_recursively(Settings(line, QUIET), shaken(line, model), Structure(per_roller=True))
    for i in range(3):
        truth = {
            f"stiffness_per_length[{i + 1}]": 2200.0 / model.length_m[i],
            f"radius_per_inertia[{i + 1}]": model.radius_m[i] / model.inertia_kg_m2[i],
            f"friction_per_inertia[{i + 1}]": model.friction_nms_per_rad[i] / model.inertia_kg_m2[i],
        }
        assert worst(found, truth) < 3e-4
    assert "stiffness_n" in found.intervals
    assert "stiffness_n[1]" not in found.intervals


def test_coulomb_friction_is_told_apart_from_viscous_friction_where_it_is_asked_for():
    line = line_of(3)
    data = shaken(line, true_model(3), coulomb_nm=2.0)
    with_it = estimated_recursively(Settings(line, QUIET), data, Structure(coulomb=True))
    assert worst(with_it) < 3e-4
    np.testing.assert_allclose(with_it.theta.coulomb_nm, 2.0, rtol=1e-2)
    assert with_it.intervals["coulomb_nm"].value == pytest.approx(2.0, rel=1e-2)
    without_it = estimated_recursively(Settings(line, QUIET), data)
    assert worst(without_it) > 0.02  # the viscous friction takes its part
    assert not without_it.theta.coulomb_nm.any()


def test_there_is_no_coulomb_friction_below_zero():
    line = line_of(2)
    data = shaken(line, true_model(2), coulomb_nm=-0.5)
    found = estimated_recursively(Settings(line, QUIET), data, Structure(coulomb=True))
    assert not found.theta.coulomb_nm.any()
    assert found.intervals["coulomb_nm"].low == 0.0


def test_a_torque_lag_is_refused():
    line = line_of(2)
    with pytest.raises(ValueError, match="do not tell a torque lag"):
        estimate(Settings(line), begin(Settings(line)), Structure(torque_lag=True))


@pytest.mark.parametrize("forgetting_s", [0.0, -1.0, float("nan")])
def test_settings_refuse_what_they_cannot_do(forgetting_s):
    with pytest.raises(ValueError, match="forgetting_s: is"):
        Settings(line_of(1), forgetting_s=forgetting_s)
    with pytest.raises(ValueError, match=r"latency_s: is -0.01, should be 0 or greater"):
        Settings(line_of(1), latency_s=-0.01)
    with pytest.raises(ValueError, match=r"torque_lag_s: is -0.01, should be 0 or greater"):
        Settings(line_of(1), torque_lag_s=-0.01)
    with pytest.raises(ValueError, match="noise: is"):
        Settings(line_of(1), noise=Noise(tension_n=0.0))


def test_a_recording_of_another_line_is_refused():
    data = shaken(line_of(2), true_model(2), 0.1)
    with pytest.raises(ValueError, match=r"shaken: has 2 spans at a period of 0.01 s; the line has 3 at 0.01 s"):
        estimated_recursively(Settings(line_of(3)), data)


def test_nothing_learnt_is_the_prior():
    line = line_of(2)
    found = estimate(Settings(line), begin(Settings(line)))
    spread = found.intervals["stiffness_n"]
    assert spread.value == pytest.approx(2400.0)
    assert spread.high / spread.value == pytest.approx(np.exp(1.96 * np.log(1.3) / np.sqrt(3.0)))
    assert found.theta.web.radius_m.tolist() == pytest.approx([0.04, 0.04])


def test_a_gap_costs_what_is_missing_and_nothing_else():
    line, settings = line_of(3), Settings(line_of(3), QUIET)
    data = without(shaken(line, true_model(3)), 200, 237)
    found = estimated_recursively(settings, data)
    assert worst(found) < 3e-4

    live = begin(settings)
    for sample in samples_of(data):
        update(settings, live, sample)
    assert worst(estimate(settings, live)) < 3e-4


def test_a_sample_that_is_not_known_starts_its_own_filters_again():
    line = line_of(3)
    settings = Settings(line, QUIET)
    state = begin(settings)
    for k, sample in enumerate(samples_of(shaken(line, true_model(3)))):
        holes = sample.speed_m_per_s.copy()
        if k % 50 == 20:
            holes[1] = np.nan
        update(settings, state, replace(sample, speed_m_per_s=holes))
    assert worst(estimate(settings, state)) < 3e-4
    counts = state.sums[:, 1]
    assert counts[0] > counts[1]  # roller 1 has lost nothing
    assert counts[3] > max(counts[4], counts[5])  # spans 2 and 3 end at roller 2


def test_a_span_without_load_cell_tells_nothing_and_neither_do_its_rollers():
    line = line_of(4)
    data = shaken(line, true_model(4))
    data.tension_n[:, 3] = np.nan
    found = estimated_recursively(Settings(line, QUIET), data, Structure(per_roller=True))
    assert found.intervals["friction_per_inertia[2]"].value == pytest.approx(15.0, rel=1e-3)
    for i in (3, 4):
        interval = found.intervals[f"friction_per_inertia[{i}]"]
        assert interval.value == pytest.approx(10.0 / 0.95)
        assert interval.high > 1.9 * interval.value
    assert found.intervals["stiffness_per_length[3]"].value == pytest.approx(2200.0 / 1.2, rel=1e-3)


def test_a_sample_that_comes_twice_or_late_is_left_out():
    line = line_of(2)
    settings = Settings(line, QUIET)
    state = begin(settings)
    samples = samples_of(shaken(line, true_model(2), 1.0))
    for sample in samples:
        update(settings, state, sample)
    before = state.information.copy()
    update(settings, state, samples[-1])
    update(settings, state, samples[3])
    assert state.samples == 100
    np.testing.assert_array_equal(state.information, before)


def test_normal_equations_are_those_of_weighted_least_squares():
    """The sums of the kernel by their definition, for one roller: filter regressors and speed, then add up."""
    line, noise, forgetting_s = line_of(1), Noise(), 2.0
    settings = Settings(line, noise, forgetting_s=forgetting_s)
    data = shaken(line, true_model(1), 1.0, noise)
    state = begin(settings)
    for sample in samples_of(data):
        update(settings, state, sample)
    h, v, T, u = 0.01, data.speed_m_per_s[:, 0], data.tension_n[:, 0], data.torque_nm[:, 0]
    moves, sample_noise = noise.acceleration_m_per_s1_5**2 * h, noise.speed_m_per_s**2
    M, m = np.zeros((3, 3)), np.zeros(3)
    predicted, response, variance = v[1], np.zeros(3), sample_noise  # the torque before the second sample is known
    for k in range(1, len(v) - 1):
        response = response + h * np.array([-v[k], u[k - 1], -0.5 * (T[k] + T[k + 1])])
        variance += moves
        keep = np.exp(-h * (len(v) - 2 - k) / forgetting_s)
        weight = keep / (variance + sample_noise)
        M += weight * np.outer(response, response)
        m += weight * response * (v[k + 1] - predicted)
        gain = variance / (variance + sample_noise)
        predicted += gain * (v[k + 1] - predicted)
        response = (1.0 - gain) * response
        variance *= 1.0 - gain
    np.testing.assert_allclose(state.information[0, :3, :3], M, rtol=1e-9)
    np.testing.assert_allclose(state.moment[0, :3], m, rtol=1e-9)


def test_a_walk_of_a_parameter_widens_its_covariance_alone():
    """`age` by its definition: P + d d', by way of an inverse."""
    generator = np.random.default_rng(3)
    root = generator.standard_normal((2, 4, 4))
    information = root @ root.transpose(0, 2, 1) + np.eye(4)
    theta = generator.standard_normal((2, 4))
    moment = np.einsum("ijk,ik->ij", information, theta)
    sums = np.array([[100.0, 7.0], [100.0, 7.0]])
    drift = np.array([[0.3, -0.1, 0.0, 0.2], [0.5, 0.0, 0.0, 0.0]])
    found, found_moment = information.copy(), moment.copy()
    age(0.9, drift, found, found_moment, sums)
    for row in range(2):
        covariance = np.linalg.inv(information[row]) + np.outer(drift[row], drift[row])
        np.testing.assert_allclose(found[row], 0.9 * np.linalg.inv(covariance), rtol=1e-9)
        np.testing.assert_allclose(np.linalg.solve(found[row], found_moment[row]), theta[row], rtol=1e-9)
        least = sums[row, 0] - theta[row] @ found[row] @ theta[row]  # the least squared residual only fades
        assert least == pytest.approx(0.9 * (100.0 - theta[row] @ information[row] @ theta[row]), rel=1e-9)
        assert sums[row, 1] == 6.3


def test_without_excitation_what_was_learnt_fades_to_the_prior_and_no_further():
    """A line without web for a minute: with a forgetting factor alone, the covariance would grow by exp(60 / 2)."""
    line = line_of(2)
    settings = Settings(line, forgetting_s=2.0)
    state = begin(settings)
    for sample in samples_of(shaken(line, true_model(2), 5.0, Noise())):
        update(settings, state, sample)
    learnt = estimate(settings, state).intervals
    unknown = estimate(settings, begin(settings)).intervals
    for k in range(6000):
        update(settings, state, Sample(6.0 + 0.01 * k, np.zeros(2), np.zeros(2), np.zeros(2), 0.0))
    faded = estimate(settings, state).intervals
    for name in ("stiffness_per_length", "radius_per_inertia", "friction_per_inertia"):
        assert learnt[name].high / learnt[name].low < 1.2
        width = np.log(faded[name].high / faded[name].low) / np.log(unknown[name].high / unknown[name].low)
        assert 0.9 < width <= 1.0 + 1e-9
        assert np.isfinite(faded[name].value)
    for sample in samples_of(shaken(line, true_model(2), 5.0, Noise(), seed=1)):  # and it learns again
        update(settings, state, replace(sample, time_s=sample.time_s + 70.0))
    again = estimate(settings, state)
    assert worst(again) < 0.05


def test_noise_widens_the_intervals_as_much_as_it_is_there():
    """Five times the noise of tensions that is believed: the residuals say so."""
    line = line_of(3)
    widths = []
    for tension_n in (0.1, 0.5):
        data = shaken(line, true_model(3), noise=Noise(tension_n=tension_n))
        interval = estimated_recursively(Settings(line), data).intervals["stiffness_per_length"]
        assert interval.covers(2200.0 / 1.2)
        widths.append(np.log(interval.high / interval.low))
    assert 4.0 < widths[1] / widths[0] < 6.0
