"""The limits of tensioning, and spans that do not answer to the web that was taken up: without a loop."""

from math import inf

import numpy as np
import pytest

from gateway.core.line import Line, Parameter, Tensioning
from gateway.core.signals import FloatArray, Inputs
from gateway.core.theta import NOISE_SHARE, expected_noise
from safety.actions import Action, Finding
from safety.limits import envelope_limits
from safety.tensioning import (
    AIM_SHARE,
    LAG_DELAYS,
    SILENT_S,
    TRIP_COUNTS,
    TRIP_DEVIATIONS,
    TRIP_FACTOR,
    TensioningState,
    begin_tensioning,
    delay_s,
    explained_torque_nm,
    greatest_tensioning_speed_m_per_s,
    lag_s,
    limit_tensioning_torque,
    longest_tensioning_s,
    note_sent,
    taken_up_m,
    tensioning_limits,
    tensioning_speed_m_per_s,
    watch_spans,
)
from tests.closed_loop.conftest import demo_line

N = 3
LINE = demo_line(N)
LIMITS = tensioning_limits(LINE)
TARGET_N = np.array([20.0, 30.0, 25.0])
CONFIRMED = round(SILENT_S / LINE.control.period_s)


def with_draw_span(line: Line, span: int) -> Line:
    spans = list(line.spans)
    spans[span - 1] = spans[span - 1].model_copy(update={"control": "draw"})
    return line.model_copy(update={"spans": spans})


def with_speed(line: Line, speed_max_m_per_s: float, given_m_per_s: float | None = None) -> Line:
    limits = line.limits.model_copy(update={"speed_max_m_per_s": speed_max_m_per_s})
    tensioning = Tensioning(roller_speed_max_m_per_s=given_m_per_s)
    stages = line.stages.model_copy(update={"tensioning": tensioning})
    return line.model_copy(update={"limits": limits, "stages": stages})


def inputs_of(tension_n: FloatArray, speed_m_per_s: FloatArray) -> Inputs:
    inputs = Inputs(N)
    inputs.unwind_speed.put(0, 0.0, 0.0)
    for i in range(N):
        inputs.tension.put(i, float(tension_n[i]), 0.0)
        inputs.speed.put(i, float(speed_m_per_s[i]), 0.0)
    return inputs


def spans_of(found: list[Finding]) -> list[object]:
    return [finding.parameters["span"] for finding in found]


def found_after(
    way_m: FloatArray, tension_n: FloatArray, line: Line = LINE, first_n: FloatArray | None = None
) -> list[Finding]:
    """What is found when rollers have come so far (n,), after enough periods to be sure."""
    limits, state = tensioning_limits(line), TensioningState()
    begin_tensioning(state, inputs_of(np.zeros(N) if first_n is None else first_n, np.zeros(N)))
    state.way_m[1:] = way_m
    standing = inputs_of(tension_n, np.zeros(N))
    found: list[Finding] = []
    for period in range(CONFIRMED):
        assert not found, f"already in period {period}"
        found = watch_spans(limits, state, standing, TARGET_N)
    return found


def test_the_speed_is_a_tenth_of_the_lines_and_never_more_than_a_person_steps_back_from() -> None:
    assert tensioning_speed_m_per_s(with_speed(LINE, 0.05)) == pytest.approx(0.005)
    for fast in (10.0, 1.0):
        assert greatest_tensioning_speed_m_per_s(with_speed(LINE, fast)) == pytest.approx(0.1)
    assert tensioning_speed_m_per_s(with_speed(LINE, 10.0, given_m_per_s=0.02)) == 0.02


def test_a_stiff_web_and_a_heavy_roller_have_a_smaller_speed() -> None:
    fast = with_speed(LINE, 10.0)
    stiff = fast.model_copy(
        update={
            "web": fast.web.model_copy(update={"stiffness_n": fast.web.stiffness_n.model_copy(update={"value": 2.4e5})})
        }
    )
    assert tensioning_speed_m_per_s(stiff) < 0.2 * tensioning_speed_m_per_s(fast)


def test_the_lengths_of_web_that_rollers_take_up_are_the_differences_of_their_ways() -> None:
    state = TensioningState()
    begin_tensioning(state, inputs_of(np.zeros(N), np.zeros(N)))
    moving = inputs_of(np.zeros(N), np.array([0.01, 0.03, 0.03]))
    for _ in range(100):
        assert watch_spans(LIMITS, state, moving, TARGET_N) == []
    assert taken_up_m(state) == pytest.approx([0.01, 0.02, 0.0])
    moving.unwind_speed.put(0, 0.01, 0.0)
    for _ in range(100):
        watch_spans(LIMITS, state, moving, TARGET_N)
    assert taken_up_m(state) == pytest.approx([0.01, 0.04, 0.0])


