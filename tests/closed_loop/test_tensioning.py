"""A start with and without a web, with slack, with somebody near: stepped time, judged by what the devices had."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from gateway.cli.stepped import SteppedLoop
from gateway.control.design import design_lqi, design_pid, task_of
from gateway.control.law import Measured
from gateway.core.line import Line, Parameter
from gateway.core.line_rules_estimate import breaks_are_seen, estimates_are_bounds
from gateway.core.messages import Hold, SelectRecipe, SetSpeed, Start, Stop
from gateway.core.signals import FloatArray
from gateway.core.states import LoopState, Phase
from gateway.loop.standstill import turns_m_per_s
from safety.tensioning import AIM_SHARE, TRIP_FACTOR, longest_tensioning_s, tensioning_limits, tensioning_speed_m_per_s
from sim_plant.faults.parse import parse_fault
from sim_plant.faults.stepped import injector_of
from sim_plant.plant import Plant, load_plant
from sim_plant.stepped import Sample
from tests.bench.faults_lines import DEMO, virtual_line
from tests.bench.lines import WIRINGS
from tests.closed_loop.conftest import demo_line, real_plant

N = 3
LAWS = {"lqi": design_lqi, "pid": design_pid}
STOPPED_WITHIN_S = 2.0  #: after the slack that may be there is used up


def with_speed(speed_max_m_per_s: float, line: Line) -> Line:
    return line.model_copy(update={"limits": line.limits.model_copy(update={"speed_max_m_per_s": speed_max_m_per_s})})


def with_warning(warning_s: float, line: Line) -> Line:
    return line.model_copy(update={"stages": line.stages.model_copy(update={"start_warning_s": warning_s})})


def with_draw(span: int, line: Line) -> Line:
    """No load cell sees `span`."""
    spans = [one.model_copy(update={"control": "draw"}) if i == span else one for i, one in enumerate(line.spans, 1)]
    return line.model_copy(update={"spans": spans, "load_cells": [c for c in line.load_cells if c.span != span]})


def with_rollers_known(share: float, line: Line) -> Line:
    """Radius and friction have so much of their tolerances."""

    def better(parameter: Parameter) -> Parameter:
        return parameter.model_copy(update={"tolerance": share * parameter.tolerance})

    rollers = [
        roller.model_copy(
            update={
                "radius_m": better(roller.radius_m),
                "friction_nms_per_rad": better(roller.friction_nms_per_rad),
            }
        )
        for roller in line.rollers
    ]
    return line.model_copy(update={"rollers": rollers})


FAST = with_speed(1.0, demo_line(N))  #: its slack takes less of a test's time


class Started:
    """A line in stepped time, and the greatest that its rollers have done."""

    def __init__(self, line: Line = FAST, plant: Plant | None = None, law: str = "lqi", seed: int = 1) -> None:
        self.line = line
        slow = with_speed(demo_line(1).limits.speed_max_m_per_s, line)  # that its drives can keep
        self.loop = SteppedLoop(line, LAWS[law](task_of(slow)), plant or real_plant(line.n), seed)
        self.world = self.loop.truth.world
        self.fastest_m_per_s = 0.0

    @property
    def phase(self) -> Phase:
        return self.loop.cycle.machine.phase

    @property
    def reason(self) -> str:
        return self.loop.cycle.machine.reason

    def step_until(self, met: Callable[[], bool], within_s: float) -> None:
        for _ in range(round(within_s / self.line.control.period_s)):
            if met():
                return
            self.loop.step()
            self.fastest_m_per_s = max(self.fastest_m_per_s, float(np.abs(self.world.surface_speed_m_per_s).max()))
        assert met(), f"{self.phase.name}: {self.reason}"

    def arm(self) -> "Started":
        self.loop.step(5)
        reply = self.loop.arm()
        assert reply.ok, reply.reasons
        self.step_until(lambda: self.phase is Phase.READY, 1.0)
        return self

    def start(self) -> "Started":
        reply = self.loop.command(Start())
        assert reply.ok, reply.reasons
        return self

    def end_of_tensioning(self) -> Phase:
        over = (Phase.RUNNING, Phase.OFF)
        self.step_until(lambda: self.phase in over, longest_tensioning_s(self.line) + STOPPED_WITHIN_S)
        return self.phase


def without_web(*spans: int, line: Line = FAST, law: str = "lqi") -> Started:
    started = Started(line, law=law)
    for span in spans:
        started.world.break_web(span)
    return started.arm().start()


def slack_used_up_s(line: Line) -> float:
    """Of the first span, at the speed that is aimed at, with what its roller's radius leaves open; from a start on."""
    limits = tensioning_limits(line)
    way_m = float(limits.slack_m[0] / (1.0 - limits.unsure[1]))
    return line.stages.start_warning_s + way_m / (AIM_SHARE * limits.speed_m_per_s)


