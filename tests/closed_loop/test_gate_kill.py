"""Some of the kills of `make bench-kill`; there are a thousand."""

import pytest

from tests.closed_loop.gate_kills import campaign

pytestmark = [pytest.mark.realtime, pytest.mark.timeout(240)]  # time goes on six times as fast as the clock

KILLS = 12


def test_a_gateway_killed_at_any_instant_loses_no_record_and_nothing_runs_unexplained():
    tally = campaign(KILLS, seed=7)
    assert tally.problems == []
    assert (tally.lost, tally.denied, tally.unexplained, tally.unsound, tally.shut) == (0, 0, 0, 0, 0)
    assert tally.kills == KILLS and tally.told > KILLS and tally.looks >= 2 * KILLS
