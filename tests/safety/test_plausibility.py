"""Jumps, stuck and drifting cells at their boundaries, without a loop."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from gateway.core.signals import FloatArray, Inputs, Quality
from safety.actions import Action
from safety.drift import DRIFT_ALONE_N, DRIFT_N, DriftState, drift_limits, drift_of, restart, watch_balance
from safety.jumps import NOISE_M_PER_S, UNWINDER_MARGIN, JumpState, jump_limits, reject_jumps, reject_unwinder
from safety.stuck import LEARNT_REVERSALS, StuckLimits, StuckState, find_stuck, stuck_limits
from tests.closed_loop.conftest import demo_line

LINE = demo_line()


def speeds(inputs: Inputs, values: list[float]) -> Inputs:
    for i, value in enumerate(values):
        inputs.speed.put(i, value, 0.0)
    return inputs


TORQUE_NM = np.full(6, 10.0)


def reach_m_per_s(speed_m_per_s: float, periods: int = 1) -> float:
    """Of roller 2 at 10 Nm with 30 N on either side: R and f at their upper, J at its lower edge."""
    radius, inertia, friction = 0.04 * 1.2, 0.95 * 0.7, 10.0 * 1.75
    acceleration = radius / inertia * (10.0 + radius * 30.0) + friction / inertia * speed_m_per_s
    return acceleration * 0.01 * periods + NOISE_M_PER_S


def at_30_n() -> Inputs:
    inputs = Inputs(6)
    for i in range(6):
        inputs.tension.put(i, 30.0, 0.0)
    return inputs


def jumping(values: list[float], torque_nm: FloatArray = TORQUE_NM) -> tuple[list[int], Inputs, list[int]]:
    """What is found, and the periods in which roller 2's sample was discarded, for its speeds in turn."""
    state, inputs = JumpState(), at_30_n()
    discarded: list[int] = []
    found: list[int] = []
    for k, value in enumerate(values):
        samples = speeds(inputs, [0.05, value, 0.05, 0.05, 0.05, 0.05])
        findings = reject_jumps(jump_limits(LINE, np.zeros(6)), state, samples, [torque_nm])
        if inputs.speed.quality[1] == Quality.BAD:
            discarded.append(k)
        found += [k] * len(findings)
        assert all((finding.rule, finding.action) == ("encoder jump", Action.STOP) for finding in findings)
        assert all("roller 2 jumped twice, to" in finding.text for finding in findings)
    return found, inputs, discarded


def test_a_speed_jump_is_discarded_and_a_second_one_stops_the_line() -> None:
    found, inputs, discarded = jumping([0.05, 0.05, 0.1, 0.05])
    assert (found, discarded) == ([], [2]) and inputs.speed.value[1] == 0.05
    found, inputs, discarded = jumping([0.05, 0.05, 0.1, 0.1])
    assert (found, discarded) == ([3], [2, 3])
    assert inputs.speed.value[1] == 0.05, "the last believed value stays"


def test_two_jumps_far_apart_are_two_spikes() -> None:
    assert jumping([0.05, 0.5, *[0.05] * 100, 0.5, 0.05])[0] == []
    assert jumping([0.05, 0.5, *[0.05] * 98, 0.5, 0.05])[0] == [100]


@given(
    torque_nm=st.lists(st.floats(-60.0, 60.0), min_size=2, max_size=2),
    tension_n=st.floats(-10.0, 100.0),
    change=st.floats(-1.0, 1.0),
)
def test_noise_is_no_jump_whatever_acts(torque_nm: list[float], tension_n: float, change: float) -> None:
    limits, state, inputs = jump_limits(LINE, np.zeros(6)), JumpState(), Inputs(6)
    for i in range(6):
        inputs.tension.put(i, tension_n, 0.0)
    acted_nm = [np.full(6, torque) for torque in torque_nm]
    reject_jumps(limits, state, speeds(inputs, [0.05] * 6), acted_nm)
    others = 0.05 + 1.01 * NOISE_M_PER_S  # beyond noise, so that every roller is judged by what it can do
    inputs.tension.miss(5)
    for i, speed in enumerate([0.05 + change * NOISE_M_PER_S, *[0.05] * 4, others]):
        inputs.speed.put(i, speed, 0.0)
    reject_jumps(limits, state, inputs, acted_nm)
    assert inputs.speed.good()


@pytest.mark.parametrize("order", [1, -1])
def test_the_greater_of_two_torques_has_acted(order: int) -> None:
    limits, inputs = jump_limits(LINE, np.zeros(6)), at_30_n()
    for share, good in ((0.999, True), (1.001, False)):
        state = JumpState()
        acted_nm = [TORQUE_NM, -0.5 * TORQUE_NM][::order]
        reject_jumps(limits, state, speeds(inputs, [0.05] * 6), acted_nm)
        reached = 0.05 + share * reach_m_per_s(0.05)
        reject_jumps(limits, state, speeds(inputs, [0.05, reached, 0.05, 0.05, 0.05, 0.05]), acted_nm)
        assert inputs.speed.good() == good