@pytest.mark.parametrize("law", ["lqi", "pid"])
def test_without_any_web_no_roller_is_fast_and_the_first_span_is_named(law: str) -> None:
    line = with_speed(10.0, demo_line(N))
    started = without_web(1, 2, 3, line=line, law=law)
    began_s = started.loop.now_s
    assert started.end_of_tensioning() is Phase.OFF
    assert started.fastest_m_per_s <= tensioning_speed_m_per_s(line) <= 0.1, "today: 10 m/s"
    assert started.loop.now_s - began_s < slack_used_up_s(line) + STOPPED_WITHIN_S
    assert "span 1: " in started.reason and "mm taken up, no tension" in started.reason
    assert started.loop.truth.recorder.unsafe_total == 0


@pytest.mark.parametrize("missing", range(1, N + 1))
@pytest.mark.parametrize("law", ["lqi", "pid"])
def test_the_span_of_which_the_web_is_missing_is_named(missing: int, law: str) -> None:
    started = without_web(missing, law=law)
    assert started.end_of_tensioning() is Phase.OFF
    assert f"span {missing}: " in started.reason and started.reason.count("span ") == 1
    assert started.fastest_m_per_s <= tensioning_speed_m_per_s(FAST)
    started.loop.step(20)
    assert not started.world.torque_nm.any()


@pytest.mark.parametrize("slack_m", [0.0, 0.05, 0.2])
@pytest.mark.parametrize("law", ["lqi", "pid"])
def test_slack_is_taken_up_slowly_and_the_line_runs(slack_m: float, law: str) -> None:
    started = Started(law=law)
    if slack_m:
        for span in range(1, N + 1):
            started.world.slacken_web(span, slack_m)
    started.arm().start()
    assert started.end_of_tensioning() is Phase.RUNNING, started.reason
    assert started.fastest_m_per_s <= tensioning_speed_m_per_s(FAST)
    assert not started.loop.alarms and started.loop.truth.recorder.unsafe_total == 0
    started.loop.step(200)
    assert np.abs(started.world.tension_n - FAST.recipes[0].tension_n).max() < 1.5


def test_more_slack_than_may_be_there_is_told_and_not_wound_up() -> None:
    started = Started()
    started.world.slacken_web(2, 0.6)
    started.arm().start()
    assert started.end_of_tensioning() is Phase.OFF
    assert "span 2: " in started.reason


def test_a_realistic_line_starts_without_a_finding() -> None:
    line = demo_line()
    started = Started(line, load_plant("sim_plant/plants/realistic.toml")).arm().start()
    assert started.end_of_tensioning() is Phase.RUNNING, started.reason
    assert started.fastest_m_per_s <= tensioning_speed_m_per_s(line) and not started.loop.alarms


def test_a_web_that_is_tight_needs_no_taking_up() -> None:
    started = Started().arm()
    tension_n = np.array(FAST.recipes[0].tension_n)
    started.world.tension_n[:] = 0.5 * tension_n
    started.start()
    started.step_until(lambda: started.phase is Phase.TENSIONING, 1.0)
    started.loop.step(2)
    assert not started.loop.cycle.stage.taking_up


