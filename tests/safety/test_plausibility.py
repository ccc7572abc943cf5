"""Jumps, stuck and drifting cells at their boundaries, without a loop."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from gateway.core.signals import Inputs, Quality
from safety.actions import Action
from safety.drift import DRIFT_ALONE_N, DRIFT_N, DriftState, drift_limits, drift_of, restart, watch_balance
from safety.jumps import NOISE_M_PER_S, JumpState, jump_limits, reject_jumps
from safety.stuck import StuckLimits, StuckState, find_stuck
from tests.closed_loop.conftest import demo_line

LINE = demo_line()


def speeds(inputs: Inputs, values: list[float]) -> Inputs:
    for i, value in enumerate(values):
        inputs.speed.put(i, value, 0.0)
    return inputs


def jumping(values: list[float]) -> tuple[list[int], Inputs, list[int]]:
    """What is found, and the periods in which roller 2's sample was discarded, for its speeds in turn."""
    state, inputs = JumpState(), Inputs(6)
    discarded: list[int] = []
    found: list[int] = []
    for k, value in enumerate(values):
        findings = reject_jumps(jump_limits(LINE), state, speeds(inputs, [0.05, value, 0.05, 0.05, 0.05, 0.05]))
        if inputs.speed.quality[1] == Quality.BAD:
            discarded.append(k)
        found += [k] * len(findings)
        assert all(finding.action is Action.STOP and "roller 2" in finding.text for finding in findings)
    return found, inputs, discarded


def test_a_speed_jump_is_discarded_and_a_second_one_stops_the_line() -> None:
    found, inputs, discarded = jumping([0.05, 0.05, 0.5, 0.05])
    assert (found, discarded) == ([], [2]) and inputs.speed.value[1] == 0.05
    found, inputs, discarded = jumping([0.05, 0.05, 0.5, 0.5])
    assert (found, discarded) == ([3], [2, 3])
    assert inputs.speed.value[1] == 0.05, "the last believed value stays"


def test_two_jumps_far_apart_are_two_spikes() -> None:
    assert jumping([0.05, 0.5, *[0.05] * 100, 0.5, 0.05])[0] == []
    assert jumping([0.05, 0.5, *[0.05] * 98, 0.5, 0.05])[0] == [100]


def test_what_a_roller_can_do_is_no_jump() -> None:
    reach = float(jump_limits(LINE).acceleration_m_per_s2[1]) * 0.01
    assert jumping([0.0, reach + 0.99 * NOISE_M_PER_S])[2] == []
    assert jumping([0.0, reach + 1.01 * NOISE_M_PER_S])[2] == [1]


def test_after_missed_samples_a_roller_may_have_come_further() -> None:
    limits, state, inputs = jump_limits(LINE), JumpState(), Inputs(6)
    reach = float(limits.acceleration_m_per_s2[1]) * 0.01
    reject_jumps(limits, state, speeds(inputs, [0.0] * 6))
    for _ in range(2):
        for i in range(6):
            inputs.speed.miss(i)
        assert reject_jumps(limits, state, inputs) == []
    reject_jumps(limits, state, speeds(inputs, [0.0, 2.9 * reach, 0.0, 0.0, 0.0, 0.0]))
    assert inputs.speed.good()


STUCK = StuckLimits(np.array([True, True, False]), stuck_s=0.05, stuck_periods=5)


def stuck_after(tensions: list[tuple[float, float, float]], alive: bool = True) -> tuple[StuckState, list[str]]:
    state, inputs = StuckState(), Inputs(3)
    texts: list[str] = []
    for k, values in enumerate(tensions):
        for i, value in enumerate(values):
            inputs.tension.put(i, value, 0.0)
            inputs.speed.put(i, 0.05 + (1e-4 * (k % 2) if alive else 0.0), 0.0)
        texts += [finding.text for finding in find_stuck(STUCK, state, inputs)]
    return state, texts


def test_a_cell_that_stands_still_while_rollers_move_is_stuck_after_its_time() -> None:
    changing = [(30.0 + 0.1 * k, 30.0, 30.0) for k in range(6)]
    assert not stuck_after(changing[:5])[0].stuck.any()
    state, texts = stuck_after(changing[:6])
    assert list(state.stuck) == [False, True, False], "span 3 is not controlled by its cell"
    assert len(texts) == 1 and "span 2" in texts[0]


def test_a_line_on_which_nothing_moves_tells_nothing() -> None:
    assert not stuck_after([(30.0, 30.0, 30.0)] * 50, alive=False)[0].stuck.any()


@given(
    cell=st.integers(0, 5),
    drift_n=st.floats(DRIFT_ALONE_N * 1.01, 50.0) | st.floats(-50.0, -DRIFT_ALONE_N * 1.01),
)
def test_the_drift_of_one_cell_is_told_with_its_size(cell: int, drift_n: float) -> None:
    change_n = np.zeros(6)
    change_n[cell] -= drift_n
    if cell:
        change_n[cell - 1] += drift_n
    told = drift_of(change_n)
    assert told[cell] == pytest.approx(drift_n) and np.count_nonzero(told) == 1


@given(roller=st.integers(1, 5), change_n=st.floats(-50.0, 50.0))
def test_the_friction_of_one_roller_is_no_drift(roller: int, change_n: float) -> None:
    changes_n = np.zeros(6)
    changes_n[roller] = change_n
    assert not drift_of(changes_n).any()


def test_the_balance_of_the_model_itself_tells_no_drift_and_a_cell_that_lies_is_found() -> None:
    from gateway.core.web_model import equilibrium_torque, reference_speeds

    limits, state = drift_limits(LINE), DriftState()
    true_n = np.array([28.0, 36.0, 20.0, 40.0, 24.0, 32.0])
    speed = reference_speeds(limits.model, true_n, 0.05)
    torque_nm = equilibrium_torque(limits.model, true_n, speed)
    restart(limits, state)
    for _ in range(3000):
        watch_balance(limits, state, true_n, speed, torque_nm)
    assert not state.drift_n.any()
    shown_n = true_n + np.array([0.0, 0.0, 1.5 * DRIFT_N, 0.0, 0.0, 0.0])
    for _ in range(1000):
        watch_balance(limits, state, shown_n, speed, torque_nm)
    assert state.drift_n[2] == pytest.approx(1.5 * DRIFT_N) and np.count_nonzero(state.drift_n) == 1
