"""Some of the sequences of `make bench-loop-states`; there are twenty thousand. And the faults that they must find."""

import pytest

from tests.closed_loop.loop_mutations import FAULTS, FOUND_WITHIN
from tests.closed_loop.loop_sequences import run_sequences

SEQUENCES = 150


def test_whatever_comes_in_whatever_order_nothing_runs_that_was_not_judged_for_it():
    ran = run_sequences(1, SEQUENCES)
    assert not ran.broken, ran.broken
    assert ran.sequences >= SEQUENCES and ran.periods > 10 * SEQUENCES


@pytest.mark.long
@pytest.mark.parametrize("fault", FAULTS)
def test_a_fault_that_the_loop_once_had_is_found_when_it_is_put_back(fault):
    ran = run_sequences(1, FOUND_WITHIN, fault, shrink=False)
    assert ran.broken, f"not found within {ran.sequences} sequences"
