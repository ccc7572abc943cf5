"""References: the minimum-jerk curve by its properties, the flat torques by driving the nonlinear line with them."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from gateway.control.design.task import feedforward_of
from gateway.control.deviation import Deviation, Measured
from gateway.control.reference import MinimumJerk, Motion, Steady
from gateway.control.rollout import rk4
from gateway.core.web_model import equilibrium_torque, reference_speeds
from tests.unit.control_support import model


@given(st.floats(-50, 50), st.floats(-50, 50), st.floats(0.1, 500))
def test_from_rest_to_rest_it_is_the_known_quintic(begin, end, rate):
    curve = MinimumJerk(np.array([begin]))
    curve.move(0, end, rate, 1.0)
    time_s = 15.0 / 8.0 * abs(end - begin) / rate
    if time_s < 1e-6:
        assert not curve.moving(1.0) and curve.at(1.0)[:, 0].tolist() == [end, 0.0, 0.0]
        return
    s = np.linspace(0.0, 1.0, 41)
    found = np.array([curve.at(1.0 + x * time_s)[:, 0] for x in s])
    assert np.allclose(found[:, 0], begin + (end - begin) * (10 * s**3 - 15 * s**4 + 6 * s**5), atol=1e-9)
    assert np.abs(found[:, 1]).max() == pytest.approx(rate)
    assert curve.moving(1.0 + 0.99 * time_s) and not curve.moving(1.0 + 1.01 * time_s)
    assert curve.at(1.0 + 2.0 * time_s)[:, 0].tolist() == [end, 0.0, 0.0]


@given(st.floats(-50, 50), st.floats(-50, 50), st.floats(0.05, 0.95))
def test_a_new_target_on_the_way_tears_nothing(first, second, share):
    curve = MinimumJerk(np.array([0.0, 7.0]))
    curve.move(0, first, 20.0, 0.0, 0.2)  # none so short that it is not worth a curve
    at_s = share * max(15.0 / 8.0 * abs(first) / 20.0, 0.2)
    before = curve.at(at_s)
    curve.move(0, second, 20.0, at_s, 0.2)
    assert np.allclose(curve.at(at_s), before, atol=1e-6)
    assert curve.at(at_s + 60.0)[:, 0].tolist() == [second, 0.0, 0.0]
    assert curve.at(at_s)[:, 1].tolist() == [7.0, 0.0, 0.0]


def test_a_value_that_is_put_stands():
    curve = MinimumJerk(np.array([1.0]))
    curve.move(0, 5.0, 1.0, 0.0)
    curve.put(0, 3.0)
    assert curve.at(0.5)[:, 0].tolist() == [3.0, 0.0, 0.0] and not curve.moving(0.5)


class Curve:
    """Span 3 moves by 24 N and the unwinder by 0.09 m/s, both in half a second."""

    moving = True

    def __init__(self, now_s: float) -> None:
        self.curve = MinimumJerk(np.array([28.0, 36.0, 20.0, 40.0, 24.0, 32.0, 0.01]))
        self.curve.move(2, 44.0, 24.0 * 15.0 / 8.0 / 0.5, 0.0)
        self.curve.move(6, 0.1, 0.09 * 15.0 / 8.0 / 0.5, 0.0)
        self.now_s = now_s

    @property
    def tension_n(self):
        return self.curve.at(self.now_s)[0, :6]

    @property
    def unwind(self):
        return float(self.curve.at(self.now_s)[0, 6])

    def ahead(self, time_s):
        now, then = self.curve.at(self.now_s)[0, 6], self.curve.at(self.now_s + time_s)
        return Motion(then[0, :6], then[1, :6], then[2, :6], float(then[1, 6]), float(then[0, 6] - now))


@pytest.mark.slow
def test_flat_torques_drive_the_nonlinear_line_along_the_curve():
    theta, step_s = model(), 2e-4
    deviation = Deviation(feedforward_of(theta), [], step_s, 0.0)  # the torque for the middle of each step
    begin = Curve(0.0)
    state = deviation.state(begin, begin.unwind)
    worst = 0.0
    for k in range(round(0.7 / step_s)):
        here = Curve(k * step_s)
        errors = deviation.errors(Measured(state[:6], state[6:], here.unwind), here)
        worst = max(worst, np.abs(errors.tension_n).max())
        state = rk4(theta, state, errors.torque_nm, Curve((k + 0.5) * step_s).unwind, step_s)
    assert worst < 2e-3
    assert np.abs(state[:6] - [28, 36, 44, 40, 24, 32]).max() < 2e-3


def test_a_reference_that_stands_is_the_equilibrium():
    theta, tension = model(), np.array([28.0, 36.0, 20.0, 40.0, 24.0, 32.0])
    deviation = Deviation(feedforward_of(theta), [], 0.01, 0.01)
    speed = reference_speeds(theta, tension, 0.05)
    errors = deviation.errors(Measured(tension + 1.0, speed + 0.1, 0.05), Steady(tension))
    assert np.allclose(errors.tension_n, 1.0) and np.allclose(errors.speed_m_per_s, 0.1)
    assert np.allclose(errors.torque_nm, equilibrium_torque(theta, tension, speed))
    still = Curve(10.0)  # at its end: moving in name only
    standing = Steady(still.tension_n)
    assert np.allclose(deviation.state(still, 0.1), deviation.state(standing, 0.1))
    assert np.allclose(deviation.torque(still, 0.1, 0), deviation.torque(standing, 0.1, 0))
