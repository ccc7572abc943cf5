"""What rollers of draw-controlled spans without a load cell turn faster by."""

from math import inf, nan

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from gateway.core.line_file import load_line
from gateway.core.line_template import line_template
from gateway.core.tension_estimate import MEAN_PERIODS
from gateway.loop.draw_trim import LAGS, NARROW, SPEED_SHARE, STRETCHES, DrawTrim
from safety.tensioning import AIM_SHARE, lag_s, tensioning_speed_m_per_s

SET_N, HALF_N, PERIOD_S = 30.0, 3.0, 0.01
EA_N, LENGTH_M = 2400.0, 1.0
RAMPED = 1000  #: periods, in which what is added has come to what is wanted; while the line runs


def line(draws=(2,), seen=()):
    found = load_line(line_template(4), "line.toml")
    spans = [
        span.model_copy(update={"control": "draw"}) if i in draws else span
        for i, span in enumerate(found.spans, start=1)
    ]
    cells = [cell for cell in found.load_cells if cell.span not in draws or cell.span in seen]
    return found.model_copy(update={"spans": spans, "load_cells": cells})


def interval_n(missing_n, half_n=HALF_N):
    """About a middle that is `missing_n` (4,) away from the set-point."""
    middle_n = SET_N - np.array(missing_n)
    return np.array([middle_n - half_n, middle_n + half_n])


def stepped(trim, found_n, periods=RAMPED, stands=False):
    for _ in range(periods):
        trim.step(np.full(4, SET_N), found_n, stands=stands)
    return trim.added_m_per_s


def trimmed(line, missing_n, half_n=HALF_N):
    return stepped(DrawTrim(line), interval_n(missing_n, half_n))


def most_m_per_s(line):
    return SPEED_SHARE * AIM_SHARE * tensioning_speed_m_per_s(line)


def rate_n_per_s(added_m_per_s, missing_n):
    """Of a tension that comes at standstill with the trim's time constant."""
    tau_s = LAGS * max(lag_s(line()), MEAN_PERIODS * PERIOD_S)
    assert EA_N / LENGTH_M * added_m_per_s == pytest.approx(missing_n / tau_s)


def test_what_is_missing_comes_with_its_time_constant_and_every_roller_behind_turns_with_it():
    added = trimmed(line(), [9.0, 0.3, 9.0, 9.0], half_n=0.0)
    rate_n_per_s(added[1] - added[0], 0.3)
    assert added[0] == 0.0 and added[1] == added[2] == added[3]
    assert trimmed(line(), [0.0, -0.3, 0.0, 0.0], half_n=0.0) == pytest.approx(-added)


@pytest.mark.parametrize("half_n", [NARROW * SET_N, 2.0 * SET_N, 1e6])
@pytest.mark.parametrize("share", [0.0, 0.99, -0.99])
def test_where_the_set_point_may_be_what_is_there_and_little_is_known_nothing_is_asked_for(half_n, share):
    assert not trimmed(line(), [0, share * half_n, 0, 0], half_n).any()


def test_what_is_certain_is_asked_for_however_little_else_is_known():
    rate_n_per_s(trimmed(line(), [0, 20.2, 0, 0], half_n=20.0)[1], 0.2)


def test_within_a_narrow_interval_the_middle_counts_the_more_the_narrower_it_is():
    rate_n_per_s(trimmed(line(), [0, 0.2, 0, 0], half_n=0.5 * NARROW * SET_N)[1], 0.1)
    rate_n_per_s(trimmed(line(), [0, 0.2, 0, 0], half_n=0.9 * NARROW * SET_N)[1], 0.02)


def test_draws_in_a_row_add_up():
    one, two, both = (trimmed(line((2, 3)), missing) for missing in ([0, 0.1, 0, 0], [0, 0, 0.2, 0], [0, 0.1, 0.2, 0]))
    assert both == pytest.approx(one + two) and both[3] == pytest.approx(3.0 * both[1])


@given(st.lists(st.floats(-1e9, 1e9), min_size=4, max_size=4))
def test_half_of_the_tensioning_speed_is_left_to_the_tensioning_whatever_is_missing(missing_n):
    trim, most = DrawTrim(line((1, 2, 3, 4))), most_m_per_s(line((1, 2, 3, 4)))
    for found_n in (interval_n(missing_n), interval_n(-np.array(missing_n))):
        assert np.abs(stepped(trim, found_n, 100)).max() <= most * (1.0 + 1e-12)


