"""Speeds that jump are told from what a roller can do, without a loop."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from gateway.core.line_scales import line_scales
from gateway.core.signals import FloatArray, Inputs, Quality
from safety.actions import Action
from safety.jumps import UNWINDER_MARGIN, JumpState, jump_limits, reject_jumps, reject_unwinder
from tests.closed_loop.conftest import demo_line

LINE = demo_line()
NOISE_M_PER_S = line_scales(LINE).speed_m_per_s


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
        assert all((finding.rule, finding.action) == ("encoder-jump", Action.STOP) for finding in findings)
        assert all(finding.parameters["roller"] == 2 for finding in findings)
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
        (0.10, 0.10, 0.0, False),  # a PLC that stops the transport at once: the next sample says so, too
        (0.10, 0.0, 0.0, True),  # and one that is asked to
        (0.10, 0.10, 0.083, True),
        (0.10, 0.10, -0.019, False),
        (0.05, 0.05, 0.069, False),
        (0.05, 0.05, 0.067, True),
        (0.10, 0.02, 0.117, True),  # it may stay at its last value for a while
        (0.10, 0.02, 0.119, False),
        (-0.05, 0.0, -0.067, True),  # backwards, likewise
        (-0.05, 0.0, -0.069, False),
        (0.0, -0.05, -0.067, True),
        (-0.05, -0.05, 0.0, False),
        (0.0, 0.0, UNWINDER_MARGIN * LINE.limits.speed_max_m_per_s, True),  # at the boundary
        (0.0, 0.0, -UNWINDER_MARGIN * LINE.limits.speed_max_m_per_s, True),
    ],
)
def test_v0_lies_between_its_last_value_and_its_request(
    last: float, asked: float, value: float, believed: bool
) -> None:
    limits, state, inputs = jump_limits(LINE, np.zeros(6)), JumpState(), Inputs(6)
    inputs.unwind_speed.put(0, last, 0.0)
    reject_unwinder(limits, state, inputs, last)
    inputs.unwind_speed.put(0, value, 0.01)
    reject_unwinder(limits, state, inputs, asked)
    assert (inputs.unwind_speed.quality[0] == Quality.GOOD) == believed
    assert inputs.unwind_speed.value[0] == (value if believed else last)


def unwinder(shown: list[float], asked: float = 0.1) -> tuple[list[bool], JumpState]:
    """Which of an unwinder's samples are used, and the state after them."""
    limits, state, inputs, used = jump_limits(LINE, np.zeros(6)), JumpState(), Inputs(6), []
    for k, value in enumerate(shown):
        inputs.unwind_speed.put(0, value, 0.01 * k)
        reject_unwinder(limits, state, inputs, asked)
        used.append(bool(inputs.unwind_speed.quality[0] == Quality.GOOD))
    return used, state


def test_a_v0_that_falls_away_from_its_request_is_believed_when_the_next_sample_says_so() -> None:
    used, state = unwinder([0.1, 0.0, 0.0, 0.0])
    assert used == [True, False, True, True] and state.unwind_speed_m_per_s == 0.0
    assert len(state.rejected) == 1 and state.rejected[0].confirmable
    used, state = unwinder([0.1, 0.06, 0.02, 0.0])  # one that brakes hard
    assert used == [True, False, True, True]


def test_a_torn_v0_is_never_used() -> None:
    """Its high word is that of another time: the request has not moved, and the next sample is as before."""
    used, state = unwinder([0.1, *[0.001, 0.1] * 5])
    assert used == [True, *[False, True] * 5] and state.unwind_speed_m_per_s == 0.1
    assert [(one.name, one.value) for one in state.rejected] == [(("unwinder speed", 0), 0.001)] * 5
    assert all(one.low > 0.001 for one in state.rejected)


def test_what_no_sample_confirms_is_beyond_standstill_and_request() -> None:
    used, state = unwinder([0.1, -0.05, -0.05, 0.3, 0.3])
    assert used == [True, False, False, False, False] and not state.rejected[0].confirmable


def test_a_v0_that_did_not_come_says_nothing() -> None:
    limits, state, inputs = jump_limits(LINE, np.zeros(6)), JumpState(), Inputs(6)
    inputs.unwind_speed.put(0, 0.05, 0.0)
    reject_unwinder(limits, state, inputs, 0.05)
    inputs.unwind_speed.miss(0)
    reject_unwinder(limits, state, inputs, 0.05)
    assert inputs.unwind_speed.quality[0] == Quality.STALE and state.unwind_speed_m_per_s == 0.05


def second_periods(periods: int) -> tuple[list[int], list[int]]:
    """Periods with a finding, and those with a discarded sample, of a second spike so many periods after a first."""
    found, _, discarded = jumping([0.05, 0.5, *[0.05] * (periods - 1), 0.5, 0.05])
    return found, discarded


