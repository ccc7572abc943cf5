"""The Kalman predictor: against one that shares no code with it, against cases that can be written down, and itself."""

from dataclasses import replace
from math import exp

import numpy as np
import pytest
from scipy.linalg import solve_discrete_are

from gateway.control.prediction import (
    Unpredictable,
    gains_of,
    imagined,
    innovations,
    predict,
    sampled_model,
    stretch_of,
)
from gateway.core.recording import Recording
from gateway.core.theta import Noise, Theta
from tests.unit import prediction_reference
from tests.unit.control_support import model

NOISE = Noise(0.1, 1e-4, 1.6e-3)
PERIOD_S = 0.01


def theta(n=3, coulomb=0.0, lag=0.0, latency=0.01, **web):
    return Theta(model(n, **web), np.full(n, coulomb), lag, latency)


def recording(n=3, samples=40, seed=0, speed=0.05) -> Recording:
    """Signals near an operating point that no line has brought forth: the predictor must agree on any."""
    generator = np.random.default_rng(seed)
    setpoint = np.tile(np.linspace(28.0, 34.0, n), (samples, 1))
    torque = 12.0 + 3.0 * generator.standard_normal((samples, n))
    return Recording(
        PERIOD_S * np.arange(samples),
        setpoint + 0.3 * generator.standard_normal((samples, n)),
        setpoint,
        speed + 3e-4 * generator.standard_normal((samples, n)),
        torque,
        torque,
        speed + 1e-4 * generator.standard_normal(samples),
        np.ones(samples, dtype=np.bool_),
        PERIOD_S,
        "made up",
    )


@pytest.mark.parametrize(
    ("believed", "unwinder"),
    [
        (theta(), "linear"),
        (theta(coulomb=2.0), "held"),
        (theta(lag=0.005), "linear"),
        (theta(lag=0.001, latency=0.0), "linear"),
        (theta(latency=0.0137), "linear"),
        (theta(coulomb=1.0, lag=0.003, latency=0.0241), "held"),
        (theta(n=1, latency=0.004), "linear"),
    ],
)
def test_it_agrees_with_a_predictor_of_small_steps(believed, unwinder):
    made = recording(believed.n)
    stretch = stretch_of(made, unwinder)
    found = predict(believed, NOISE, stretch)
    expected, covariance = prediction_reference.innovations(
        believed, NOISE, made, stretch.first, linear=unwinder == "linear"
    )
    deviation = np.sqrt(np.diagonal(covariance, axis1=1, axis2=2))
    # One step a period integrates a lag of a tenth of it to 0.015 standard deviations, others to a third of that.
    assert np.abs((found.innovation - expected) / deviation).max() < 0.02
    assert np.allclose(found.gains.covariance / (deviation[:, :, None] * deviation[:, None, :]),
                       covariance / (deviation[:, :, None] * deviation[:, None, :]), atol=2e-3)  # fmt: skip


def test_a_span_without_a_load_cell_is_no_output():
    made = recording()
    tension = made.tension_n.copy()
    tension[:, 1] = np.nan
    made = replace(made, tension_n=tension)
    stretch = stretch_of(made)
    found = predict(theta(), NOISE, stretch)
    expected, _ = prediction_reference.innovations(theta(), NOISE, made, stretch.first, linear=True)
    assert stretch.names == ["tension 1", "tension 3", "speed 1", "speed 2", "speed 3"]
    assert np.allclose(found.innovation, expected, atol=2e-3)


