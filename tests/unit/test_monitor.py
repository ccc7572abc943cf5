"""The monitor's own rules, period by period."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from gateway.core.line_file import load_line
from gateway.core.line_template import line_template
from safety.actions import Action
from safety.monitor import MonitorLimits, MonitorState, look, monitor_limits

LINE = load_line(line_template(6, "line.toml"), "line.toml")
LIMITS = monitor_limits(LINE)  # 50 periods, moves of 5 Nm count


def rules(torques_nm, cuts=None):
    """The rules that are broken, and by which period."""
    state = MonitorState()
    for k, torque in enumerate(torques_nm):
        findings = look(LIMITS, state, np.full(6, 20.0) + np.eye(6)[2] * torque, bool(cuts is not None and cuts[k]))
        if findings:
            return [finding.rule for finding in findings], k, findings[0].parameters
    return [], None, {}


def test_a_torque_that_turns_round_every_other_period_chatters():
    found, when, told = rules([0.0, 6.0] * 30)
    assert found == ["chattering"] and when <= LIMITS.window
    assert (told["roller"], told["reversal_nm"]) == (3, 5.0)


@pytest.mark.parametrize(
    "torques",
    [
        [0.0, 4.9] * 100,  # noise: no move counts
        list(np.linspace(0.0, 60.0, 8)) * 10,  # steps now and then
        list(20.0 * np.sin(np.arange(300) * 2 * np.pi / 40)),  # a swing of 2.5 Hz, which a tension follows
    ],
)
def test_what_moves_without_chattering_is_left_alone(torques):
    assert rules(torques)[0] == []


def test_reversals_at_the_boundary():
    def turned(times):
        rest = LIMITS.window - 2 * times
        return [0.0, 6.0] * times + [6.0] * max(rest, 0)

    # Each pair turns twice, but for the first move.
    most = (LIMITS.reversals + 1) // 2
    assert rules(turned(most - 1))[0] == []
    assert rules(turned(most + 1))[0] == ["chattering"]


def test_turns_long_ago_do_not_count():
    burst = [0.0, 6.0] * 5 + [6.0] * LIMITS.window
    assert rules(burst * 4)[0] == []


def test_a_torque_that_is_cut_in_half_of_the_window():
    still = [0.0] * 200
    few = [k < LIMITS.cuts - 1 for k in range(200)]
    assert rules(still, [False, *few[:-1]])[0] == []
    assert rules(still, [True] * 200)[0] == ["torque-cut"]
    assert rules(still, [k % 2 == 0 for k in range(200)])[0] == ["torque-cut"]
    assert rules(still, [k % 3 == 0 for k in range(200)])[0] == []


def test_limits_follow_the_lines_period_and_rate():
    assert monitor_limits(LINE) == MonitorLimits(n=6, reversal_nm=5.0, window=50, reversals=15, cuts=25)
    slow = LINE.model_copy(update={"control": LINE.control.model_copy(update={"period_s": 0.1})})
    assert monitor_limits(slow) == MonitorLimits(n=6, reversal_nm=50.0, window=28, reversals=9, cuts=14)


def test_what_is_said_names_roller_count_and_limit_and_stops_nothing_by_itself():
    state = MonitorState()
    found = [look(LIMITS, state, np.eye(6)[2] * torque, True) for torque in [0.0, 6.0] * 30]
    first = next(findings for findings in found if findings)
    assert [(one.rule, one.action) for one in first] == [("chattering", Action.NONE)]
    # Two moves before the first turn is told: the first period moves nothing, and the first move has no way before.
    told = {"roller": 3, "reversals": 15, "reversal_nm": 5.0, "periods": 16, "allowed": 14}
    assert first[0].parameters == told
    cut = next(findings[-1] for findings in found if len(findings) == 2)
    assert (cut.rule, cut.action) == ("torque-cut", Action.NONE)
    assert cut.parameters == {"cuts": 25, "periods": 25, "allowed": 24}


def test_a_move_of_exactly_half_a_step_does_not_count():
    assert rules([0.0, LIMITS.reversal_nm] * 40)[0] == []
    assert rules([0.0, LIMITS.reversal_nm * (1.0 + 1e-9)] * 40)[0] == ["chattering"]


@given(st.lists(st.tuples(st.sampled_from([-6.0, -2.0, 0.0, 2.0, 6.0]), st.booleans()), min_size=1, max_size=60))
def test_turns_and_cuts_are_those_of_the_last_window(moves):
    """Against a count over the whole past, by a window of eight periods."""
    limits = MonitorLimits(n=2, reversal_nm=5.0, window=8, reversals=3, cuts=4)
    torques = np.cumsum([0.0, *(move for move, _ in moves)])
    state, turned, cuts, way = MonitorState(), [], [], 0.0
    assert look(limits, state, np.array([1.0, 0.0]), True) == []
    for torque, (move, cut) in zip(torques[1:], moves, strict=True):
        turned.append(bool(abs(move) > 5.0 and way * move < 0.0))
        way = move if abs(move) > 5.0 else way
        cuts.append(cut)
        found = [one.rule for one in look(limits, state, np.array([1.0, torque]), cut)]
        assert ("chattering" in found) is (sum(turned[-8:]) >= 3)
        assert ("torque-cut" in found) is (sum(cuts[-8:]) >= 4)
