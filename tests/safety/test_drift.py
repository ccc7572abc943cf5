"""Load cells that drift are told from what is wrong in the model, without a loop."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from gateway.core.line_scales import line_scales
from gateway.core.web_model import equilibrium_torque, reference_speeds
from safety.drift import DRIFT, DRIFT_ALONE, DriftState, drift_limits, drift_of, restart, watch_balance
from tests.closed_loop.conftest import demo_line

LINE = demo_line()
SMALL_N = line_scales(LINE).tension_n
DRIFT_N, DRIFT_ALONE_N = DRIFT * SMALL_N, DRIFT_ALONE * SMALL_N


@given(
    cell=st.integers(0, 5),
    drift_n=st.floats(DRIFT_ALONE_N * 1.01, 50.0) | st.floats(-50.0, -DRIFT_ALONE_N * 1.01),
)
def test_the_drift_of_one_cell_is_told_with_its_size(cell: int, drift_n: float) -> None:
    change_n = np.zeros(6)
    change_n[cell] -= drift_n
    if cell:
        change_n[cell - 1] += drift_n
    told = drift_of(change_n, SMALL_N)
    assert told[cell] == pytest.approx(drift_n) and np.count_nonzero(told) == 1


@given(roller=st.integers(1, 5), change_n=st.floats(-50.0, 50.0))
def test_the_friction_of_one_roller_is_no_drift(roller: int, change_n: float) -> None:
    changes_n = np.zeros(6)
    changes_n[roller] = change_n
    assert not drift_of(changes_n, SMALL_N).any()


def test_the_balance_of_the_model_itself_tells_no_drift_and_a_cell_that_lies_is_found() -> None:
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


def test_what_is_wrong_in_the_model_is_no_drift_and_the_reference_is_of_ten_blocks() -> None:
    limits, state = drift_limits(LINE), DriftState()
    assert (limits.block_periods, limits.settle_periods, limits.measured.tolist()) == (100, 500, [1.0] * 6)
    true_n = np.full(6, 30.0)
    speed = reference_speeds(limits.model, true_n, 0.05)
    torque_nm = equilibrium_torque(limits.model, true_n, speed) + np.array([5.0, -3.0, 2.0, 0.0, 4.0, -6.0])
    restart(limits, state)
    for _ in range(500 + 999):
        watch_balance(limits, state, true_n, speed, torque_nm)
    assert state.reference_nm is None
    watch_balance(limits, state, true_n, speed, torque_nm)
    assert state.reference_nm is not None and state.drift_n.tolist() == [0.0] * 6
    for _ in range(1000):
        watch_balance(limits, state, true_n, speed, torque_nm)
    assert state.drift_n.tolist() == [0.0] * 6


def test_a_span_without_a_cell_has_no_drift() -> None:
    spans = [span.model_copy(update={"control": "draw"}) if i == 2 else span for i, span in enumerate(LINE.spans)]
    limits, state = drift_limits(LINE.model_copy(update={"spans": spans})), DriftState()
    assert limits.measured.tolist() == [1.0, 1.0, 0.0, 1.0, 1.0, 1.0]
    true_n = np.full(6, 30.0)
    speed = reference_speeds(limits.model, true_n, 0.05)
    torque_nm = equilibrium_torque(limits.model, true_n, speed)
    restart(limits, state)
    for k in range(3000):
        shown_n = true_n + (k > 1600) * np.array([0.0, 0.0, 1.5 * DRIFT_N, 0.0, 0.0, 0.0])
        watch_balance(limits, state, shown_n, speed, torque_nm)
    assert state.drift_n.tolist() == [0.0] * 6


@pytest.mark.parametrize(
    ("change_n", "drift_n"),
    [
        ([0.0, DRIFT_N, -DRIFT_N, 0.0], [0.0, 0.0, 0.0, 0.0]),  # at the threshold
        ([0.0, -DRIFT_N, DRIFT_N, 0.0], [0.0, 0.0, 0.0, 0.0]),
        ([0.0, 2.001, -2.003, 0.0], [0.0, 0.0, 2.002, 0.0]),
        ([0.0, -4.0, 6.0, 0.0], [0.0, 0.0, -5.0, 0.0]),  # the mean of what both rollers say
        ([0.0, 1.9, -1.9, 0.0], [0.0, 0.0, 0.0, 0.0]),
        ([0.0, 1.9, -9.0, 0.0], [0.0, 0.0, 0.0, 0.0]),  # one roller alone says it
        ([0.0, 4.0, 4.0, 0.0], [0.0, 0.0, 0.0, 0.0]),  # no cell moves both the same way
        ([0.0, 0.0, 4.0, -4.0], [0.0, 0.0, 0.0, 4.0]),
        ([-DRIFT_ALONE_N, 0.0, 0.0, 0.0], [0.0, 0.0, 0.0, 0.0]),  # cell 1, of which one roller tells
        ([-2.5, 0.0, 0.0, 0.0], [0.0, 0.0, 0.0, 0.0]),
        ([3.001, 0.0, 0.0, 0.0], [-3.001, 0.0, 0.0, 0.0]),
        ([12.0, -12.0, 0.0, 0.0], [0.0, 12.0, 0.0, 0.0]),  # all of it is cell 2's
        ([4.0, -4.0], [0.0, 4.0]),  # the shortest lines
        ([-4.0, 0.0], [4.0, 0.0]),
        ([-3.5], [3.5]),
        ([-2.5], [0.0]),
    ],
)
def test_which_cell_drifts_and_by_how_much(change_n: list[float], drift_n: list[float]) -> None:
    assert drift_of(np.array(change_n), SMALL_N) == pytest.approx(drift_n)