def test_a_span_without_an_answer_is_named_with_its_numbers() -> None:
    [found] = found_after(np.array([0.0, 0.0, 0.27]), np.array([6.0, 9.0, 0.1]))
    assert (found.rule, found.action) == ("no-web", Action.TORQUE_OFF)
    assert found.parameters == {"span": 3, "taken_up_m": pytest.approx(0.27), "tension_n": pytest.approx(0.1)}
    assert "span 3: 270 mm taken up, no tension (0.10 N)" in found.text


@pytest.mark.parametrize(
    ("way_m", "tension_n", "why"),
    [
        ([0.0, 0.0, 0.20], [6.0, 9.0, 0.0], "the slack that may be there"),
        ([0.0, 0.0, 0.25], [6.0, 9.0, 0.0], "and what radii leave open"),
        ([0.0, 0.0, 0.27], [6.0, 9.0, 6.0], "it answers"),
        ([0.2, 0.2, 0.2], [6.0, 9.0, 7.0], "the web of the first span, carried on"),
        ([0.0, 0.0, -0.5], [6.0, 9.0, 0.0], "given back"),
    ],
)
def test_nothing_is_found_while_a_healthy_web_may_explain_it(
    way_m: list[float], tension_n: list[float], why: str
) -> None:
    assert found_after(np.array(way_m), np.array(tension_n)) == [], why


def test_a_cell_with_a_false_zero_does_not_answer_by_it() -> None:
    first = np.array([6.0, 9.0, 8.0])
    assert spans_of(found_after(np.array([0.0, 0.0, 0.3]), first, first_n=first)) == [3]
    tight = np.array([20.0, 30.0, 24.0])  # a web that is where it shall be needs no answer
    assert found_after(np.array([0.0, 0.0, 0.3]), tight, first_n=tight) == []


def test_the_slack_that_may_be_there_is_the_spans_own() -> None:
    spans = [
        span.model_copy(update={"slack_max_m": slack}) for span, slack in zip(LINE.spans, (0.2, 0.0, 1.0), strict=True)
    ]
    line = LINE.model_copy(update={"spans": spans})
    found = found_after(np.array([0.0, 0.05, 0.55]), np.zeros(N), line)
    assert spans_of(found) == [2]


def test_a_span_without_a_load_cell_is_told_by_its_length_alone() -> None:
    line = with_draw_span(LINE, 2)
    held = 2.0 * (TARGET_N[1] + LIMITS.dry_nm / LIMITS.radius_m[1])  # N, that no torque of the stage explains
    enough_m = float(0.2 + held / LIMITS.stiffness_n_per_m[1]) / (1.0 - LIMITS.unsure[2]) + 1e-6
    tension_n = np.array([6.0, np.nan, 8.0])
    standing = np.array([0.0, enough_m, enough_m])
    [found] = found_after(standing, tension_n, line, first_n=tension_n)
    assert (found.rule, spans_of([found])) == ("no-web-unmeasured", [2])
    assert found_after(0.99 * standing, tension_n, line, first_n=tension_n) == []


def test_a_reel_whose_radius_nobody_knows_hides_no_missing_web_before_it() -> None:
    known, reel = ({"value": 0.04, "tolerance": tolerance} for tolerance in (0.01, 0.5))
    rollers = [
        roller.model_copy(update={"radius_m": Parameter.model_validate(radius)})
        for roller, radius in zip(LINE.rollers, (known, known, reel), strict=True)
    ]
    line = LINE.model_copy(update={"rollers": rollers})
    assert spans_of(found_after(np.array([0.22, 0.22, 0.22]), np.zeros(N), line)) == [1]
    assert spans_of(found_after(np.array([0.0, 0.0, 0.36]), np.zeros(N), line)) == []


def test_an_answer_in_between_begins_the_count_anew() -> None:
    state = TensioningState()
    begin_tensioning(state, inputs_of(np.zeros(N), np.zeros(N)))
    state.way_m[1:] = 0.0, 0.0, 0.27
    silent, answers = (inputs_of(np.array([6.0, 9.0, t]), np.zeros(N)) for t in (0.0, 6.0))
    for inputs in (silent, answers, silent):
        for _ in range(CONFIRMED - 1):
            assert watch_spans(LIMITS, state, inputs, TARGET_N) == []
    assert len(watch_spans(LIMITS, state, silent, TARGET_N)) == 1