@pytest.mark.parametrize("lag", [0.0, 0.002, 0.005, 0.03])
@pytest.mark.parametrize("latency", [0.0, 0.003, 0.01, 0.0275])
def test_the_response_of_one_roller_is_the_one_of_the_textbook(lag, latency):
    """A web that does not hold anything: the speed follows the torque by itself, after lag and dead time."""
    believed = theta(1, stiffness=1e-9, radius=1e-2, friction=10.0, inertia=0.5, lag=lag, latency=latency)
    pole, gain, begin, step_nm = 10.0 / 0.5, 1e-2 / 0.5, 10, 7.0
    samples = 50
    rest = 0.05
    hold = rest * pole / gain

    def rise(t):
        if t <= 0.0:
            return 0.0
        slow, fast = exp(-pole * t), exp(-t / lag) if lag else 0.0
        mixed = (slow - fast * pole * lag) / (1.0 - pole * lag)
        return gain * step_nm / pole * (1.0 - mixed)

    time_s = PERIOD_S * np.arange(samples)
    made = recording(1, samples)
    made = replace(
        made,
        tension_n=np.zeros((samples, 1)),
        speed_m_per_s=rest + np.array([[rise(t - PERIOD_S * begin - latency)] for t in time_s]),
        torque_nm=np.where(np.arange(samples) >= begin, hold + step_nm, hold)[:, None],
        unwind_speed_m_per_s=np.full(samples, rest),
    )
    stretch = stretch_of(made)
    blind = gains_of(believed, NOISE, stretch)
    blind.gain[:] = 0.0
    speed = innovations([believed], stretch, blind)[0][0, :, 1]
    assert np.abs(speed).max() < 2e-4 * gain * step_nm / pole


def test_a_bearing_with_dry_friction_stays_at_rest():
    believed = theta(1, coulomb=3.0, latency=0.0)
    made = recording(1, 60, speed=0.0)
    still = replace(
        made, tension_n=np.zeros((60, 1)), speed_m_per_s=np.zeros((60, 1)), torque_nm=np.full((60, 1), 1.0),
        unwind_speed_m_per_s=np.zeros(60),
    )  # fmt: skip
    stretch = stretch_of(still)
    blind = gains_of(believed, NOISE, stretch)
    blind.gain[:] = 0.0
    speed = -innovations([believed], stretch, blind)[0][0, :, 1]
    assert np.abs(speed).max() < 1e-3  # it creeps within the width of the sign
    free = -innovations([theta(1, latency=0.0)], stretch, blind)[0][0, :, 1]
    assert free[-1] > 3e-3


def test_the_gain_becomes_that_of_the_algebraic_riccati_equation():
    stretch = stretch_of(recording(samples=3000))
    gains = gains_of(theta(), NOISE, stretch)
    F, Q = sampled_model(theta(), NOISE, PERIOD_S, stretch.points[0])
    R = np.diag([0.01] * 3 + [1e-8] * 3)
    P = solve_discrete_are(F.T, np.eye(6), Q, R)
    scale = np.sqrt(np.diag(R))
    off = (gains.gain[-1] - P @ np.linalg.inv(P + R)) * scale / scale[:, None]
    assert np.abs(off).max() < 1e-4
    assert len(gains.gain) < 2000  # the recursion has come to rest


def test_whitened_innovations_have_the_likelihood_of_the_innovations():
    found = predict(theta(), NOISE, stretch_of(recording()))
    S, e = found.gains.covariance, found.innovation
    mahalanobis = np.einsum("ki,kij,kj->k", e, np.linalg.inv(S), e)
    expected = -0.5 * (mahalanobis + np.linalg.slogdet(S)[1] + 6 * np.log(2 * np.pi))
    assert np.allclose(found.log_likelihood, expected)
    assert found.normalised == pytest.approx(mahalanobis.mean() / 6)


def test_what_the_model_imagines_it_predicts():
    """Outputs made from innovations show these innovations, whose size is then as it should be."""
    believed = theta(coulomb=1.0, lag=0.003, latency=0.013)
    stretch = stretch_of(recording(samples=400))
    gains = gains_of(believed, NOISE, stretch)
    white = np.random.default_rng(1).standard_normal((stretch.predictions, 6))
    drawn = np.linalg.solve(gains.root[gains.which], white[:, :, None])[:, :, 0]
    found = predict(believed, NOISE, imagined(believed, stretch, gains, drawn))
    assert np.allclose(found.whitened, white, atol=1e-9)
    assert found.normalised == pytest.approx(1.0, abs=0.1)
    assert np.allclose(found.normalised_squared, 1.0, atol=0.35)