def test_what_a_roller_can_do_is_no_jump() -> None:
    assert jumping([0.05, 0.05 + 0.999 * reach_m_per_s(0.05)])[2] == []
    assert jumping([0.05, 0.05 + 1.001 * reach_m_per_s(0.05)])[2] == [1]


def test_a_roller_is_judged_by_its_own_torque_and_its_own_spans() -> None:
    limits = jump_limits(LINE, np.zeros(6))
    torque_nm = np.array([60.0, 10.0, 60.0, 60.0, 60.0, 10.0])
    own = {1: reach_m_per_s(0.05)}
    own[5] = own[1] - 0.01 * (0.04 * 1.2) ** 2 / (0.95 * 0.7) * 30.0  # the last span has come down to nothing
    for roller, reached in own.items():
        for share, good in ((0.999, True), (1.001, False)):
            state, inputs = JumpState(), at_30_n()
            inputs.tension.put(5, 0.0, 0.0)
            reject_jumps(limits, state, speeds(inputs, [0.05] * 6), [torque_nm])
            shown = [0.05] * 6
            shown[roller] += share * reached
            reject_jumps(limits, state, speeds(inputs, shown), [torque_nm])
            assert inputs.speed.good() == good


def test_a_roller_without_a_first_sample_may_come_with_any() -> None:
    limits, state, inputs = jump_limits(LINE, np.zeros(6)), JumpState(), speeds(at_30_n(), [0.05] * 6)
    inputs.speed.miss(1)
    assert reject_jumps(limits, state, inputs, [TORQUE_NM]) == []
    assert reject_jumps(limits, state, speeds(inputs, [0.05, 0.5, 0.05, 0.05, 0.05, 0.05]), [TORQUE_NM]) == []
    assert inputs.speed.good()


def test_a_coarse_encoder_may_show_the_next_count() -> None:
    resolution = np.full(6, 0.016)
    state, inputs = JumpState(), at_30_n()
    limits = jump_limits(LINE, resolution)
    for k in range(10):
        assert reject_jumps(limits, state, speeds(inputs, [0.016 * (k % 3)] * 6), [np.zeros(6)]) == []
        assert inputs.speed.good()


def test_after_missed_samples_a_roller_may_have_come_further() -> None:
    limits, state, inputs = jump_limits(LINE, np.zeros(6)), JumpState(), at_30_n()
    reject_jumps(limits, state, speeds(inputs, [0.0] * 6), [TORQUE_NM])
    for _ in range(2):
        for i in range(6):
            inputs.speed.miss(i)
        assert reject_jumps(limits, state, inputs, [TORQUE_NM]) == []
    reject_jumps(limits, state, speeds(inputs, [0.0, 0.99 * reach_m_per_s(0.0, 3), 0.0, 0.0, 0.0, 0.0]), [TORQUE_NM])
    assert inputs.speed.good()


@pytest.mark.parametrize(
    ("last", "asked", "value", "believed"),
    [
        (0.01, 0.10, 0.10, True),  # a PLC that steps
        (0.01, 0.10, 0.117, True),  # and overshoots
        (0.01, 0.10, 0.119, False),
        (0.10, 0.10, 0.0, True),  # a PLC that stops the transport at once
        (0.10, 0.10, -0.019, False),
        (0.05, 0.05, 0.069, False),
        (0.05, 0.05, 0.067, True),
        (0.10, 0.02, 0.117, True),  # it may stay at its last value for a while
        (0.10, 0.02, 0.119, False),
        (-0.05, 0.0, -0.067, True),  # backwards, likewise
        (-0.05, 0.0, -0.069, False),
        (0.0, -0.05, -0.067, True),
        (-0.05, -0.05, 0.0, True),
        (0.0, 0.0, UNWINDER_MARGIN * LINE.limits.speed_max_m_per_s, True),  # at the boundary
        (0.0, 0.0, -UNWINDER_MARGIN * LINE.limits.speed_max_m_per_s, True),
    ],
)
def test_v0_lies_between_standstill_its_last_value_and_its_request(
    last: float, asked: float, value: float, believed: bool
) -> None:
    limits, state, inputs = jump_limits(LINE, np.zeros(6)), JumpState(), Inputs(6)
    inputs.unwind_speed.put(0, last, 0.0)
    reject_unwinder(limits, state, inputs, last)
    inputs.unwind_speed.put(0, value, 0.01)
    reject_unwinder(limits, state, inputs, asked)
    assert (inputs.unwind_speed.quality[0] == Quality.GOOD) == believed
    assert inputs.unwind_speed.value[0] == (value if believed else last)


def test_a_v0_that_did_not_come_says_nothing() -> None:
    limits, state, inputs = jump_limits(LINE, np.zeros(6)), JumpState(), Inputs(6)
    inputs.unwind_speed.put(0, 0.05, 0.0)
    reject_unwinder(limits, state, inputs, 0.05)
    inputs.unwind_speed.miss(0)
    reject_unwinder(limits, state, inputs, 0.05)
    assert inputs.unwind_speed.quality[0] == Quality.STALE and state.unwind_speed_m_per_s == 0.05


