"""The envelope at its boundaries: one test a rule, and properties that must hold for whatever a law may ask."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from gateway.core.signals import DriveState, Quality
from safety.actions import Action, most_severe
from safety.envelope import EnvelopeState, Supervision, check_timing, check_torque, limit_torque
from safety.limits import envelope_limits
from tests.closed_loop.conftest import demo_line
from tests.safety.envelope_support import (
    AT_STANDSTILL,
    EVERYTHING,
    LIMITS,
    TORQUE_FREE,
    findings_after,
    healthy,
    story,
)


def test_a_healthy_line_runs_on():
    assert findings_after(100, healthy()) == []


@pytest.mark.parametrize("channel", ["tension", "speed", "unwind_speed"])
@pytest.mark.parametrize("how", ["miss", "reject"])
def test_a_missing_signal_holds_the_outputs_and_stops_at_the_third_period(channel, how):
    inputs = healthy()
    getattr(getattr(inputs, channel), how)(0)
    assert not story(inputs).usable and not story(inputs, inputs).feedback_lost
    assert story(inputs, inputs, inputs).feedback_lost
    assert [most_severe(findings_after(k, inputs)) for k in (1, 2, 3)] == [
        Action.HOLD_OUTPUTS,
        Action.HOLD_OUTPUTS,
        Action.STOP,
    ]
    assert findings_after(5, inputs, TORQUE_FREE) == []


def test_signals_that_come_back_start_the_count_anew():
    gone = healthy()
    gone.tension.miss(1)
    for k in range(1, 6):
        assert most_severe(story(*[gone, gone, healthy(), gone, gone][:k]).findings) < Action.STOP


def test_a_signal_that_comes_and_goes_stops_the_line_as_well():
    gone = healthy()
    gone.tension.miss(1)
    flickering = [gone, gone, healthy()] * 10
    stops = [most_severe(story(*flickering[:k]).findings) is Action.STOP for k in range(1, 15)]
    # six misses within the window are borne, the seventh is not
    assert stops.index(True) == 9
    rarely = [gone, *[healthy()] * 9] * 5
    assert all(most_severe(story(*rarely[:k]).findings) < Action.STOP for k in range(1, 50))


def test_a_load_cell_measures_the_spans_that_the_lines_file_controls_by_tension():
    line = demo_line(3)
    assert envelope_limits(line).measured.tolist() == [1.0, 1.0, 1.0]
    by_draw = line.spans[1].model_copy(update={"control": "draw"})
    mixed = line.model_copy(update={"spans": [line.spans[0], by_draw, line.spans[2]]})
    assert envelope_limits(mixed).measured.tolist() == [1.0, 0.0, 1.0]


def test_a_draw_span_has_no_load_cell_and_none_is_missed():
    inputs = healthy()
    inputs.tension.reject(2)
    assert story(inputs).usable and findings_after(10, inputs) == []


@pytest.mark.parametrize(
    ("tension", "action"),
    [
        (60.0, Action.NONE),
        (60.01, Action.STOP),
        (2.0, Action.NONE),
        (1.99, Action.BRAKE),
        (-5.0, Action.BRAKE),
    ],
)
def test_the_tension_band_trips_on_the_second_sample_outside(tension, action):
    inputs = healthy()
    inputs.tension.put(0, tension, 1.0)
    assert findings_after(1, inputs) == []
    assert most_severe(findings_after(2, inputs)) is action


def test_the_floor_counts_only_once_the_web_is_tensioned_the_ceiling_always():
    slack, tight = healthy(), healthy()
    slack.tension.put(0, 0.0, 1.0)
    tight.tension.put(0, 61.0, 1.0)
    assert findings_after(5, slack, TORQUE_FREE) == []
    assert most_severe(findings_after(2, tight, TORQUE_FREE)) is Action.STOP


@pytest.mark.parametrize("state", [s for s in DriveState if s is not DriveState.ENABLED])
def test_a_drive_that_no_longer_follows_stops_the_line_at_once(state):
    inputs = healthy()
    inputs.drive_state[1] = state
    found = findings_after(1, inputs)
    assert most_severe(found) is Action.STOP and "2 " + state.name in found[0].text
    assert findings_after(1, inputs, TORQUE_FREE) == []


def test_the_line_plc_speaks_and_is_missed():
    inputs = healthy()
    inputs.plc.permissive = False
    assert most_severe(findings_after(1, inputs)) is Action.STOP
    inputs.plc.emergency_stop = True
    assert most_severe(findings_after(1, inputs)) is Action.TORQUE_OFF
    inputs.plc.quality = Quality.STALE
    assert not story(inputs, inputs).plc_lost and story(inputs, inputs, inputs).plc_lost
    assert most_severe(findings_after(2, inputs)) is Action.NONE
    assert most_severe(findings_after(3, inputs)) is Action.STOP


@pytest.mark.parametrize("direction", [1, -1])
def test_overspeed_of_the_unwinder(direction):
    inputs = healthy()
    inputs.unwind_speed.put(0, direction * 1.1 * 0.12, 1.0)
    assert findings_after(1, inputs) == []
    inputs.unwind_speed.put(0, direction * (1.1 * 0.12 + 1e-6), 1.0)
    assert most_severe(findings_after(1, inputs)) is Action.STOP


@pytest.mark.parametrize("direction", [1, -1])
@pytest.mark.parametrize(("supervision", "factor"), [(EVERYTHING, 1.5), (AT_STANDSTILL, 1.0)])
def test_a_roller_that_runs_away_loses_its_torque(supervision, factor, direction):
    inputs = healthy()
    inputs.speed.put(2, direction * factor * 0.12, 1.0)
    assert findings_after(5, inputs, supervision) == []
    inputs.speed.put(2, direction * (factor * 0.12 + 1e-6), 1.0)
    assert findings_after(1, inputs, supervision) == []  # one sample may be a spike
    assert most_severe(findings_after(2, inputs, supervision)) is Action.TORQUE_OFF
    assert findings_after(9, inputs, TORQUE_FREE) == []


def test_transport_that_the_plc_has_stopped_stops_the_line():
    inputs = healthy()
    inputs.plc.running = False
    assert findings_after(9, inputs) == []
    assert most_severe(findings_after(10, inputs)) is Action.STOP
    assert findings_after(50, inputs, TORQUE_FREE) == []


def test_a_ready_line_wants_ready_drives():
    inputs = healthy()
    ready = Supervision(False, False, False, DriveState.READY, False)
    assert most_severe(findings_after(1, inputs, ready)) is Action.STOP
    inputs.drive_state[:] = DriveState.READY
    assert findings_after(1, inputs, ready) == []


def timing(*skipped):
    state, found = EnvelopeState(), []
    for periods in skipped:
        found, state = check_timing(LIMITS, state, periods)
    return most_severe(found)


def test_a_web_that_breaks_is_told_from_slack():
    broken = healthy()
    broken.tension.put(1, 0.0, 1.0)
    (finding,) = findings_after(2, broken)
    assert finding.rule == "slack" and finding.action is Action.BRAKE
    broken.speed.put(1, 0.08, 1.0)
    found = [(one.action, one.parameters["span"]) for one in findings_after(2, broken) if one.rule == "web-break"]
    assert found == [(Action.BRAKE, 2)]


def test_missing_signals_without_a_gap_are_told_as_a_range():
    inputs = healthy()
    for i in range(3):
        inputs.speed.miss(i)
    inputs.tension.miss(0)
    (finding,) = findings_after(1, inputs)
    assert finding.parameters["signals"] == "T1, v1-v3"


def test_overruns_stop_the_line_when_they_are_long_or_many():
    assert timing(5) is Action.NONE and timing(6) is Action.STOP
    assert timing(1, 1) is Action.NONE and timing(1, 1, 1) is Action.STOP
    assert timing(1, 1, 0, 1, 1) is Action.NONE
    assert check_timing(LIMITS, EnvelopeState(), 0) == ([], EnvelopeState())


@given(st.lists(st.sampled_from([np.nan, np.inf, -np.inf, 1.0]), min_size=3, max_size=3))
def test_a_torque_that_is_not_finite_is_never_used(asked):
    found = check_torque(np.array(asked))
    assert bool(found) == (not np.isfinite(asked).all())
    assert most_severe(found) is (Action.TORQUE_OFF if found else Action.NONE)


torques = st.lists(st.floats(-1e6, 1e6), min_size=3, max_size=3).map(np.array)
applied = st.lists(st.floats(-60, 60), min_size=3, max_size=3).map(np.array)


@given(torques, applied, st.floats(-0.01, 0.1))
def test_applied_torque_keeps_limit_and_rate_and_is_the_nearest_that_does(asked, before, interval_s):
    torque = limit_torque(LIMITS, asked, before, interval_s)
    step = 1000.0 * min(max(interval_s, 0.0), 0.01)
    assert (np.abs(torque) <= 60.0).all()
    assert (np.abs(torque - before) <= step + 1e-9).all()
    low, high = np.maximum(before - step, -60.0), np.minimum(before + step, 60.0)
    nearest = np.array(
        [min((x, a, b), key=lambda y: (not a <= y <= b, abs(y - x))) for x, a, b in zip(asked, low, high, strict=True)]
    )
    assert np.allclose(torque, nearest)