def test_a_stop_while_slack_is_taken_up_ends_it_at_once() -> None:
    started = Started()
    started.world.slacken_web(1, 0.2)
    started.arm().start()
    started.step_until(lambda: float(started.world.surface_speed_m_per_s.max()) > 0.01, 5.0)
    assert started.loop.command(Stop()).ok
    started.step_until(lambda: started.phase is Phase.OFF, 1.0)
    assert started.fastest_m_per_s <= tensioning_speed_m_per_s(FAST)


def test_a_span_without_a_load_cell_takes_its_slack_up_and_is_named_without_a_web() -> None:
    line = with_rollers_known(0.1, with_draw(2, FAST))
    recipes = [recipe.model_copy(update={"speed_m_per_s": 0.025}) for recipe in line.recipes]  # no roller creeps at it
    line = line.model_copy(update={"recipes": recipes})
    slow = with_speed(0.025, line)  # of the speeds of `FAST` its drives keep few, and friction tells nothing there
    assert not list(estimates_are_bounds(slow)) and not list(breaks_are_seen(line))
    as_in_the_file = load_plant("sim_plant/plants/s_sim.toml").model_copy(update={"spans": line.n})
    healthy, most_n = Started(line, as_in_the_file), 0.0
    healthy.world.slacken_web(2, 0.1)
    healthy.arm().start()
    while healthy.phase not in (Phase.RUNNING, Phase.OFF):
        healthy.loop.step()
        most_n = max(most_n, float(healthy.world.tension_n[1]))
    assert healthy.phase is Phase.RUNNING, healthy.reason
    assert most_n < line.limits.tension_max_n
    missing = Started(line, as_in_the_file)
    missing.world.break_web(2)
    missing.arm().start()
    assert missing.end_of_tensioning() is Phase.OFF
    assert "span 2: " in missing.reason and missing.fastest_m_per_s <= tensioning_speed_m_per_s(line)


def test_a_roller_that_turns_faster_than_tensioning_lets_it_takes_torque_off() -> None:
    started = Started().arm().start()
    started.step_until(lambda: started.phase is Phase.TENSIONING, 1.0)
    started.world.surface_speed_m_per_s[1] = 3.0 * TRIP_FACTOR * tensioning_speed_m_per_s(FAST)
    started.step_until(lambda: started.phase is Phase.OFF, 2.0)


def with_fault(started: Started, text: str) -> None:
    injector_of(started.loop.truth).add(parse_fault(text), started.world.now_s)


def test_nothing_winds_up_against_a_drive_that_gives_nothing_while_slack_is_taken_up() -> None:
    started = Started()
    for span in range(1, N + 1):
        started.world.slacken_web(span, 0.2)
    started.arm().start()
    cycle = started.loop.cycle
    started.step_until(lambda: cycle.stage.taking_up and float(started.world.surface_speed_m_per_s.min()) > 0.01, 5.0)
    with_fault(started, "drive 2 torque-share share=0")
    started.step_until(lambda: bool(cycle.watch.drives.suspected[1]), 1.0)
    held_nm, most_nm = float(cycle.watch.drives.held_nm[1]), 0.0
    while cycle.watch.drives.suspected[1]:
        started.loop.step()
        most_nm = max(most_nm, abs(float(cycle.outputs.torque_nm[1])))
    assert cycle.stage.taking_up and most_nm <= abs(held_nm) * (1.0 + 1e-9)
    assert "torque-not-given" in [finding.rule for _, finding in started.loop.stopped_by]


def test_a_drive_that_is_held_keeps_the_stages_limits() -> None:
    """It may be the one that gives three times what it is asked: its roller turns, and nobody slows it down."""
    started = Started().arm().start()
    started.step_until(lambda: started.phase is Phase.TENSIONING and not started.loop.cycle.stage.taking_up, 20.0)
    path, stage, inputs = started.loop.cycle.torque_path, started.loop.cycle.stage, started.loop.cycle.inputs
    path.held, path.held_nm = np.ones(N, np.bool_), np.full(N, 50.0)
    setpoints = started.loop.cycle.setpoints
    most_nm = stage.limit(path.held_nm, inputs, setpoints.tension_n)
    assert (most_nm < 50.0).all()
    measured = Measured(inputs.tension.value, inputs.speed.value, float(inputs.unwind_speed.value[0]))

    def limit(asked_nm: FloatArray) -> FloatArray:
        return stage.limit(asked_nm, inputs, setpoints.tension_n)

    given_nm, _ = path.control(measured, setpoints, most_nm, FAST.control.period_s, limit)
    assert (given_nm <= most_nm).all()


