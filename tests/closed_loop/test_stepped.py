"""The whole cycle in stepped time: arm, start, run, hold, stop, and what the recorder at the drives says of it."""

from dataclasses import replace

import numpy as np
import pytest

from gateway.cli.rehearse_designs import truth_of
from gateway.cli.stepped import SteppedLoop, run_scenario
from gateway.control.design import design_lqg, design_lqi, design_lqr, design_pid, design_scheduled, task_of
from gateway.core.finding import finding
from gateway.core.line import Line
from gateway.core.messages import Arm, Hold, SelectRecipe, SetSpeed, SetTension, Start, Stop
from gateway.core.scenario import PAPER, TENSION
from gateway.core.states import LoopState, Phase
from tests.closed_loop.conftest import demo_line, real_plant, start, stepped

TENSIONS = np.array(TENSION.tension_n)


def test_silent_until_armed_and_no_torque_until_started(loop):
    for command in (Start(), Hold()):
        assert not loop.command(command).ok
    loop.step(100)
    assert loop.cycle.machine.state is LoopState.SILENT
    assert loop.arm().ok and loop.step_until(Phase.READY, 1.0)
    loop.step(100)
    recording = loop.truth.recorder.recording()
    assert not recording.torque_nm.any()
    commands = recording.of_kind("torques")
    armed_s = next(time_s for time_s, phase, _ in loop.transitions if phase is Phase.ARMING)
    assert all(command["time_s"] > armed_s and not any(command["commanded_nm"]) for command in commands)


@pytest.mark.parametrize("law", ["lqi", "pid"])
@pytest.mark.parametrize("spans", [1, 2, 6, 20, 60])
def test_any_number_of_spans_starts_settles_and_stops(spans, law):
    loop = start(stepped(spans, law))
    setpoints = np.array(loop.line.recipes[0].tension_n)
    loop.step(round(3.0 / loop.line.control.period_s))
    assert np.abs(loop.truth.world.tension_n - setpoints).max() < 1.5
    assert loop.truth.world.unwind_speed_m_per_s == pytest.approx(loop.line.recipes[0].speed_m_per_s)
    assert loop.command(Stop()).ok
    assert loop.step_until(Phase.OFF, 12.0)
    loop.step(5)
    assert not loop.truth.world.torque_nm.any() and loop.truth.world.unwind_speed_m_per_s == 0.0
    assert loop.truth.recorder.unsafe_total == 0, loop.truth.recorder.unsafe_events


def test_hold_brings_standstill_under_tension_and_start_leads_back(running):
    assert running.command(Hold()).state == "HOLD"
    running.step(300)
    assert running.truth.world.unwind_speed_m_per_s == 0.0
    assert np.abs(running.truth.world.tension_n - TENSIONS).max() < 1.0
    assert running.command(Start()).state == "RUN"
    running.step(300)
    assert running.truth.world.unwind_speed_m_per_s == pytest.approx(0.01)
    assert running.truth.recorder.unsafe_total == 0


def test_stop_is_latched_and_only_arm_leads_out(running):
    running.command(Stop())
    assert running.step_until(Phase.OFF, 5.0)
    for command in (Start(), Hold()):
        assert not running.command(command).ok
    assert running.arm().ok and running.step_until(Phase.READY, 1.0)
    assert "already" in running.command(Arm()).text


def test_setpoints_ramp_or_step_within_the_limits(running):
    assert running.command(SetTension(span=1, tension_n=38.0)).ok
    before, moves = 28.0, []
    for _ in range(100):
        running.step()
        before, moved = running.cycle.setpoints.tension_n[0], running.cycle.setpoints.tension_n[0] - before
        moves.append(moved)
    assert before == 38.0 and moves[0] < 0.1 * max(moves)  # along a curve
    assert max(moves) == pytest.approx(20.0 * running.line.control.period_s, rel=0.05)
    running.step(125)
    assert running.truth.world.tension_n[0] == pytest.approx(38.0, abs=1.0)
    assert running.command(SetTension(span=3, tension_n=44.0, step=True)).ok
    assert running.cycle.setpoints.tension_n[2] == 44.0
    assert running.command(SetSpeed(speed_m_per_s=0.1)).ok
    running.step(400)
    assert running.truth.world.unwind_speed_m_per_s == pytest.approx(0.1)
    assert running.command(SelectRecipe(name="velocity")).ok
    running.step(500)
    assert np.abs(running.truth.world.tension_n - 30.0).max() < 1.0
    assert running.truth.recorder.unsafe_total == 0


