"""The monitor's own rules, period by period."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from gateway.core.line_file import load_line
from gateway.core.line_template import line_template
from safety.actions import Action
from safety.monitor import MonitorLimits, MonitorState, look, monitor_limits
from safety.probation import standing

LINE = load_line(line_template(6, "line.toml"), "line.toml")
LIMITS = monitor_limits(LINE)  # 50 periods, 5 Nm from period to period


def rules(torques_nm, cuts=None):
    """The rules that are broken, and by which period."""
    state = MonitorState()
    for k, torque in enumerate(torques_nm):
        findings = look(LIMITS, state, np.full(6, 20.0) + np.eye(6)[2] * torque, bool(cuts is not None and cuts[k]))
        if findings:
            return [finding.rule for finding in findings], k, findings[0].parameters
    return [], None, {}


def noise(rms_nm, seed=0, periods=5_000):
    """Torques whose change from period to period has this root mean square."""
    return np.random.default_rng(seed).normal(0.0, rms_nm / np.sqrt(2.0), periods).tolist()


def test_a_torque_that_jumps_there_and_back_chatters():
    """What 10 Nm are beyond 5 Nm adds up to two windows of the limit's square within 34 periods."""
    found, when, told = rules([0.0, 10.0] * 60)
    assert found == ["chattering"] and when == 33  # the first change of all turns nothing round, and then counts
    assert (told["roller"], told["allowed_nm"], told["periods"]) == (3, 5.0, 32)
    assert told["chatter_nm"] == pytest.approx(np.sqrt((33 * 100.0) / 32), rel=1e-9)


@pytest.mark.parametrize(
    "torques",
    [
        [0.0, 4.9] * 500,
        [*np.linspace(0.0, 60.0, 7), *[60.0] * 20, *np.linspace(60.0, 0.0, 7), *[0.0] * 20] * 5,  # steps, now and then
        [*[0.0] * 20, 60.0, 30.0, 45.0, *[40.0] * 20] * 5,  # the same where the rate is no limit
        list(20.0 * np.sin(np.arange(300) * 2 * np.pi / 40)),  # a swing of 2.5 Hz, which a tension follows
        noise(4.0),  # what the gate lets through at its limit, under noise that is a fifth more than the line's
    ],
)
def test_what_moves_without_chattering_is_left_alone(torques):
    assert rules(torques)[0] == []


def test_the_measure_is_that_of_the_gate_and_of_a_probation():
    """Beside `safety.probation`, which has it from a while in which nothing moves."""
    beyond = noise(6.0)
    while_nm = np.array(beyond[:400])[:, None]
    still = np.zeros_like(while_nm)
    measured_nm = float(standing(still, still, while_nm).chatter_nm[0])
    found, when, told = rules(beyond)
    assert found == ["chattering"] and when < 400
    assert told["chatter_nm"] == pytest.approx(measured_nm, rel=0.15)


def test_a_torque_that_is_held_between_its_jumps_chatters_as_well():
    """A late answer holds a period's torque."""
    assert rules([0.0, 0.0, 10.0, 10.0] * 100)[0] == ["chattering"]


def test_what_was_beyond_long_ago_does_not_count():
    burst = [0.0, 9.0] * 5 + [9.0] * 3 * LIMITS.window
    assert rules(burst * 6)[0] == []


def test_a_torque_that_is_cut_in_half_of_the_window():
    still = [0.0] * 200
    few = [k < LIMITS.cuts - 1 for k in range(200)]
    assert rules(still, [False, *few[:-1]])[0] == []
    assert rules(still, [True] * 200)[0] == ["torque-cut"]
    assert rules(still, [k % 2 == 0 for k in range(200)])[0] == ["torque-cut"]
    assert rules(still, [k % 3 == 0 for k in range(200)])[0] == []


def test_limits_follow_the_lines_period_and_its_gate():
    assert monitor_limits(LINE) == MonitorLimits(n=6, chatter_nm=5.0, window=50, cuts=25)
    slow = LINE.model_copy(update={"control": LINE.control.model_copy(update={"period_s": 0.1})})
    assert monitor_limits(slow) == MonitorLimits(n=6, chatter_nm=5.0, window=28, cuts=14)


def test_what_is_said_stops_nothing_by_itself():
    state = MonitorState()
    found = [look(LIMITS, state, np.eye(6)[2] * torque, True) for torque in [0.0, 10.0] * 30]
    first, both = (next(some for some in found if len(some) == count) for count in (1, 2))
    assert [(one.rule, one.action) for one in both] == [("chattering", Action.NONE), ("torque-cut", Action.NONE)]
    assert first[0].parameters == {"cuts": 25, "periods": 25, "allowed": 24}


def test_a_torque_that_is_no_number_is_beyond_any_limit():
    assert rules([0.0, np.nan, 0.0])[0] == ["chattering"]


@given(st.lists(st.tuples(st.sampled_from([-9.0, -2.0, 0.0, 2.0, 9.0]), st.booleans()), min_size=1, max_size=60))
def test_chatter_and_cuts_against_the_whole_past(moves):
    """Against sums over all changes, by a window of eight periods."""
    limits = MonitorLimits(n=2, chatter_nm=5.0, window=8, cuts=4)
    torques = np.cumsum([0.0, *(move for move, _ in moves)])
    state, cuts, beyond, last, counted = MonitorState(), [], 0.0, 0.0, False
    assert look(limits, state, np.array([1.0, 0.0]), True) == []
    for torque, (move, cut) in zip(torques[1:], moves, strict=True):
        turned = move * last < 0.0  # none is thrice the limit
        beyond = max(beyond - 25.0 + (move**2 + (0.0 if counted else last**2) if turned else 0.0), 0.0)
        last, counted = (move, turned) if move else (last, counted)
        cuts.append(cut)
        found = [one.rule for one in look(limits, state, np.array([1.0, torque]), cut)]
        assert ("chattering" in found) is (beyond >= 2 * 8 * 25.0)
        assert ("torque-cut" in found) is (sum(cuts[-8:]) >= 4)