# Before anything moves


def turning(index: int, speed_m_per_s: float, line: Line = FAST) -> Started:
    """Roller `index`, or the unwinder with 0, is turned by something else than the drive."""
    started = Started(line)
    started.loop.step(5)
    turn(started, index, speed_m_per_s)
    return started


def turn(started: Started, index: int, speed_m_per_s: float) -> None:
    """Not at once: a speed that jumps is not believed."""
    sample, began_s = started.loop.truth.sample, started.loop.now_s
    started.loop.truth.sample = lambda now_s: _turned(
        sample(now_s), index, speed_m_per_s * min(1.0, (now_s - began_s) / 1.0)
    )
    started.loop.step(110)


def test_a_roller_whose_speed_cannot_be_true_is_not_taken_to_stand() -> None:
    started = Started()
    started.loop.step(5)
    sample = started.loop.truth.sample
    started.loop.truth.sample = lambda now_s: _turned(sample(now_s), 2, 0.3)
    started.loop.step(10)
    reply = started.loop.arm()
    assert not reply.ok and [finding.code for finding in reply.findings] == ["roller-speed-unknown"]


def _turned(sample: Sample, index: int, speed_m_per_s: float) -> Sample:
    if index == 0:
        return replace(sample, unwind_speed_m_per_s=speed_m_per_s)
    speed = sample.speed_m_per_s.copy()
    speed[index - 1] += speed_m_per_s
    return replace(sample, speed_m_per_s=speed)


@pytest.mark.parametrize(("index", "code"), [(0, "unwinder-turns"), (1, "roller-turns"), (N, "roller-turns")])
@pytest.mark.parametrize("direction", [1.0, -1.0])
def test_neither_arm_nor_start_is_done_while_something_turns(index: int, code: str, direction: float) -> None:
    speed = direction * 1.5 * turns_m_per_s(FAST)[index]
    reply = turning(index, speed).loop.arm()
    assert not reply.ok and [finding.code for finding in reply.findings] == [code]
    started = Started().arm()
    turn(started, index, speed)
    reply = started.loop.command(Start())
    assert not reply.ok and code in [finding.code for finding in reply.findings] and started.phase is Phase.READY


def test_the_noise_of_an_encoder_is_no_turning() -> None:
    noise = np.random.default_rng(1)
    started = Started(demo_line(N))
    sample, noise_m_per_s = started.loop.truth.sample, 0.1 * turns_m_per_s(started.line)[2]
    started.loop.truth.sample = lambda now_s: _turned(sample(now_s), 2, noise.normal(0.0, noise_m_per_s))
    for _ in range(20):
        started.loop.step(7)
        assert not started.loop.cycle.standstill.turning(started.loop.cycle.inputs, started.loop.now_s)


def test_a_line_that_is_held_is_not_set_in_motion_while_it_is_switched_to_local() -> None:
    started = Started().arm().start()
    assert started.end_of_tensioning() is Phase.RUNNING
    assert started.loop.command(SetSpeed(speed_m_per_s=0.0)).ok
    started.step_until(lambda: started.loop.cycle.setpoints.speed_m_per_s == 0.0, 60.0)
    started.loop.truth.plc.local = True
    started.loop.step(2)
    recipe = SelectRecipe(name=started.line.recipes[0].name)
    for command in (SetSpeed(speed_m_per_s=0.01), recipe):
        reply = started.loop.command(command)
        assert not reply.ok and [finding.code for finding in reply.findings] == ["line-local"]
    assert started.loop.command(SetSpeed(speed_m_per_s=0.0)).ok and started.loop.command(Hold()).ok
    reply = started.loop.command(Start())
    assert not reply.ok and [finding.code for finding in reply.findings] == ["line-local"]
    assert started.phase is Phase.HOLDING
    started.loop.truth.plc.local = False
    started.loop.step(2)
    assert started.loop.command(Start()).ok
    started.step_until(lambda: started.phase is Phase.RUNNING, 5.0)


