"""A span without a load cell: what torques and speeds say of its tension, and when that stops the line."""

import tomllib

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from gateway.core.line import Line
from gateway.core.line_rules_estimate import breaks_are_seen, estimates_are_bounds
from gateway.core.line_template import line_template
from gateway.core.signals import Inputs
from gateway.core.tension_estimate import balance_of, estimate_n, pull_n
from safety.actions import Action
from safety.estimated_tension import EstimateState, estimate_limits, find_estimated
from safety.limits import envelope_limits

N, RADIUS_M, FRICTION, INERTIA, SPEED = 3, 0.1, 0.05, 0.4, 2.0
PERIODS = 200
SET_N = 50.0


def line_of(unseen=(3,), tolerance=0.1, after_n=0.0) -> Line:
    """A rewind of light friction; spans of `unseen` have no load cell."""
    document = tomllib.loads(line_template(N))
    document["limits"] |= {"tension_min_n": 10.0, "tension_max_n": 100.0, "speed_max_m_per_s": 4.0}
    document["web"]["tension_after_n"] = after_n
    for i in range(N):
        document["rollers"][i] |= {
            "radius_m": {"value": RADIUS_M, "tolerance": 0.02},
            "inertia_kg_m2": {"value": INERTIA, "tolerance": tolerance},
            "friction_nms_per_rad": {"value": FRICTION, "tolerance": tolerance},
        }
        if i + 1 in unseen:
            document["spans"][i]["control"] = "draw"
    document["load_cells"] = [cell for cell in document["load_cells"] if cell["span"] not in unseen]
    return Line.model_validate(document)


def torques(tension, after_n=0.0, speed=SPEED, friction=FRICTION, radius=RADIUS_M):
    """What holds these true tensions at a constant speed."""
    behind = np.append(tension[1:], after_n)
    return radius * (np.asarray(tension) - behind) + friction * speed / radius


def findings(line, tension, torque, speed=SPEED, floor=True, periods=PERIODS):
    """Of the last of some periods at which all stands still."""
    limits, state, inputs, found = estimate_limits(line, envelope_limits(line)), EstimateState(), Inputs(N), []
    seen = {cell.span - 1 for cell in line.load_cells}
    for k in range(periods):
        for i in range(N):
            inputs.speed.put(i, speed, 0.01 * k)
            if i in seen:
                inputs.tension.put(i, tension[i], 0.01 * k)
        found = find_estimated(limits, state, inputs, torque, np.full(N, SET_N), floor=floor)
    return found


def test_a_rewind_at_240_of_100_newtons_stops_the_line():
    tension = (50.0, 50.0, 240.0)
    (found,) = findings(line_of(), tension, torques(tension))
    assert (found.rule, found.action) == ("tension-estimated", Action.STOP)
    told = found.parameters
    assert found.as_data().code == found.rule and found.as_data().parameters == told
    assert told["span"] == 3 and told["high_n"] == 100.0 < told["least_n"] < 240.0 < told["most_n"]


def indicating(line: Line) -> Line:
    """Every span has a load cell, that of the last one controls nothing."""
    cells = tomllib.loads(line_template(N))["load_cells"]
    return Line.model_validate(line.model_dump(mode="json") | {"load_cells": cells})


@pytest.mark.parametrize("shown_n", [np.nan, 50.0, 0.0])
def test_where_a_cell_that_only_shows_is_silent_the_estimate_stands_in(shown_n):
    line = indicating(line_of())
    limits, state, inputs, found = estimate_limits(line, envelope_limits(line)), EstimateState(), Inputs(N), []
    tension = np.array((50.0, 50.0, 240.0))
    for k in range(PERIODS):
        for i in range(N):
            inputs.speed.put(i, SPEED, 0.01 * k)
            if i != 2:
                inputs.tension.put(i, tension[i], 0.01 * k)
        inputs.tension.value[2] = shown_n  # the last that it showed, and no good one
        found = find_estimated(limits, state, inputs, torques(tension), np.full(N, SET_N), floor=True)
    assert [one.rule for one in found] == ["tension-estimated"] and "span 3 " in found[0].text


def test_what_a_cell_that_only_shows_shows_is_held_against_the_band():
    line = indicating(line_of())
    assert not findings(line, (50.0, 50.0, 90.0), torques((50.0, 50.0, 90.0)))
    (found,) = findings(line, (50.0, 50.0, 140.0), torques((50.0, 50.0, 140.0)))
    assert found.action is Action.STOP and "span 3 " in found.text


def test_a_span_of_a_narrow_band_of_its_own_needs_a_load_cell():
    line = line_of()
    spans = [span if i < N else span.model_copy(update={"tension_min_n": 40.0, "tension_max_n": 41.0}) for i, span in
             enumerate(line.spans, 1)]  # fmt: skip
    assert not list(estimates_are_bounds(line))
    (found,) = estimates_are_bounds(line.model_copy(update={"spans": spans}))
    assert "its band is 1 N wide" in found.wrong