def test_a_swing_is_learned_from_what_the_model_imagines():
    """0.4 % at roller 2, which nobody is told but by its amplitude: it is found, and innovations are as they should be;
    a model of round rollers has larger ones."""
    believed = theta()
    stretch = stretch_of(recording(samples=1500, speed=0.1))
    swing = np.zeros((3, 2))
    swing[1] = 2.4e-3, -3.2e-3
    stretch = replace(stretch, swing=swing)
    gains = gains_of(believed, NOISE, stretch)
    white = np.random.default_rng(1).standard_normal((stretch.predictions, 6))
    drawn = np.linalg.solve(gains.root[gains.which], white[:, :, None])[:, :, 0]
    line = replace(imagined(believed, stretch, gains, drawn), swing=np.zeros((3, 2)))
    found = predict(replace(believed, eccentricity=np.array([0.0, 4e-3, 0.0])), NOISE, line)
    assert found.swung is not None
    assert np.allclose(found.swung.before[-1], swing, atol=4e-4)
    assert found.normalised == pytest.approx(1.0, abs=0.05)
    assert found.log_likelihood.sum() > predict(believed, NOISE, line).log_likelihood.sum() + 10.0


def test_a_change_of_speed_is_a_new_operating_point():
    made = recording(samples=400)
    v0 = np.where(np.arange(400) < 200, 0.05, 0.1)
    stretch = stretch_of(replace(made, unwind_speed_m_per_s=v0, speed_m_per_s=np.tile(v0[:, None], (1, 3))))
    assert len(stretch.points) == 2
    assert stretch.point[199] == 0 and stretch.point[200] == 1


def test_the_integration_takes_smaller_steps_for_faster_poles():
    """A light roller on a stiff web: one step a period would not even be stable."""
    believed = theta(stiffness=1e5, inertia=0.02, friction=0.1)
    made = recording(samples=30)
    stretch = stretch_of(made)
    found = predict(believed, NOISE, stretch).innovation
    expected, covariance = prediction_reference.innovations(believed, NOISE, made, stretch.first, linear=True)
    deviation = np.sqrt(np.diagonal(covariance, axis1=1, axis2=2))
    assert np.abs((found - expected) / deviation).max() < 0.05 * np.abs(expected / deviation).max()


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"speed_m_per_s": np.full((40, 3), np.nan)}, "measurements are not all known"),
        ({"torque_nm": np.full((40, 3), np.nan)}, "torques are not all known"),
        ({"unwind_speed_m_per_s": np.full(40, np.inf)}, "unwinder's speed are not all known"),
        ({"time_s": np.where(np.arange(40) < 30, 0.0, 1.0) + PERIOD_S * np.arange(40)}, "samples are missing"),
    ],
)
def test_what_is_not_known_is_refused(change, words):
    with pytest.raises(Unpredictable, match=words):
        stretch_of(replace(recording(), **change))


def test_too_short_a_stretch_is_refused():
    with pytest.raises(Unpredictable, match="at least 8"):
        stretch_of(recording(samples=7))


@pytest.mark.parametrize(
    "believed",
    [theta(latency=0.2), theta(latency=-0.01), theta(radius=-0.04), theta(coulomb=-1.0), theta(length=np.nan)],
)
def test_a_theta_that_no_line_can_have_is_refused(believed):
    stretch = stretch_of(recording())
    gains = gains_of(theta(), NOISE, stretch)
    with pytest.raises(Unpredictable):
        innovations([believed], stretch, gains)


def test_noise_of_nothing_has_no_gain():
    with pytest.raises(Unpredictable, match="no gain"):
        gains_of(theta(), Noise(0.0, 0.0, 0.0), stretch_of(recording()))