def standing(warning_s: float = 0.5) -> Started:
    """In RUN with the web tensioned, at a speed of zero that was asked for before its start."""
    started = Started(with_warning(warning_s, FAST)).arm()
    assert started.loop.command(SetSpeed(speed_m_per_s=0.0)).ok
    assert started.start().end_of_tensioning() is Phase.RUNNING
    started.loop.step(2)
    return started


def held(started: Started) -> Started:
    """Held, with a speed to go back to."""
    assert started.loop.command(Hold()).ok and started.loop.command(SetSpeed(speed_m_per_s=0.01)).ok
    started.loop.step(2)
    return started


RECIPE = SelectRecipe(name=FAST.recipes[0].name)
DEPARTURES = {
    "start from hold": lambda started: held(started).loop.command(Start()),
    "speed": lambda started: started.loop.command(SetSpeed(speed_m_per_s=0.01)),
    "recipe": lambda started: started.loop.command(RECIPE),
}


@pytest.mark.parametrize("departure", DEPARTURES)
def test_a_web_that_stands_under_tension_moves_after_a_warning_only(departure: str) -> None:
    started = standing()
    reply = DEPARTURES[departure](started)
    began_s, plc = started.loop.now_s, started.loop.truth.plc
    assert reply.ok and "warning for 0.5 s" in reply.text
    started.loop.step(2)
    assert plc.warning and started.phase is Phase.HOLDING and reply.state == "HOLD"
    assert "the warning lasts" in started.loop.command(Start()).text
    while started.phase is Phase.HOLDING:
        assert started.loop.cycle.outputs.speed_request_m_per_s == 0.0 and plc.warning
        started.loop.step()
    assert started.phase is Phase.RUNNING and started.loop.now_s - began_s >= 0.5
    started.loop.step(20)
    assert not plc.warning and started.loop.cycle.outputs.speed_request_m_per_s > 0.0


def test_what_comes_up_during_the_warning_leaves_the_line_held_and_is_told() -> None:
    started = held(standing())
    assert started.loop.command(Start()).ok
    started.loop.step(5)
    started.loop.truth.plc.local = True
    started.loop.step(2)
    assert started.phase is Phase.HOLDING and not started.loop.cycle.machine.resumes
    assert [finding.rule for _, finding in started.loop.alarms] == ["line-local"]
    assert "not started: " in started.reason
    started.loop.truth.plc.local = False
    started.loop.step(100)
    assert started.phase is Phase.HOLDING and not started.loop.truth.plc.warning
    assert started.loop.command(Start()).ok
    started.step_until(lambda: started.phase is Phase.RUNNING, 1.0)


@pytest.mark.parametrize(("command", "phase"), [(Hold(), Phase.HOLDING), (Stop(), Phase.OFF)])
def test_hold_and_stop_end_the_warning_of_a_line_that_was_to_go_on(command: Hold | Stop, phase: Phase) -> None:
    started = held(standing())
    assert started.loop.command(Start()).ok
    started.loop.step(5)
    assert started.loop.command(command).ok
    started.loop.step(100)
    assert started.phase is phase and not started.loop.truth.plc.warning
    assert started.loop.cycle.outputs.speed_request_m_per_s == 0.0


def test_a_web_that_still_moves_goes_on_without_a_warning() -> None:
    started = standing()
    assert started.loop.command(SetSpeed(speed_m_per_s=0.01)).ok
    started.step_until(lambda: started.loop.cycle.setpoints.speed_m_per_s == 0.01, 3.0)
    assert started.loop.command(Hold()).ok
    started.loop.step(2)
    reply = started.loop.command(Start())
    assert reply.ok and started.phase is Phase.RUNNING and "warning" not in reply.text
    started.loop.step(2)
    assert not started.loop.truth.plc.warning


