"""Which recordings are recent, and how they are cut into parts at one speed in which tensions move."""

from dataclasses import replace
from math import nan

import numpy as np
import pytest

from gateway.core.line_scales import line_scales
from gateway.core.recording import Recording
from gateway.core.theta import Noise
from safety.excitation import MOVING, excited_parts, recent
from tests.closed_loop.conftest import demo_line

LINE = demo_line()
SAME_M_PER_S = line_scales(LINE).speed_m_per_s

MOVED_N = 0.25  #: of the hand-made tensions; a power of two, so that their standard deviation is this very number


def recorded(speed_m_per_s, period_s=0.01):
    """Two spans whose tensions go 0.25 N up and down around 30 N."""
    unwinder = np.array(speed_m_per_s)
    at = np.arange(len(unwinder))
    each = np.tile(30.0 + MOVED_N * np.where(at % 2, 1.0, -1.0)[:, None], 2)
    speeds = np.tile(unwinder[:, None], 2)
    time_s, controlled = period_s * at.astype(np.float64), np.ones(len(at), dtype=np.bool_)
    return Recording(time_s, each, each, speeds, each, each, unwinder, controlled, period_s, "by hand")


def lengths_of(recording):
    return [part.recording.samples for part in excited_parts(recording, LINE)]


@pytest.mark.parametrize(("now", "count"), [("14:00:00", 1), ("14:00:00.500000", 1), ("13:59:59.999999", 0)])
def test_a_recording_counts_from_the_moment_at_which_it_ended(of, context, now, count):
    assert context.data[0].recorded == "2026-08-03T14:00:00+00:00"
    later = context.model_copy(update={"now": f"2026-08-03T{now}+00:00"})
    assert len(recent(later, [of.recording], 10.0)) == count


def test_recordings_that_are_not_those_of_the_context_are_an_error(of, context):
    with pytest.raises(ValueError, match="shorter"):
        recent(context, [], 604_800.0)


def test_a_tension_that_moves_by_just_as_much_as_is_asked_tells():
    recording = recorded(np.full(400, 0.05))
    (part,) = excited_parts(recording, LINE, Noise(tension_n=MOVED_N / MOVING))
    assert part.movement_n == MOVED_N and part.recording.samples == 400
    assert excited_parts(recording, LINE, Noise(tension_n=np.nextafter(MOVED_N / MOVING, 1.0))) == []


def test_a_span_without_a_load_cell_leaves_it_to_the_others_to_move():
    recording = recorded(np.full(400, 0.05))
    recording = replace(recording, tension_n=np.where(np.arange(2) == 1, nan, recording.tension_n))
    (part,) = excited_parts(recording, LINE)
    assert part.movement_n == MOVED_N


def test_a_speed_that_jitters_is_one_about_its_mean():
    """By 2.6 per cent either way: from one sample to the next it is more than the twentieth that makes another one."""
    assert lengths_of(recorded(np.where(np.arange(400) % 2, 0.0513, 0.0487))) == [400]


def test_where_a_period_lasts_a_tenth_of_a_second_each_sample_is_a_speed():
    """A sample that is 7 per cent away would be no other speed than the mean of itself and the one before."""
    assert lengths_of(recorded([0.05, 0.0535, *[0.05] * 38], period_s=0.1)) == [38]


def test_a_speed_that_was_held_for_one_sample_takes_no_other_with_it():
    assert lengths_of(recorded([0.05, *[0.06] * 39], period_s=0.1)) == [39]


def test_a_level_that_lasts_long_is_several_parts_wherever_it_begins():
    """15 s are two of 7.5 s, and the 10 s after them one; the latest first."""
    assert lengths_of(recorded([0.05] * 1500 + [0.1] * 1000)) == [1000, 750, 750]


def test_a_part_may_be_as_short_as_is_asked():
    assert lengths_of(recorded([0.05] * 200)) == [200] and lengths_of(recorded([0.05] * 199)) == []


def test_a_speed_may_be_as_far_away_as_is_allowed():
    assert lengths_of(recorded([0.0] * 200 + [SAME_M_PER_S] * 200)) == [400]