def test_it_takes_periods_in_a_row():
    tension = (50.0, 50.0, 240.0)
    assert not findings(line_of(), tension, torques(tension), periods=10)


def test_slack_stops_a_line_that_has_been_tensioned():
    tension, line = (50.0, 50.0, -20.0), line_of(tolerance=0.05)  # as far below as no tolerance explains
    assert [found.rule for found in findings(line, tension, torques(tension))] == ["tension-estimated"]
    assert not findings(line, tension, torques(tension), floor=False)


@given(
    st.lists(st.floats(10.0, 100.0), min_size=N, max_size=N),
    st.floats(-0.1, 0.1),
    st.floats(0.0, 4.0),
    st.sets(st.integers(1, N), min_size=1),
)
def test_a_line_within_its_tolerances_and_its_band_is_never_stopped(tension, share, speed, unseen):
    friction, radius = FRICTION * (1.0 + share), RADIUS_M * (1.0 + 0.2 * share)
    torque = torques(tension, speed=speed, friction=friction, radius=radius)
    assert findings(line_of(tuple(unseen)), tension, torque, speed, periods=40) == []


@given(
    st.lists(st.floats(10.0, 100.0), min_size=N, max_size=N),
    st.lists(st.floats(-1.0, 1.0), min_size=4, max_size=4),
    st.sets(st.integers(1, N), min_size=1),
    st.floats(-0.5, 0.5),
    st.floats(0.0, 1.0),
    st.sampled_from((SPEED, -SPEED)),
)
def test_the_interval_holds_the_truth_while_the_line_speeds_up(tension, shares, unseen, rate, dry, speed):
    line, tension = line_of(tuple(unseen), after_n=20.0), np.array(tension)
    radius, friction = RADIUS_M * (1.0 + 0.02 * shares[0]), FRICTION * (1.0 + 0.1 * shares[1])
    inertia = INERTIA * (1.0 + 0.1 * shares[2])
    torque = torques(tension, 20.0, speed, friction=friction, radius=radius) + inertia / radius * rate
    torque += dry * line.gate.stress_coulomb_nm * np.sign(speed)
    torque *= 1.0 + 0.02 * shares[3]  # the drive gives a little else
    balance = balance_of(line)
    pull = pull_n(balance, torque, np.full(N, speed), np.full(N, rate))
    least, most = estimate_n(balance, tension, pull)
    assert (least <= tension + 1e-6).all() and (tension - 1e-6 <= most).all()


def test_two_rollers_say_more_than_one():
    balance = balance_of(line_of((2,)))
    pull = np.array([[-5.0, -20.0, 0.0], [5.0, 20.0, 0.0]])
    tension = np.array([50.0, np.nan, 50.0])
    assert estimate_n(balance, tension, pull)[:, 1].tolist() == [45.0, 55.0]


def test_rollers_that_contradict_each_other_say_all_that_either_says():
    balance = balance_of(line_of((2,)))
    pull = np.array([[-5.0, 30.0, 0.0], [5.0, 40.0, 0.0]])
    assert estimate_n(balance, np.array([50.0, np.nan, 50.0]), pull)[:, 1].tolist() == [45.0, 90.0]


def test_at_standstill_dry_friction_may_hold_what_it_likes():
    """2 Nm of it (`gate.stress_coulomb_nm`) are 20 N at this radius."""
    tension = (50.0, 50.0, 115.0)
    torque = torques(tension, speed=0.0)
    assert not findings(line_of(), tension, torque, speed=0.0)
    assert findings(line_of(), tension, torques(tension))


@pytest.mark.parametrize(("speed", "tension_n"), [(SPEED, 90.0), (-SPEED, 15.0)])
def test_dry_friction_of_a_roller_that_turns_is_no_tension(speed, tension_n):
    """As much as the line's file lets every roller have."""
    tension, line = (tension_n, 50.0, 50.0), line_of((1,))
    dry_nm = np.array((line.gate.stress_coulomb_nm, 0.0, 0.0)) * np.sign(speed)
    assert not findings(line, tension, torques(tension, speed=speed) + dry_nm, speed=speed)


def test_check_counts_dry_friction_in_what_torques_tell():
    line = line_of()
    gate = line.gate.model_copy(update={"stress_coulomb_nm": 5.0})  # 51 N at this radius, either way of a creeping one
    limits = line.limits.model_copy(update={"tension_min_n": 10.0, "tension_max_n": 60.0})
    assert not list(estimates_are_bounds(line.model_copy(update={"limits": limits})))
    (found,) = estimates_are_bounds(line.model_copy(update={"gate": gate, "limits": limits}))
    assert found.path == ("spans", 2, "control") and "stress_coulomb_nm of at most 2 Nm" in found.allowed


