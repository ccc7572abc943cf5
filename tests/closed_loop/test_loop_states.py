"""Some of the sequences of `make bench-loop-states`; there are twenty thousand, and old faults that are put back."""

from tests.closed_loop.loop_sequences import run_sequences

SEQUENCES = 40


def test_whatever_comes_in_whatever_order_nothing_runs_that_was_not_judged_for_it():
    ran = run_sequences(1, SEQUENCES)
    assert not ran.broken, ran.broken
    assert ran.sequences >= SEQUENCES and ran.periods > 10 * SEQUENCES
