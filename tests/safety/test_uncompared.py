"""Drives of whose torque nothing is heard that counts: told soon, and by name no longer compared after a bound."""

import numpy as np
import pytest

from gateway.core.drive_tells import profile_tells
from gateway.core.signals import Inputs
from safety.actions import Action
from safety.drive_feedback import DOUBTED_S, feedback_limits
from safety.uncompared import UncomparedState, find_uncompared
from tests.closed_loop.conftest import demo_line

LINE = demo_line(2)
NOBODY = np.zeros(2, np.bool_)
LIMITS = feedback_limits(LINE, profile_tells(2))
HOLD, BOUND = LINE.limits.hold_periods, round(DOUBTED_S / LINE.control.period_s)


class Watched:
    def __init__(self) -> None:
        self.state, self.inputs = UncomparedState(2), Inputs(2)
        self.found: list[tuple[int, str, str, Action]] = []
        self.period = 0

    def run(self, *good: bool, lost=NOBODY):
        """A period for each: whether the torque of the second drive counts in it."""
        for is_good in good:
            self.inputs.torque.put(0, 1.0, 0.0)
            if is_good:
                self.inputs.torque.put(1, 1.0, 0.0)
            else:
                self.inputs.torque.reject(1)
            self.period += 1
            for finding in find_uncompared(LIMITS, self.state, self.inputs, lost):
                self.found.append((self.period, finding.rule, finding.parameters["drive"], finding.action))
        return self


def test_a_status_that_goes_bad_is_told_and_after_the_bound_ends_the_comparison_by_name():
    watched = Watched().run(*[True] * 50, *[False] * (BOUND + 50))
    assert watched.found == [
        (50 + HOLD, "torque-status-bad", "drive-2", Action.NONE),
        (50 + BOUND, "torque-not-compared", "drive-2", Action.NONE),
    ]
    assert watched.state.uncompared.tolist() == [False, True]


def test_a_status_that_comes_and_goes_ends_it_too():
    watched = Watched().run(*[False, True] * (2 * BOUND))
    assert [code for _, code, _, _ in watched.found] == ["torque-status-bad", "torque-not-compared"]
    assert watched.state.uncompared[1]


def test_a_sample_or_two_are_nothing_and_what_is_heard_again_is_compared_again():
    assert not Watched().run(*([False] + [True] * 5) * 20).found
    watched = Watched().run(*[False] * (BOUND + 50), *[True] * (2 * BOUND + 1))
    assert not watched.state.uncompared.any()
    watched.run(*[False] * BOUND)
    assert [code for _, code, _, _ in watched.found] == 2 * ["torque-status-bad", "torque-not-compared"]


@pytest.mark.parametrize("anew", [True, False])
def test_who_has_left_is_not_judged_and_who_arms_begins_anew(anew):
    assert not Watched().run(*[False] * 200, lost=np.array([False, True])).found
    watched = Watched().run(*[False] * BOUND)
    if anew:
        watched.state.begin_anew()
    assert watched.state.uncompared[1] != anew