def test_where_the_bound_cuts_all_rollers_are_cut_alike():
    drawn = line((2, 3, 4))
    little, much = trimmed(drawn, [0, 0.1, 0.2, -0.1]), trimmed(drawn, [0, 1e6, 2e6, -1e6])
    assert np.abs(much).max() == pytest.approx(most_m_per_s(drawn))
    assert much / much[1] == pytest.approx(little / little[1])


def test_at_standstill_no_more_web_is_taken_than_stretches_all_of_it_twice():
    """A web that is broken or slips: its tension does not come, whatever is taken."""
    trim, found_n = DrawTrim(line()), interval_n([0, 20.0, 0, 0])
    way_m = 0.0
    for _ in range(20_000):
        way_m += PERIOD_S * stepped(trim, found_n, 1, stands=True)[1]
    assert not trim.added_m_per_s.any()
    ramp_m = PERIOD_S + lag_s(line())
    most_m = STRETCHES * 4 * LENGTH_M * SET_N / EA_N
    assert most_m < way_m < most_m + most_m_per_s(line()) * ramp_m
    assert stepped(trim, interval_n([0, -20.0, 0, 0]), 50, stands=True)[1] < 0.0, "the other way is open"
    stepped(trim, found_n, stands=False)
    assert stepped(trim, found_n, 10, stands=True)[1] > 0.0, "a line that ran begins anew"


@pytest.mark.slow
@pytest.mark.parametrize("begun_n", [-21.0, 25.0])
def test_a_span_whose_tension_never_comes_takes_nothing_from_another_that_has_its_own(begun_n):
    """Span 2 is broken for good; span 4 was brought to its set-point before it, and stays there."""
    drawn = line((2, 4))
    trim, tension_n, before = DrawTrim(drawn), SET_N + begun_n, np.zeros(4)
    for _ in range(60_000):
        at_n = np.array([SET_N, 0.0, SET_N, tension_n])
        trim.step(np.full(4, SET_N), np.array([at_n, at_n]), stands=True)
        before = trim.added_m_per_s
        tension_n += EA_N / LENGTH_M * PERIOD_S * (before[3] - before[2])
    assert tension_n == pytest.approx(SET_N, abs=0.1)
    assert np.abs(before).max() < 1e-12


def test_what_is_added_comes_and_goes_on_a_ramp():
    trim, most = DrawTrim(line()), most_m_per_s(line())
    added = [stepped(trim, found_n, 1)[1] for found_n in [interval_n([0, 20.0, 0, 0])] * 100 + [None] * 100]
    steps = np.abs(np.diff([0.0, *added]))
    assert max(added) == pytest.approx(most) and added[-1] == 0.0
    assert steps.max() <= most * PERIOD_S / lag_s(line()) * (1.0 + 1e-9)


@pytest.mark.parametrize(("low", "high"), [(-inf, inf), (nan, 1.0), (1.0, inf), (-inf, 1.0), (nan, nan)])
def test_no_estimate_trims_nothing(low, high):
    trim, found_n = DrawTrim(line()), np.array([np.full(4, low), np.full(4, high)])
    assert not stepped(trim, found_n, 10).any()
    assert not trim.begun_n(found_n).any()


def test_where_no_law_controls_nothing_is_added():
    trim = DrawTrim(line())
    assert stepped(trim, interval_n([0, 20.0, 0, 0]), 10).any()
    trim.off()
    assert not trim.added_m_per_s.any()


def test_a_law_begins_at_the_middle_of_what_may_be_and_never_below_nothing():
    found = DrawTrim(line((2, 3))).begun_n(np.array([[5.0, 10.0, -9.0, 5.0], [7.0, 14.0, 1.0, 7.0]]))
    assert found.tolist() == [0.0, 12.0, 0.0, 0.0]


def test_a_span_with_a_load_cell_is_not_trimmed():
    for other in (line((), ()), line((2,), seen=(2,))):
        assert not DrawTrim(other).any
        assert not trimmed(other, [9.0, 9.0, 9.0, 9.0]).any()