def test_a_line_whose_spans_are_all_measured_estimates_nothing():
    line = line_of(())
    assert estimate_limits(line, envelope_limits(line)) is None


@pytest.mark.parametrize("unseen", [(1,), (2, 3), (1, 2, 3)])
def test_chains_of_spans_without_cells_are_estimated_from_what_is_known(unseen):
    tension = np.full(N, 180.0)
    found = findings(line_of(unseen), tension, torques(tension))
    assert {f.parameters["span"] for f in found} == set(unseen)


def breaking(line, tension, span, way, *, moved_n=0.0):
    """Codes and actions of a line whose web in `span` breaks (0: none) after 3 s; periods from then to the first.

    `way`: "held", the drives hold their rollers; "apart", their torques stay, and the rollers run apart. `moved_n`:
    the set-points and with them all tensions are moved by so much instead, within a second.
    """
    limits, state, inputs = estimate_limits(line, envelope_limits(line)), EstimateState(), Inputs(N)
    seen = {cell.span - 1 for cell in line.load_cells}
    true_n, speed, set_n, dice = np.array(tension), np.full(N, SPEED), np.array(tension), np.random.default_rng(1)
    torque, told = torques(true_n), []
    for k in range(450):
        if k == 300 and span:
            true_n = true_n * (np.arange(1, N + 1) != span)
        if k >= 300 and moved_n:
            true_n = np.array(tension) + moved_n * min(1.0, (k - 300) / 100)
            set_n = true_n
        balanced = torques(true_n)
        torque = torque if span and way == "apart" else balanced
        speed = speed + (torque - balanced) * RADIUS_M / INERTIA * 0.01
        shown = speed + 1e-3 * dice.standard_normal(N)
        for i in range(N):
            inputs.speed.put(i, shown[i], 0.01 * k)
            if i in seen:
                inputs.tension.put(i, true_n[i], 0.01 * k)
        found = find_estimated(limits, state, inputs, torque, set_n, floor=True)
        told += [(k - 300, one.rule, one.action, one.parameters["span"]) for one in found]
    return told


@pytest.mark.parametrize("way", ["held", "apart"])
@pytest.mark.parametrize("span", [1, 2, 3])
def test_a_break_that_the_interval_does_not_tell_is_seen_by_what_it_changes_and_is_braked(span, way):
    line = line_of((span,))
    told = breaking(line, (60.0, 60.0, 60.0), span, way)
    periods, code, action, where = told[0]
    assert (code, action, where) == ("web-break-estimated", Action.BRAKE, span)
    assert 0 < periods < 80
    assert not list(breaks_are_seen(line)) and {one[3] for one in told} == {span}


@pytest.mark.parametrize("moved_n", [-45.0, 30.0])
def test_set_points_that_move_are_no_break(moved_n):
    for span in (1, 2, 3):
        assert breaking(line_of((span,)), (60.0, 60.0, 60.0), 0, "held", moved_n=moved_n) == []


def test_a_break_in_a_span_with_a_load_cell_is_none_in_one_without():
    assert breaking(line_of((3,)), (60.0, 60.0, 60.0), 1, "held") == []


def test_slack_that_is_certain_is_braked_and_what_is_too_tight_goes_on_under_control():
    (slack,) = findings(line_of(tolerance=0.05), (50.0, 50.0, -20.0), torques((50.0, 50.0, -20.0)))
    (tight,) = findings(line_of(), (50.0, 50.0, 240.0), torques((50.0, 50.0, 240.0)))
    assert (slack.action, tight.action) == (Action.BRAKE, Action.STOP)


def test_check_refuses_a_line_on_which_a_break_would_stay_unseen():
    vague = line_of(tolerance=0.45)
    (found,) = breaks_are_seen(vague)
    assert found.path == ("spans", 2, "control") and "span = 3" in found.allowed
    assert not list(breaks_are_seen(line_of(()))) and not list(breaks_are_seen(line_of((2,))))


def test_the_bound_is_that_of_the_worst_speed():
    """Friction that is known to a tenth leaves little at the recipe's speed, and much at the greatest one."""
    line = line_of()
    limits = line.limits.model_copy(update={"tension_min_n": 10.0, "tension_max_n": 70.0})
    slow = line.model_copy(
        update={"limits": limits, "recipes": [line.recipes[0].model_copy(update={"speed_m_per_s": 0.1})]}
    )
    assert not list(estimates_are_bounds(slow))
    fast = slow.model_copy(update={"limits": limits.model_copy(update={"speed_max_m_per_s": 40.0})})
    (found,) = estimates_are_bounds(fast)
    assert found.path == ("spans", 2, "control")
