"""Samples that lie, through the whole cycle in stepped time; the recorder is the judge."""

import numpy as np
import pytest

from gateway.cli.stepped import SteppedLoop
from gateway.core.doubts import Doubt
from gateway.core.messages import SetSpeed, SetTension
from gateway.core.signals import Quality
from gateway.core.states import LoopState, Phase
from tests.closed_loop.conftest import demo_line, real_plant, start, stepped

RULES = {"cell-stuck", "cell-drifts", "saturated"}


def lying(loop, monkeypatch, change):
    """From now on what is read is `change(sample, seconds)`."""
    sample, begin_s = loop.truth.sample, loop.now_s

    def reading(now_s):
        taken = sample(now_s)
        change(taken, now_s - begin_s)
        return taken

    monkeypatch.setattr(loop.truth, "sample", reading)


def with_tension(span, value_n):
    def change(sample, passed_s):
        tension_n = sample.tension_n.copy()
        tension_n[span] = value_n(tension_n[span], passed_s)
        object.__setattr__(sample, "tension_n", tension_n)

    return change


def with_speed(roller, value):
    def change(sample, passed_s):
        speed = sample.speed_m_per_s.copy()
        speed[roller] = value(speed[roller], passed_s)
        object.__setattr__(sample, "speed_m_per_s", speed)

    return change


@pytest.mark.parametrize("beside_n", [-0.5, 0.3, 0.5])
@pytest.mark.parametrize("span", [0, 2, 5])
def test_what_a_stuck_cell_shows_beside_its_setpoint_is_not_controlled_away(running, monkeypatch, span, beside_n):
    """For as long as it takes to be sure that it is stuck: an integral action on it empties the span before."""
    assert running.command(SetSpeed(speed_m_per_s=0.1)).ok
    running.step(500)
    target_n = float(running.cycle.setpoints.tension_n[span])
    lying(running, monkeypatch, with_tension(span, lambda tension_n, passed_s: target_n + beside_n))
    furthest_n = 0.0
    for _ in range(round(1.0 / running.line.control.period_s)):  # so soon it is stopped
        running.step()
        if running.cycle.machine.state is not LoopState.RUN:
            break
        furthest_n = max(furthest_n, abs(float(running.truth.world.tension_n[span]) - target_n))
    assert [finding.rule for _, finding in running.stopped_by] == ["load-cell-stuck"]
    assert furthest_n < 0.3 * target_n
    assert running.step_until(Phase.OFF, 5.0) and not any(running.truth.recorder.unsafe_events.values())


@pytest.mark.parametrize("speed_m_per_s", [0.01, 0.1])
@pytest.mark.parametrize("span", [0, 2, 5])
def test_a_stuck_cell_is_told_and_stops_the_line_within_a_second(running, monkeypatch, span, speed_m_per_s):
    assert running.command(SetSpeed(speed_m_per_s=speed_m_per_s)).ok
    running.step(500)
    stuck_n = float(running.cycle.inputs.tension.value[span])
    lying(running, monkeypatch, with_tension(span, lambda _, __: stuck_n))
    begin_s = running.now_s
    running.step(100)
    assert running.cycle.watch.doubts == Doubt.CELL_STUCK
    assert list(np.flatnonzero(running.cycle.watch.stuck)) == [span]
    (time_s, finding), *_ = running.alarms
    assert time_s - begin_s <= 1.0 and finding.parameters["cell"] == f"load-cell-{span + 1}"
    assert running.recorded()[-1].tension_quality[span] == Quality.BAD
    assert running.stopped_by[0][1].parameters["span"] == span + 1
    assert running.step_until(Phase.OFF, 12.0)
    assert running.truth.recorder.unsafe_total == 0, running.truth.recorder.unsafe_events
    running.step(500)
    assert running.cycle.watch.doubts == Doubt.CELL_STUCK, "until somebody has looked"
    assert running.arm().ok and running.cycle.watch.doubts == Doubt.NONE


@pytest.mark.parametrize(("span", "rate_n_per_s"), [(0, 0.1), (2, -0.1), (5, 0.1)])
def test_a_drifting_cell_is_named_within_a_minute(running, monkeypatch, span, rate_n_per_s):
    running.step(2500)
    assert running.alarms == []
    lying(running, monkeypatch, with_tension(span, lambda true_n, passed_s: true_n + rate_n_per_s * passed_s))
    begin_s = running.now_s
    running.step(6000)
    (time_s, finding), *_ = running.alarms
    assert (finding.rule, finding.parameters["cell"]) == ("cell-drifts", f"load-cell-{span + 1}"), running.alarms
    assert time_s - begin_s <= 60.0
    assert Doubt.CELL_DRIFTS in running.cycle.watch.doubts


