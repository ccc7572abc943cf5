"""How often something may be asked: never more than allowed in any stretch of time, and again after a pause."""

from hypothesis import given
from hypothesis import strategies as st

from gateway.mailbox.allowance import BURST, Allowance

STEPS = st.lists(st.floats(0.0, 3.0), min_size=1, max_size=200)


@given(st.floats(0.1, 100.0), STEPS)
def test_in_no_stretch_of_time_more_are_allowed_than_its_rate_and_a_burst(most_per_s, steps):
    allowance, now_s, taken = Allowance(most_per_s), 0.0, []
    for step in steps:
        now_s += step
        if allowance.take(now_s):
            taken.append(now_s)
    burst = max(BURST, most_per_s)
    for first in range(len(taken)):
        for last in range(first, len(taken)):
            assert last - first + 1 <= burst + most_per_s * (taken[last] - taken[first]) + 1e-6


@given(st.floats(0.1, 100.0), STEPS)
def test_whoever_waits_may_ask_again_and_what_was_refused_costs_nothing(most_per_s, steps):
    allowance = Allowance(most_per_s)
    while allowance.take(0.0):
        pass
    for _ in steps:
        assert not allowance.take(0.0)
    assert allowance.take(1.001 / most_per_s)


def test_a_clock_that_goes_back_gives_nothing_away():
    allowance = Allowance(1.0)
    while allowance.take(1000.0):
        pass
    assert not allowance.take(0.0)
    assert not allowance.take(0.5)
    assert allowance.take(1.5)
