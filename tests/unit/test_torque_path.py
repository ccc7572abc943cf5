"""What a law is told of the torques before it as it begins: with a law that asks for little and notes what it hears."""

from types import SimpleNamespace

import numpy as np
import pytest

from gateway.control.law import Measured
from gateway.loop.setpoints import Setpoints
from gateway.loop.torque import TorquePath
from safety.limits import envelope_limits
from tests.closed_loop.conftest import demo_line

LINE = demo_line(3)
APPLIED_NM, MEAN_NM = np.array([3.0, 4.0, 5.0]), np.array([1.0, 2.0, 3.0])


class Listening:
    n = 3

    def __init__(self):
        self.begun_nm = []

    def engage(self, measured, reference, torque_nm):
        self.begun_nm.append(torque_nm.tolist())
        return "engaged"

    def ask(self, state, measured, reference):
        return SimpleNamespace(torque_nm=APPLIED_NM.copy(), fallback="")

    def commit(self, state, decision, torque_nm):
        return state


@pytest.fixture
def path():
    return TorquePath(Listening(), envelope_limits(LINE), LINE)


def controlled(path, mean_nm):
    measured = Measured(np.array([20.0, 20.0, 20.0]), np.zeros(3), 0.0)
    return path.control(measured, Setpoints(LINE.recipes[0], 0.02), APPLIED_NM, LINE.control.period_s, None, mean_nm)


def test_a_law_begins_at_what_was_given_on_average(path):
    controlled(path, MEAN_NM)
    assert path.law.begun_nm == [MEAN_NM.tolist()]


def test_without_an_average_it_begins_at_what_was_given_last(path):
    controlled(path, None)
    assert path.law.begun_nm == [APPLIED_NM.tolist()]


@pytest.mark.parametrize("mean_nm", [MEAN_NM, None])
def test_a_drive_that_is_lost_gave_nothing(path, mean_nm):
    path.lost[1] = True
    torque_nm, _ = controlled(path, mean_nm)
    assert path.law.begun_nm[0][1] == 0.0 and torque_nm[1] == 0.0
    assert path.law.begun_nm[0][0] != 0.0


def test_a_law_that_takes_over_from_another_begins_at_what_was_given_last(path):
    """The average is of the stage before any law: what another law has sent is no noise."""
    controlled(path, MEAN_NM)
    path.take_over(Listening())
    controlled(path, MEAN_NM)
    assert path.law.begun_nm == [APPLIED_NM.tolist()]