def test_what_is_sent_never_lets_a_roller_beyond_its_speed() -> None:
    """A free roller of any inertia, that is asked for all the torque there is; friction is in its favour."""
    for lightness in (0.7, 1.0, 1.3):
        inertia = LINE.rollers[0].inertia_kg_m2.value * lightness
        state, speed, fastest, sent = TensioningState(), np.zeros(N), 0.0, [np.zeros(N)] * 3
        begin_tensioning(state, inputs_of(np.zeros(N), speed))
        for _ in range(1000):
            inputs = inputs_of(np.zeros(N), speed)
            torque = limit_tensioning_torque(LIMITS, state, np.full(N, 60.0), inputs, TARGET_N)
            note_sent(LIMITS, state, torque)
            sent.append(torque)
            speed = speed + 0.01 * 0.04 / inertia * sent[-3]  # two periods late
            fastest = max(fastest, float(np.abs(speed).max()))
        assert 0.7 * AIM_SHARE < fastest / LIMITS.speed_m_per_s < 1.15, lightness
        assert np.abs(speed).max() < LIMITS.speed_m_per_s
    assert TRIP_FACTOR > 1.15


def test_a_roller_that_is_held_gets_what_its_tension_explains_and_no_more() -> None:
    state = TensioningState()
    inputs = inputs_of(np.array([20.0, 30.0, 0.0]), np.zeros(N))
    begin_tensioning(state, inputs)
    for _ in range(2000):
        note_sent(LIMITS, state, limit_tensioning_torque(LIMITS, state, np.full(N, 60.0), inputs, TARGET_N))
    low, high = explained_torque_nm(LIMITS, inputs, TARGET_N)
    assert state.sent_nm == pytest.approx(high)
    radius, share = 0.04, 0.5 * 0.04 * 1.2
    ramp = float(LIMITS.ramp_nm[0])
    # R (T_i - what span i+1 shows) + share of the greater set-point + dry friction + inertia
    assert high == pytest.approx([radius * (20 - 30) + share * 30 + 2 + ramp, radius * 30 + share * 30 + 2 + ramp,
                                  radius * 25 + share * 25 + 2 + ramp])  # fmt: skip
    assert low == pytest.approx(
        [-(radius * 30 + share * 30 + 2 + ramp), -(share * 30 + 2 + ramp), -(share * 25 + 2 + ramp)]
    )


def test_friction_is_explained_by_the_speed_that_a_roller_has() -> None:
    standing, turning = (inputs_of(np.zeros(N), np.full(N, speed)) for speed in (0.0, 0.01))
    more = explained_torque_nm(LIMITS, turning, TARGET_N)[1] - explained_torque_nm(LIMITS, standing, TARGET_N)[1]
    assert more == pytest.approx(np.full(N, 1.5 * 10.0 * 1.75 / (0.04 * 0.8) * 0.01))


def test_a_span_without_a_load_cell_behind_allows_whatever_it_may_carry() -> None:
    limits = tensioning_limits(with_draw_span(LINE, 2))
    inputs = inputs_of(np.array([20.0, np.nan, 25.0]), np.zeros(N))
    low, high = explained_torque_nm(limits, inputs, TARGET_N)
    assert np.isfinite([low, high]).all()
    assert high[0] - low[0] == pytest.approx(2.0 * (limits.share_m[0] * 30 + 2 + limits.ramp_nm[0]) + 0.04 * (20 + 30))


def test_tensioning_has_as_much_time_as_its_slack_takes() -> None:
    speed = tensioning_speed_m_per_s(LINE)
    assert longest_tensioning_s(LINE) == pytest.approx(20.0 + N * (0.2 + float(LIMITS.stretch_m[0])) / (0.5 * speed))
    assert longest_tensioning_s(LINE) < inf


@pytest.mark.parametrize("count_m_per_s", [0.0, 0.0005, 0.0157])
def test_no_count_of_a_drive_that_tells_revolutions_takes_torque_off(count_m_per_s: float) -> None:
    """A roller as fast as it may be, of which the drive shows the next count but one."""
    speed = tensioning_speed_m_per_s(LINE)
    trip = envelope_limits(LINE, np.full(N, count_m_per_s)).tensioning_speed_m_per_s
    assert trip >= speed + TRIP_DEVIATIONS * expected_noise(LINE).speed_m_per_s + TRIP_COUNTS * count_m_per_s
    assert trip >= TRIP_FACTOR * speed


def test_a_roller_is_as_slow_as_the_noise_of_its_encoder_asks_for() -> None:
    """Its time constant follows from the noise once that would be too much of what torque may change by."""
    quiet = demo_line(3)
    assert lag_s(quiet) == LAG_DELAYS * delay_s(quiet)
    noisy, slow = (with_speed(quiet, times * quiet.limits.speed_max_m_per_s) for times in (200.0, 400.0))
    assert lag_s(slow) == pytest.approx(2.0 * lag_s(noisy)) and lag_s(noisy) > lag_s(quiet)
    lever = max(roller.inertia_kg_m2.value / roller.radius_m.value for roller in noisy.rollers)
    change_nm = lever * expected_noise(noisy).speed_m_per_s / lag_s(noisy)
    assert change_nm == pytest.approx(NOISE_SHARE * noisy.limits.torque_rate_nm_per_s * noisy.control.period_s)