@pytest.mark.parametrize(
    ("command", "told"),
    [
        (SetTension(span=7, tension_n=30.0), finding("no-such-span", span=7, spans=6)),
        (SetTension(span=1, tension_n=59.1), finding("tension-out-of-range", tension_n=59.1, low_n=3.0, high_n=59.0)),
        (SetTension(span=1, tension_n=2.9), finding("tension-out-of-range", tension_n=2.9, low_n=3.0, high_n=59.0)),
        (SetTension(span=1, tension_n=-30.0), finding("tension-out-of-range", tension_n=-30.0, low_n=3.0, high_n=59.0)),
        (SetTension(span=3, tension_n=44.1, step=True), "step-too-large-tension"),
        (SetSpeed(speed_m_per_s=0.121), finding("speed-out-of-range", speed_m_per_s=0.121, allowed_m_per_s=0.12)),
        (SetSpeed(speed_m_per_s=-0.01), finding("speed-out-of-range", speed_m_per_s=-0.01, allowed_m_per_s=0.12)),
        (SetSpeed(speed_m_per_s=0.11, step=True), "step-too-large-speed"),
        (SelectRecipe(name="velocty"), finding("no-such-recipe", recipe="velocty", nearest="velocity")),
    ],
)
def test_what_is_outside_the_limits_is_refused_and_changes_nothing(running, command, told):
    before = running.cycle.setpoints.tension_target_n.copy(), running.cycle.setpoints.speed_target_m_per_s
    reply = running.command(command)
    assert not reply.ok and told in (reply.findings[0], reply.findings[0].code)
    assert (before[0] == running.cycle.setpoints.tension_target_n).all()
    assert before[1] == running.cycle.setpoints.speed_target_m_per_s


def test_steps_of_several_spans_add_up_until_they_are_over(running):
    before = running.cycle.setpoints.tension_n.tolist()
    goals = [value + (24.0 if value < 34.0 else -24.0) for value in before]
    said = [SetTension(span=i, tension_n=goal, step=True) for i, goal in enumerate(goals[:5], 1)]
    assert all(running.command(one).ok for one in said[:4])
    refused = running.command(said[4])
    assert not refused.ok and refused.findings[0].code == "steps-too-large-together"
    told = {"step_n": 24.0, "together_n": 120.0, "allowed_n": 96.0, "within_s": running.cycle.setpoints.step_pause_s}
    assert refused.findings[0].parameters == pytest.approx(told)
    assert running.command(SetTension(span=5, tension_n=goals[4])).ok, "a ramp at any time"


def test_the_line_plc_takes_its_permissive_back(running):
    running.command(SetSpeed(speed_m_per_s=0.05))
    running.step(200)
    running.truth.plc.permissive = False
    running.step(2)
    assert running.cycle.machine.phase is Phase.SLOWING and running.stopped_by[-1][1].rule == "no-permissive"
    assert running.step_until(Phase.OFF, 5.0)
    reply = running.arm()
    assert not reply.ok and [one.code for one in reply.findings] == ["no-permissive"]


def test_emergency_stop_takes_torque_off_without_waiting_for_standstill(running):
    running.truth.plc.emergency_stop = True
    running.step(2)
    assert running.cycle.machine.phase is Phase.UNLOADING
    assert running.step_until(Phase.OFF, 1.0)
    running.step(2)
    assert not running.truth.world.torque_nm.any()


def test_a_law_that_gives_nan_never_reaches_the_drives(running, monkeypatch):
    from gateway.control.law import Decision

    broken = Decision(np.full(6, np.nan), np.zeros(6), np.zeros(6))
    monkeypatch.setattr(running.cycle.torque_path.law, "ask", lambda *_: broken)
    running.step(1)
    assert running.cycle.machine.phase is Phase.UNLOADING and running.stopped_by[-1][1].rule == "torque-not-finite"
    assert running.step_until(Phase.OFF, 1.0)
    assert np.isfinite(running.truth.recorder.recording().torque_nm).all()
    assert running.truth.recorder.unsafe_total == 0


def test_a_missing_load_cell_holds_for_two_periods_and_stops_at_the_third(running, monkeypatch):
    held = running.cycle.outputs.torque_nm.copy()
    sample = running.truth.sample

    def without(now_s):
        reading = sample(now_s)
        reading.tension_n[3] = np.nan
        return reading

    monkeypatch.setattr(running.truth, "sample", without)
    running.step(2)
    assert running.cycle.machine.phase is Phase.RUNNING and (running.cycle.outputs.torque_nm == held).all()
    assert running.recorded()[-1].held == 2
    running.step(1)
    assert running.cycle.machine.state is LoopState.STOP
    assert running.stopped_by[-1][1].parameters == {"signals": "T4", "missed": 3, "periods": 3}
    assert running.step_until(Phase.OFF, 1.0)