def test_a_second_is_the_time_within_which_a_second_jump_is_no_coincidence() -> None:
    assert second_periods(100) == ([101], [1, 101])
    assert second_periods(101) == ([], [1, 102])


def both_periods(second: list[float], third: list[float], missed: int | None = None) -> list[bool]:
    """Whether the third period's samples are good, after one in which roller 2 jumped; all began at 0.05 m/s."""
    limits, state, inputs = jump_limits(LINE, np.zeros(6)), JumpState(), at_30_n()
    reject_jumps(limits, state, speeds(inputs, [0.05] * 6), [TORQUE_NM])
    speeds(inputs, second)
    if missed is not None:
        inputs.speed.miss(missed)
    reject_jumps(limits, state, inputs, [TORQUE_NM])
    assert inputs.speed.quality[1] == Quality.BAD and inputs.speed.value[1] == 0.05
    reject_jumps(limits, state, speeds(inputs, third), [TORQUE_NM])
    return [quality == Quality.GOOD for quality in inputs.speed.quality.tolist()]


def test_time_goes_on_for_a_roller_whose_sample_was_discarded_or_missed_and_begins_anew_for_the_others() -> None:
    one, two = reach_m_per_s(0.05), reach_m_per_s(0.05, 2)
    jumped = [0.05, 0.5, *[0.05] * 4]
    assert one < 0.999 * two
    # Rollers 2 (discarded), 3 (missed) and 4 (believed) come to nearly what two periods allow.
    third = [0.05, *[0.05 + 0.999 * two] * 3, 0.05, 0.05]
    assert both_periods(jumped, third, missed=2) == [True, True, True, False, True, True]
    third = [0.05, *[0.05 + 1.001 * two] * 2, 0.05 + 0.999 * one, 0.05, 0.05]
    assert both_periods(jumped, third, missed=2) == [True, False, False, True, True, True]


def test_samples_beside_a_jump_are_believed_and_are_what_the_next_are_held_against() -> None:
    one = reach_m_per_s(0.05)
    second = [0.05, 0.5, 0.05 + 0.9 * one, *[0.05] * 3]
    assert both_periods(second, [0.05, 0.05, 0.05 + 1.8 * one, *[0.05] * 3])[2]
    assert not both_periods(second, [0.05, 0.05, 0.05 - 0.5 * one, *[0.05] * 3])[2]


@pytest.mark.parametrize("count_m_per_s", [0.0, 0.004])
def test_nothing_that_acts_leaves_noise_and_two_counts_and_the_bound_itself_is_no_jump(count_m_per_s: float) -> None:
    limits = jump_limits(LINE, np.full(6, count_m_per_s))
    allowed = NOISE_M_PER_S + 2.0 * count_m_per_s
    for first, rest, good in ((1.0, 0.0, [True] * 6), (1.0, 1.001, [True, *[False] * 5])):
        state, inputs = JumpState(), Inputs(6)
        for i in range(6):
            inputs.tension.put(i, 0.0, 0.0)
        reject_jumps(limits, state, speeds(inputs, [0.0] * 6), [np.zeros(6)])
        reject_jumps(limits, state, speeds(inputs, [first * allowed, *[rest * allowed] * 5]), [np.zeros(6)])
        assert (inputs.speed.quality == Quality.GOOD).tolist() == good


def test_a_second_jump_says_from_where_to_where() -> None:
    limits, state, inputs = jump_limits(LINE, np.zeros(6)), JumpState(), at_30_n()
    for value in (0.05, 0.5, 0.6):
        findings = reject_jumps(limits, state, speeds(inputs, [*[0.05] * 5, value]), [TORQUE_NM])
    told = {"roller": 6, "speed_m_per_s": 0.6, "before_m_per_s": 0.05}
    assert [finding.parameters for finding in findings] == [told]


@pytest.mark.parametrize("speed_max_m_per_s", [0.12, 8.0])
def test_noise_is_small_against_the_lines_greatest_speed(speed_max_m_per_s: float) -> None:
    """Of 8 m/s an encoder shows some 10 mm/s more or less; 2 mm/s, which is much at 0.12 m/s, stopped such a line."""
    limits = LINE.limits.model_copy(update={"speed_max_m_per_s": speed_max_m_per_s})
    line = LINE.model_copy(update={"limits": limits})
    for share, good in ((0.9, True), (1.1, False)):
        state, inputs, still_nm = JumpState(), Inputs(6), np.zeros(6)
        for i in range(6):
            inputs.tension.put(i, 0.0, 0.0)
        reject_jumps(jump_limits(line, np.zeros(6)), state, speeds(inputs, [0.0] * 6), [still_nm])
        shown = [share * speed_max_m_per_s / 60.0] * 6
        reject_jumps(jump_limits(line, np.zeros(6)), state, speeds(inputs, shown), [still_nm])
        assert inputs.speed.good() == good
