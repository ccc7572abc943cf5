"""The monitor's own rules, period by period."""

import numpy as np
import pytest

from gateway.core.line_file import load_line
from gateway.core.line_template import line_template
from safety.monitor import MonitorState, look, monitor_limits

LINE = load_line(line_template(6, "line.toml"), "line.toml")
LIMITS = monitor_limits(LINE)  # 50 periods, moves of 5 Nm count


def rules(torques_nm, cuts=None):
    """The rules that are broken, and by which period."""
    state = MonitorState()
    for k, torque in enumerate(torques_nm):
        findings = look(LIMITS, state, np.full(6, 20.0) + np.eye(6)[2] * torque, bool(cuts is not None and cuts[k]))
        if findings:
            return [finding.rule for finding in findings], k, findings[0].text
    return [], None, ""


def test_a_torque_that_turns_round_every_other_period_chatters():
    found, when, text = rules([0.0, 6.0] * 30)
    assert found == ["chattering"] and when <= LIMITS.window
    assert "roller 3" in text and "5 Nm" in text


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
    assert rules(still, [True] * 200)[0] == ["torque cut"]
    assert rules(still, [k % 2 == 0 for k in range(200)])[0] == ["torque cut"]
    assert rules(still, [k % 3 == 0 for k in range(200)])[0] == []