def test_one_missing_sample_costs_nothing(running, monkeypatch):
    sample = running.truth.sample
    monkeypatch.setattr(running.cycle.links[0], "collect", _deaf(running.cycle.links[0]))
    running.step(1)
    monkeypatch.undo()
    assert running.truth.sample == sample
    running.step(100)
    assert running.cycle.machine.phase is Phase.RUNNING
    assert np.abs(running.truth.world.tension_n - TENSIONS).max() < 1.0


def _deaf(link):
    async def collect(inputs, deadline_s):
        inputs.tension.miss(0)

    return collect


def test_the_same_seed_gives_the_same_run_and_another_one_does_not():
    line, plant = demo_line(), real_plant()
    config = design_lqi(task_of(line))
    runs = [run_scenario(line, config, plant, TENSION, seed) for seed in (5, 5, 6)]
    assert (runs[0].tension_n == runs[1].tension_n).all() and (runs[0].tension_n != runs[2].tension_n).any()


@pytest.mark.parametrize(("case", "reference_n"), [(PAPER[0], 2.01), (PAPER[1], 1.16)])
def test_lqi_on_the_wrong_model_keeps_the_reference_figures(case, reference_n):
    """Tier A of the benchmark; the reference is an independent study's LQI."""
    line = demo_line()
    results = [run_scenario(line, design_lqi(task_of(line)), real_plant(), case, seed) for seed in range(6)]
    assert np.mean([result.rmse_n for result in results]) <= 1.05 * reference_n
    assert sum(result.unsafe_events for result in results) == 0


def test_pid_holds_both_cases_without_an_unsafe_event():
    line = demo_line()
    results = [run_scenario(line, design_pid(task_of(line)), real_plant(), case, 1) for case in PAPER]
    assert sum(result.unsafe_events for result in results) == 0
    assert max(result.rmse_n for result in results) < 3.0


def test_a_scheduled_law_runs_in_the_cycle_as_the_law_that_it_is_made_of():
    """The speed case: gains of this line hardly depend on the speed, so that neither may the result."""
    line, plant, case = demo_line(), real_plant(), PAPER[1]
    config = design_scheduled(task_of(line), design_lqi, [0.0, 0.05, 0.1])
    found, alone = (run_scenario(line, one, plant, case, seed=1) for one in (config, design_lqi(task_of(line))))
    assert found.unsafe_events == alone.unsafe_events == 0
    assert found.rmse_n == pytest.approx(alone.rmse_n, rel=0.01) and found.rmse_n != alone.rmse_n


DRAWN = 2  #: from 0: the span that the tension case steps


def draw_line() -> Line:
    """The demonstration line without the load cell of one span: its roller keeps a speed ratio."""
    line = demo_line()
    spans = list(line.spans)
    spans[DRAWN] = spans[DRAWN].model_copy(update={"control": "draw"})
    cells = [cell for cell in line.load_cells if cell.span != DRAWN + 1]
    return line.model_copy(update={"spans": spans, "load_cells": cells})


@pytest.mark.parametrize("design", [design_lqr, design_lqg])
@pytest.mark.parametrize("case", PAPER)
def test_a_line_with_a_draw_span_begins_at_rest_and_keeps_what_it_controls(case, design):
    line, plant = draw_line(), real_plant()
    config = design(replace(task_of(line), model=truth_of(plant)))  # what moves is not the model's fault
    found = run_scenario(line, config, plant, case, seed=1)
    before = found.tension_n[found.time_s < case.change_at_s, DRAWN]
    assert np.abs(before - case.tension_n[DRAWN]).max() < 0.2
    error = np.abs(found.tension_n[-1] - case.tension_end_n)
    assert np.delete(error, DRAWN).max() < 0.5
    assert found.unsafe_events == 0


def test_a_draw_span_that_starts_from_rest_begins_without_tension():
    """Its set-point stands where the web does: there in production, at nothing once the line has been unloaded."""
    line = draw_line()
    loop = SteppedLoop(line, design_lqi(task_of(line)), real_plant(), seed=1)
    loop.begin_in_production(TENSIONS, 0.01)
    loop.step(100)
    assert all((frame.tension_setpoint_n == TENSIONS).all() for frame in loop.recorded())
    loop.command(Stop())
    assert loop.step_until(Phase.OFF, 5.0)
    assert loop.arm().ok and loop.step_until(Phase.READY, 1.0)
    assert loop.command(Start()).ok and loop.step_until(Phase.TENSIONING, 1.0)
    assert loop.recorded()[-1].tension_setpoint_n[DRAWN] == 0.0
