"""Set-points that move along minimum-jerk curves: never past what was asked for, never faster than allowed."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from gateway.core.line import Moves, Recipe
from gateway.loop.setpoints import OnTheWay, Setpoints

MOVES = Moves(shape="minimum-jerk", tension_rate_n_per_s=20.0, speed_rate_m_per_s2=0.05)
PERIOD_S = 0.01


def setpoints() -> Setpoints:
    found = Setpoints(Recipe(name="a", tension_n=[30.0, 30.0], speed_m_per_s=0.1), moment_s=0.02)
    found.begin_at(np.array([30.0, 30.0]))
    found.begin_at_speed(0.1)
    return found


changes = st.lists(st.tuples(st.integers(1, 120), st.floats(2.0, 58.0), st.floats(0.0, 0.1)), min_size=1, max_size=6)


@pytest.mark.slow
@settings(max_examples=60)
@given(changes)
def test_no_change_on_the_way_takes_them_past_old_and_new_targets(story):
    moving = setpoints()
    seen_n, seen_m_per_s = [30.0], [0.1]
    for periods, tension_n, speed_m_per_s in story:
        moving.tension_target_n[0], moving.speed_target_m_per_s = tension_n, speed_m_per_s
        seen_n.append(tension_n)
        seen_m_per_s.append(speed_m_per_s)
        for _ in range(periods):
            before = float(moving.tension_n[0]), moving.speed_m_per_s
            moving.advance(MOVES, PERIOD_S, speed_m_per_s, 0.05, "minimum-jerk")
            assert min(seen_n) - 1e-9 <= moving.tension_n[0] <= max(seen_n) + 1e-9
            assert min(seen_m_per_s) - 1e-12 <= moving.speed_m_per_s <= max(seen_m_per_s) + 1e-12
            assert abs(moving.tension_n[0] - before[0]) <= 20.0 * PERIOD_S + 1e-9
            assert abs(moving.speed_m_per_s - before[1]) <= 0.05 * PERIOD_S + 1e-12
    for _ in range(1200):
        moving.advance(MOVES, PERIOD_S, speed_m_per_s, 0.05, "minimum-jerk")
    assert moving.tension_n[0] == tension_n and moving.speed_m_per_s == speed_m_per_s
    assert not moving.reference(0.02).moving


def test_a_stop_is_a_ramp_whatever_the_target_of_the_speed_is():
    moving = setpoints()
    moving.speed_target_m_per_s = 0.0
    for _ in range(5):
        moving.advance(MOVES, PERIOD_S, 0.0, 0.05, "minimum-jerk")
    begun = moving.speed_m_per_s
    for _ in range(30):
        moving.advance(MOVES, PERIOD_S, 0.0, 0.1, "ramp")
    assert moving.speed_m_per_s == pytest.approx(begun - 30 * 0.1 * PERIOD_S, abs=1e-9)


def test_before_a_move_has_reached_the_unwinder_it_asks_for_nothing():
    moving = setpoints()
    moving.speed_target_m_per_s = 0.09
    moving.advance(MOVES, PERIOD_S, 0.09, 0.05, "minimum-jerk")
    reference = moving.reference(2.0)  # the unwinder follows two seconds late
    motion = reference.ahead(0.015)
    assert reference.moving and motion.unwind_acceleration_m_per_s2 == 0.0 and motion.unwind_speed_change_m_per_s == 0.0


def test_a_ramp_has_no_curve_behind_it():
    moving = setpoints()
    ramp = MOVES.model_copy(update={"shape": "ramp"})
    moving.tension_target_n[0] = 40.0
    for _ in range(20):
        moving.advance(ramp, PERIOD_S, 0.1, 0.05)
        assert not moving.reference(2.0).moving
    assert moving.tension_n[0] == pytest.approx(34.0)


def asked_of_rollers(moving: Setpoints, lag_s: float) -> float:
    """The acceleration of the web that control is told of, in m/s^2."""
    return moving.reference(lag_s).ahead(0.0).unwind_acceleration_m_per_s2


def test_control_is_told_of_a_ramp_when_it_has_reached_the_unwinder() -> None:
    ramp, moving, lag_s = MOVES.model_copy(update={"shape": "ramp"}), setpoints(), 2.5 * PERIOD_S
    told = []
    for _ in range(30):
        moving.advance(ramp, PERIOD_S, 0.11, 0.05)
        told.append(asked_of_rollers(moving, lag_s))
    assert told == pytest.approx([0.0] * 2 + [0.05] * 20 + [0.0] * 8)
    assert moving.speed_m_per_s == 0.11 and not moving.reference(lag_s).moving


def test_so_it_is_of_a_stop_in_the_middle_of_a_ramp_and_of_the_speed_that_is_added_until_then() -> None:
    ramp, moving, lag_s = MOVES.model_copy(update={"shape": "ramp"}), setpoints(), 2.5 * PERIOD_S
    for _ in range(10):
        moving.advance(ramp, PERIOD_S, 0.2, 0.05)
    moving.advance(ramp, PERIOD_S, 0.0, 0.1)
    reference = moving.reference(lag_s)
    assert reference.ahead(0.0).unwind_acceleration_m_per_s2 == pytest.approx(0.05)  # not yet at the unwinder
    later = reference.ahead(2.5 * PERIOD_S)
    assert later.unwind_acceleration_m_per_s2 == pytest.approx(-0.1)
    assert later.unwind_speed_change_m_per_s == pytest.approx(1.5 * 0.05 * PERIOD_S - 0.1 * PERIOD_S)


def test_each_stop_is_a_ramp_also_the_second_one() -> None:
    moving = setpoints()
    for _ in range(2):
        for _ in range(120):
            moving.advance(MOVES, PERIOD_S, 0.0, 0.1, "ramp")
        assert moving.speed_m_per_s == 0.0
        for _ in range(100):
            moving.advance(MOVES, PERIOD_S, 0.1, 0.05, "minimum-jerk")
        on_its_way = moving.speed_m_per_s
        moving.advance(MOVES, PERIOD_S, 0.0, 0.1, "ramp")
        assert moving.speed_m_per_s == pytest.approx(on_its_way - 0.1 * PERIOD_S)


def test_one_value_of_the_curves_is_what_all_of_them_say() -> None:
    moving = setpoints()
    moving.tension_target_n[0] = 40.0
    for goal, rate in ((0.08, 0.05), (0.02, 0.1), (0.1, 0.05)):
        for _ in range(40):
            moving.advance(MOVES, PERIOD_S, goal, rate, "ramp")
            reference = moving.reference(0.02)
            if isinstance(reference, OnTheWay):
                curve, times_s = reference.curve, reference.now_s + np.array([-0.05, -0.02, 0.0, 0.015, 3.0])
                for time_s in times_s.tolist():
                    assert curve.of(2, time_s) == pytest.approx(tuple(curve.at(time_s)[:2, 2]), abs=1e-12)
                ahead = reference.ahead(0.015)
                assert ahead.tension_n == pytest.approx(curve.at(reference.now_s + 0.015)[0, :-1])