def test_cells_of_tension_spans_are_judged_after_the_time_of_the_lines_file() -> None:
    limits = stuck_limits(LINE)
    assert limits.measured.tolist() == [span.control == "tension" for span in LINE.spans]
    assert limits.stuck_periods == round(LINE.limits.stuck_s / LINE.control.period_s)
    slow = LINE.model_copy(update={"limits": LINE.limits.model_copy(update={"stuck_s": 1e-3})})
    assert stuck_limits(slow).stuck_periods == 1


STUCK = StuckLimits(np.array([True, True, False]), stuck_periods=5)


def stuck_after(tensions: list[tuple[float, float, float]], alive: bool = True) -> tuple[StuckState, list[str]]:
    state, inputs = StuckState(), Inputs(3)
    texts: list[str] = []
    for k, values in enumerate(tensions):
        for i, value in enumerate(values):
            inputs.tension.put(i, value, 0.0)
            inputs.speed.put(i, 0.05 + (1e-4 * (k % 2) if alive else 0.0), 0.0)
        findings = find_stuck(STUCK, state, inputs)
        assert all((finding.rule, finding.action) == ("load cell stuck", Action.STOP) for finding in findings)
        texts += [finding.text for finding in findings]
    return state, texts


def noisy(count: int) -> list[tuple[float, float, float]]:
    """Fine cells: 0.01 N a count, noise of 0.1 N."""
    samples = np.round(np.random.default_rng(2).normal(30.0, 0.1, (count, 3)) / 0.01) * 0.01
    return [(float(a), float(b), float(c)) for a, b, c in samples]


def test_a_cell_that_stands_still_while_rollers_move_is_stuck_after_its_time() -> None:
    still = [(40.0 + 0.1 * k, 31.0, 30.0 + 0.1 * k) for k in range(6)]
    assert not stuck_after(noisy(300) + still[:5])[0].stuck.any()
    state, texts = stuck_after(noisy(300) + still)
    assert list(state.stuck) == [False, True, False], "span 3 is not controlled by its cell"
    assert texts == [
        "the load cell of span 2 has shown 31.00 N 5 times in a row while rollers move: check it, its amplifier and "
        "its cable"
    ]


def test_a_cell_is_judged_only_after_it_has_been_learnt() -> None:
    assert not stuck_after(noisy(LEARNT_REVERSALS - 5) + [(30.0, 30.0, 30.0)] * 50)[0].stuck.any()


@pytest.mark.parametrize("noise_n", [0.02, 0.03, 0.05])
def test_a_healthy_cell_with_a_coarse_resolution_is_not_stuck(noise_n: float) -> None:
    """0.1 N a count, a filter of 10 Hz: the same count may come for seconds."""
    rng, filtered = np.random.default_rng(1), np.zeros(3)
    tensions: list[tuple[float, float, float]] = []
    for noise in rng.normal(0.0, noise_n, (30_000, 3)):
        filtered += 0.47 * (noise - filtered)
        one, two, three = np.round((30.0 + filtered) / 0.1) * 0.1
        tensions.append((one, two, three))
    assert stuck_after(tensions)[1] == [], "five minutes"


def test_a_sample_that_did_not_come_tells_nothing_of_its_cell() -> None:
    state, inputs = StuckState(), Inputs(3)
    values = noisy(300) + [(31.0, 31.0, 31.0)] * 12
    for k, row in enumerate(values):
        for i, value in enumerate(row):
            inputs.speed.put(i, 0.05 + 1e-4 * (k % 2), 0.0)
            if k >= 300 and k % 2:
                inputs.tension.miss(i)
            else:
                inputs.tension.put(i, value, 0.0)
        find_stuck(STUCK, state, inputs)
        assert list(state.stuck) == [k >= 310, k >= 310, False], "every other sample: the sixth like it is the eleventh"


@pytest.mark.parametrize(("count_n", "step_n"), [(0.02, 5.0), (0.01, 2.0), (0.02, 10.0), (0.1, 20.0)])
def test_a_ramp_does_not_teach_that_a_quiet_coarse_cell_is_fine(count_n: float, step_n: float) -> None:
    """The set-point moves by 20 N/s; then the cell shows one count for long."""
    rng = np.random.default_rng(3)
    true_n = 30.0 + np.minimum(0.2 * np.arange(2000), step_n)
    for _ in range(3):
        cells = np.round((true_n[:, None] + rng.normal(0.0, 0.1 * count_n, (2000, 3))) / count_n) * count_n
        assert stuck_after([(float(a), float(b), float(c)) for a, b, c in cells])[1] == []


def test_a_line_on_which_nothing_moves_tells_nothing() -> None:
    assert not stuck_after(noisy(300) + [(30.0, 30.0, 30.0)] * 200, alive=False)[0].stuck.any()


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


def test_what_is_wrong_in_the_model_is_no_drift_and_the_reference_is_of_ten_blocks() -> None:
    from gateway.core.web_model import equilibrium_torque, reference_speeds

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
    from gateway.core.web_model import equilibrium_torque, reference_speeds

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
