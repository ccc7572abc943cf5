"""The estimate of tensions without a load cell, as control is given it: only what can be relied on."""

import numpy as np
import pytest

from gateway.core.signals import Inputs
from gateway.core.tension_estimate import MEAN_PERIODS
from gateway.loop.watch import Watch
from tests.closed_loop.conftest import demo_line
from tests.safety.test_estimated_tension import SPEED, N, line_of, torques

TENSION_N = np.array([50.0, 50.0, 40.0])
RELIED = 6 * MEAN_PERIODS


def inputs():
    found = Inputs(N)
    for i in range(N):
        found.tension.put(i, float(TENSION_N[i]) if i < 2 else 0.0, 0.0)
        found.speed.put(i, SPEED, 0.0)
    found.unwind_speed.put(0, SPEED, 0.0)
    return found


def passed(watch, periods, doubted=False):
    """What is known after so many periods at which all stands still."""
    found = None
    for _ in range(periods):
        watch.find_estimated(inputs(), torques(TENSION_N), TENSION_N, floor=False)
        found = watch.estimated_n(doubted=doubted)
    return found


@pytest.fixture
def watch():
    return Watch(line_of(), np.zeros(N))


def test_it_holds_the_truth_once_its_averages_do(watch):
    assert passed(watch, MEAN_PERIODS - 1) is None
    least_n, most_n = passed(watch, 200)
    assert least_n[2] < TENSION_N[2] < most_n[2]
    assert least_n[0] == most_n[0] == pytest.approx(TENSION_N[0]), "as its load cell has it"


def spoil_drive(watch):
    watch.drives.suspected[1] = True


def spoil_comparison(watch):
    watch.drives.uncompared[1] = True


def spoil_cell(watch):
    watch.silent.append(0)


def mend(watch):
    watch.drives.suspected[:] = False
    watch.drives.uncompared[:] = False
    watch.silent.clear()


@pytest.mark.parametrize("spoil", [spoil_drive, spoil_comparison, spoil_cell])
def test_what_may_not_give_its_torque_or_stands_still_leaves_nothing_to_rely_on_and_nor_do_the_averages_of_it(
    watch, spoil
):
    assert passed(watch, 200) is not None
    spoil(watch)
    assert passed(watch, 1) is None
    mend(watch)
    assert passed(watch, RELIED - 1) is None
    assert passed(watch, 1) is not None


def test_a_lost_drive_leaves_nothing_to_rely_on(watch):
    assert passed(watch, 200) is not None
    assert passed(watch, 1, doubted=True) is None
    assert passed(watch, RELIED - 1) is None


def test_where_no_law_was_engaged_it_begins_anew_all_the_same(watch):
    """A start that ended while slack was taken up: nothing was controlled, and the averages are of then."""
    assert passed(watch, 200) is not None
    watch.off()
    assert passed(watch, MEAN_PERIODS - 1) is None


def test_what_was_wrong_for_a_while_is_gone_from_the_averages_when_they_count_again(watch):
    for _ in range(200):
        watch.find_estimated(inputs(), torques(TENSION_N) + [0.0, 0.0, 3.0], TENSION_N, floor=False)
        watch.estimated_n(doubted=True)
    rightly = passed(Watch(line_of(), np.zeros(N)), 500)
    found = passed(watch, RELIED)
    assert np.abs(found - rightly).max() < 0.03 * 3.0 / 0.1


def test_a_load_cell_that_only_shows_is_not_relied_on():
    """Nobody looks whether it stands still."""
    line = line_of(unseen=())
    spans = [span.model_copy(update={"control": "draw"}) if i == 2 else span for i, span in enumerate(line.spans)]
    least_n, most_n = passed(Watch(line.model_copy(update={"spans": spans}), np.zeros(N)), 200)
    assert least_n[2] < TENSION_N[2] < most_n[2], "it shows nothing"


def test_a_line_with_all_its_cells_estimates_nothing():
    watch = Watch(demo_line(N), np.zeros(N))
    assert watch.estimated_n(doubted=False) is None