def test_a_web_that_stands_is_set_in_motion_by_no_step() -> None:
    started = standing()
    reply = started.loop.command(SetSpeed(speed_m_per_s=0.001, step=True))
    assert not reply.ok and [one.code for one in reply.findings] == ["step-from-standstill"]
    assert started.phase is Phase.RUNNING and started.loop.cycle.setpoints.speed_m_per_s == 0.0


def test_a_line_that_is_switched_to_local_while_it_is_tensioned_stops_in_order() -> None:
    started = Started().arm().start()
    started.step_until(lambda: bool(started.loop.cycle.outputs.torque_nm.any()), 1.0)
    assert started.phase is Phase.TENSIONING
    started.loop.truth.plc.local = True
    started.step_until(lambda: started.phase is Phase.OFF, 2.0)
    assert [finding.rule for _, finding in started.loop.stopped_by] == ["line-local"]
    assert "local" in started.reason and not started.loop.cycle.outputs.torque_nm.any()


def test_a_line_that_is_switched_to_local_is_not_started() -> None:
    started = Started().arm()
    started.loop.truth.plc.local = True
    started.loop.step(2)
    reply = started.loop.command(Start())
    assert not reply.ok and [finding.code for finding in reply.findings] == ["line-local"]
    started.loop.truth.plc.local = False
    started.loop.step(2)
    assert started.start().end_of_tensioning() is Phase.RUNNING


def test_a_start_warns_before_anything_moves() -> None:
    started = Started(with_warning(0.5, FAST)).arm()
    plc = started.loop.truth.plc
    assert not plc.warning
    started.start()
    began_s = started.loop.now_s
    started.loop.step(2)
    assert started.phase is Phase.WARNING and started.loop.cycle.machine.state is LoopState.READY
    assert plc.warning and not started.loop.truth.sample(started.loop.now_s).enabled.any()
    assert "the warning lasts" in started.loop.command(Start()).text
    started.step_until(lambda: started.phase is Phase.TENSIONING, 1.0)
    assert started.loop.now_s - began_s >= 0.5
    started.loop.step(2)
    assert not plc.warning
    assert started.end_of_tensioning() is Phase.RUNNING


def test_a_stop_during_the_warning_ends_it() -> None:
    started = Started(with_warning(0.5, FAST)).arm().start()
    started.loop.step(10)
    assert started.loop.command(Stop()).ok
    started.loop.step(100)
    assert started.phase is Phase.OFF and not started.loop.truth.plc.warning
    assert not started.loop.recorded()[-1].torque_nm.any()


@pytest.mark.parametrize("what", ["local", "turning"])
def test_what_comes_up_during_the_warning_keeps_the_line_from_starting(what: str) -> None:
    started = Started(with_warning(1.5, FAST)).arm().start()
    started.loop.step(10)
    if what == "local":
        started.loop.truth.plc.local = True
    else:
        turn(started, 1, 2.0 * turns_m_per_s(FAST)[1])
    started.loop.step(160)  # the warning would be over
    assert started.phase is Phase.READY and not started.loop.truth.plc.warning
    assert "not started: " in started.reason


@pytest.mark.parametrize("wiring", sorted(WIRINGS.keys() - {DEMO}))
def test_warning_and_local_go_over_every_wire(wiring: str) -> None:
    with virtual_line(wiring, seed=1, start_warning_s=0.3) as line:
        cycle, plc = line.cycle, line.truth.plc
        line.step(5)
        assert line.arm().ok
        plc.local = True
        line.step(3)
        refused = line.start()
        assert not refused.ok and [finding.code for finding in refused.findings] == ["line-local"]
        plc.local = False
        line.step(3)
        assert not plc.warning and line.start().ok
        line.step(5)
        assert plc.warning
        assert line.step_until(Phase.TENSIONING, 2.0), cycle.machine.reason
        line.step(3)
        assert not plc.warning