def test_an_encoder_that_jumps_once_is_discarded_and_twice_stops_the_line(running, monkeypatch):
    running.step(300)
    lying(running, monkeypatch, with_speed(3, lambda true, passed_s: 0.6 if passed_s < 0.015 else true))
    running.step(1)
    assert running.cycle.machine.state is LoopState.RUN and running.cycle.account.held == 1
    running.step(100)
    assert running.cycle.machine.state is LoopState.RUN and running.cycle.account.held == 0
    lying(running, monkeypatch, with_speed(3, lambda true, _: true + 0.6))
    running.step(2)
    assert ("encoder-jump", 4) in {(one.rule, one.parameters.get("roller")) for _, one in running.stopped_by}
    assert running.step_until(Phase.OFF, 12.0)
    assert running.truth.recorder.unsafe_total == 0, running.truth.recorder.unsafe_events


def test_torques_at_their_limit_for_two_seconds_block_proposals():
    plant = real_plant()
    stiff = plant.rollers.model_copy(update={"friction_nms_per_rad": 17.5})  # 60 Nm are too little at 0.12 m/s
    loop = start(SteppedLoop(demo_line(), stepped().config, plant.model_copy(update={"rollers": stiff}), 1))
    assert loop.command(SetSpeed(speed_m_per_s=0.12)).ok
    saturated_s = None
    while loop.cycle.watch.doubts == Doubt.NONE and loop.cycle.machine.state is LoopState.RUN:
        loop.step()
        if not loop.recorded()[-1].saturated:
            saturated_s = None
        elif saturated_s is None:
            saturated_s = loop.now_s
    assert loop.cycle.watch.doubts == Doubt.SATURATED and saturated_s is not None
    assert loop.now_s - saturated_s <= 2.0
    assert "saturated" in {finding.rule for _, finding in loop.alarms}
    assert loop.command(SetSpeed(speed_m_per_s=0.05)).ok
    loop.step(600)
    assert loop.cycle.watch.doubts == Doubt.NONE and loop.cycle.machine.state is LoopState.RUN


@pytest.mark.parametrize(
    "change", [SetTension(span=3, tension_n=44.0, step=True), SetSpeed(speed_m_per_s=0.1, step=True)]
)
def test_steps_of_set_points_raise_no_doubt(running, change):
    running.step(300)
    assert running.command(change).ok
    running.step(3000)
    assert not any(finding.rule in RULES for _, finding in running.alarms), running.alarms
    assert running.cycle.machine.state is LoopState.RUN


def test_the_balance_is_averaged_anew_after_a_step_of_a_tension(running, monkeypatch):
    """A cell that jumps together with its set-point: nothing tells from which moment on the balance is another one."""
    running.step(2500)
    assert running.command(SetTension(span=3, tension_n=30.0, step=True)).ok
    lying(running, monkeypatch, with_tension(2, lambda true_n, _: true_n + 4.0))
    running.step(3000)
    assert Doubt.CELL_DRIFTS not in running.cycle.watch.doubts


def test_slack_and_a_broken_web_are_told_apart_and_both_take_torque_off(running, monkeypatch):
    running.step(300)
    lying(running, monkeypatch, with_tension(3, lambda _, __: 0.5))  # what a dead load cell shows
    running.step(3)
    (_, phase, reason) = running.transitions[-1]
    assert phase is Phase.UNLOADING and "tension 4 is 0.50 N" in reason and "broken" not in reason


def test_two_signals_that_agree_are_a_broken_web(running, monkeypatch):
    running.step(300)

    def broken(sample, passed_s):
        with_tension(3, lambda _, __: 0.0)(sample, passed_s)
        with_speed(3, lambda true, _: true + 0.05 * passed_s + 0.001)(sample, passed_s)

    lying(running, monkeypatch, broken)
    running.step(3)
    (_, phase, reason) = running.transitions[-1]
    assert phase is Phase.UNLOADING and "the web has broken" in reason


def with_unwinder(value):
    def change(sample, passed_s):
        shown = value(sample.unwind_speed_m_per_s, round(passed_s / 0.01))
        object.__setattr__(sample, "unwind_speed_m_per_s", shown)

    return change


def at_0_1_m_per_s(running):
    assert running.command(SetSpeed(speed_m_per_s=0.1)).ok
    running.step(500)
    assert running.cycle.inputs.unwind_speed.value[0] > 0.09
    return running


def test_a_torn_unwinder_speed_is_not_used_and_stops_the_line_when_it_comes_again(running, monkeypatch):
    lying(at_0_1_m_per_s(running), monkeypatch, with_unwinder(lambda v, k: 0.001 if k in (10, 200, 202, 204) else v))
    for _ in range(100):
        running.step()
        assert running.cycle.inputs.unwind_speed.value[0] > 0.09
    assert [finding.rule for _, finding in running.alarms] == ["value-impossible"]
    assert running.cycle.machine.phase is Phase.RUNNING
    running.step(110)
    assert running.cycle.machine.state is LoopState.STOP and running.stopped_by[-1][1].rule == "value-impossible"


def test_a_transport_that_stops_at_once_is_no_wrong_value(running, monkeypatch):
    lying(at_0_1_m_per_s(running), monkeypatch, with_unwinder(lambda v, k: 0.0 if k >= 5 else v))
    running.step(8)
    assert running.cycle.inputs.unwind_speed.value[0] == 0.0
    assert "value-impossible" not in [finding.rule for _, finding in running.alarms]
