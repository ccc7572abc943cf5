"""A configuration that nobody has judged, in stepped time: taken off before it tears the web. The recorder judges."""

import numpy as np
import pytest

from gateway.cli.stepped import SteppedLoop
from gateway.control.design import design_lqg, design_lqi, design_pid, task_of
from gateway.core.controller import Controller, config_hash
from gateway.core.deployment import first_region
from gateway.core.messages import Confirmed, Hold, Operating, SelectRecipe, SetSpeed, SetTension, Start, Stop
from gateway.core.signals import Inputs
from gateway.core.states import LoopState, Phase
from gateway.loop.machine import stop
from gateway.loop.process import begin
from safety.tensioning import longest_tensioning_s
from tests.bench.harm_lines import drawn
from tests.bench.harm_runs import configuration, healthy
from tests.closed_loop.conftest import demo_line, real_plant

LINE, PLANT = demo_line(), real_plant()
TENSION_N = np.array([28.0, 36.0, 20.0, 40.0, 24.0, 32.0])
DESIGNS = {"lqi": design_lqi(task_of(LINE)), "lqg": design_lqg(task_of(LINE)), "pid": design_pid(task_of(LINE))}
GAINS = ("gain_state", "gain_integral", "gain_proportional", "gain_derivative")
FACTORS = (-1.0, -3.0, 10.0)
CODES = {"first-diverges", "first-chatters"}
DRAWN = (2, 4, 8, 16)  #: seeds of `harm_lines` whose design is within what its line can give


def scaled(config: Controller, factor: float) -> Controller:
    gains = {name: (factor * np.array(getattr(config, name))).tolist() for name in GAINS if hasattr(config, name)}
    return config.model_copy(update=gains)


def one_sign(config: Controller, roller: int) -> Controller:
    gain = np.array(config.gain_state)
    gain[roller] *= -1.0
    return config.model_copy(update={"gain_state": gain.tolist()})


def started(loop: SteppedLoop) -> SteppedLoop:
    """Armed and started; stepped until it stops, or has run for five seconds."""
    loop.step(3)
    assert loop.arm().ok and loop.step_until(Phase.READY, 2.0)
    assert loop.command(Start()).ok
    for _ in range(round((longest_tensioning_s(loop.line) + 1.0) / loop.line.control.period_s)):
        loop.step()
        if loop.cycle.machine.phase is Phase.RUNNING or loop.cycle.machine.state is LoopState.STOP:
            break
    loop.step(round(5.0 / loop.line.control.period_s))
    return loop


def producing(config: Controller) -> SteppedLoop:
    loop = SteppedLoop(LINE, config, PLANT, 3)
    loop.begin_in_production(TENSION_N, 0.02)
    loop.step(200)
    return loop


def assert_taken_off(loop: SteppedLoop) -> None:
    cycle, recorder = loop.cycle, loop.truth.recorder
    assert loop.stopped_by[0][1].rule in CODES, loop.stopped_by[:2]
    assert recorder.unsafe_total == 0, recorder.unsafe_events
    assert cycle.machine.state is LoopState.STOP and not loop.truth.world.torque_nm.any()


@pytest.mark.parametrize("factor", FACTORS)
@pytest.mark.parametrize("law", ["lqi", "lqg", "pid"])
def test_wrong_gains_are_taken_off_while_the_web_is_tensioned(law: str, factor: float) -> None:
    loop = started(SteppedLoop(LINE, scaled(DESIGNS[law], factor), PLANT, 1))
    if law == "pid" and factor > 0.0 and loop.cycle.machine.phase is Phase.RUNNING:
        assert loop.truth.recorder.unsafe_total == 0  # ten times as much of it is no fault on this line
        return
    assert_taken_off(loop)
    assert loop.truth.recorder.recording().tension_n.max() < LINE.limits.tension_max_n


@pytest.mark.parametrize("factor", FACTORS)
@pytest.mark.parametrize("law", ["lqi", "lqg"])
def test_wrong_gains_are_taken_off_in_production_before_a_tension_leaves_its_band(law: str, factor: float) -> None:
    loop = producing(scaled(DESIGNS[law], factor))
    assert_taken_off(loop)
    assert loop.truth.recorder.recording().tension_n.max() < LINE.limits.tension_max_n


@pytest.mark.parametrize("roller", range(LINE.n))
def test_one_roller_with_the_wrong_sign_is_enough(roller: int) -> None:
    assert_taken_off(producing(one_sign(DESIGNS["lqi"], roller)))


@pytest.mark.parametrize("seed", DRAWN)
@pytest.mark.parametrize("factor", FACTORS)
def test_on_lines_of_every_size_wrong_gains_tear_nothing_while_the_web_is_tensioned(seed: int, factor: float) -> None:
    found = drawn(seed)
    loop = started(SteppedLoop(found.line, scaled(configuration(seed), factor), found.plant, seed))
    assert loop.truth.recorder.unsafe_total == 0, (loop.stopped_by[:2], loop.truth.recorder.unsafe_events)
    if factor < 0.0:
        assert_taken_off(loop)
    assert loop.truth.recorder.recording().tension_n.max() < found.line.limits.tension_max_n


@pytest.mark.parametrize("law", DESIGNS)
def test_a_good_one_gives_no_finding(law: str) -> None:
    loop = started(SteppedLoop(LINE, DESIGNS[law], PLANT, 1))
    assert loop.cycle.machine.phase is Phase.RUNNING and not loop.alarms and not loop.stopped_by


@pytest.mark.parametrize("seed", DRAWN)
def test_nor_does_a_good_one_on_lines_of_every_size(seed: int) -> None:
    found = healthy("healthy", seed)
    assert not found.code and not found.unsafe, found


def test_what_a_person_has_confirmed_is_guarded_as_a_first_one_no_more() -> None:
    loop = producing(DESIGNS["lqi"])
    here = config_hash(DESIGNS["lqi"])
    assert not loop.cycle.configurations.in_service(loop.now_s).confirmed
    assert not loop.command(Confirmed(configuration="0" * 64)).ok
    reply = loop.command(Confirmed(configuration=here))
    assert reply.ok and reply.in_service is not None and reply.in_service.confirmed
    assert loop.command(Confirmed(configuration=here)).ok  # again, as after a gateway's start
    assert loop.cycle.configurations.good is loop.cycle.configurations.running


def shown(loop: SteppedLoop) -> tuple[bool, bool]:
    """Whether what runs has followed a move of a tension and a change of the speed."""
    found = loop.cycle.in_service()
    return found.tension_moved, found.speed_changed


def told(loop: SteppedLoop, *commands: Operating) -> SteppedLoop:
    """One after the other, with three seconds after each."""
    for command in commands:
        assert loop.command(command).ok
        loop.step(round(3.0 / loop.line.control.period_s))
    return loop


MOVE, SPEED = SetTension(span=2, tension_n=39.0), SetSpeed(speed_m_per_s=0.007)


@pytest.mark.parametrize("shape", ["ramp", "minimum-jerk"])
def test_a_move_and_a_change_of_speed_are_seen_once_they_have_come_to_their_end(shape: str) -> None:
    line = LINE.model_copy(update={"moves": LINE.moves.model_copy(update={"shape": shape})})
    loop = started(SteppedLoop(line, DESIGNS["lqi"], PLANT, 1))
    assert shown(loop) == (False, False)  # by the tensioning of the web and the first ramp
    told(loop, SetTension(span=2, tension_n=36.4), SetSpeed(speed_m_per_s=0.0095), Hold(), Start())
    assert shown(loop) == (False, False)  # nor by what noise would hide, nor by a hold
    assert loop.command(MOVE).ok
    loop.step(20)
    assert shown(loop) == (False, False)  # it is on its way
    loop.step(300)
    assert shown(loop) == (True, False)
    told(loop, SPEED)
    assert shown(loop) == (True, True)
    told(loop, Stop())  # a person's: what has been seen was seen
    assert loop.cycle.machine.state is LoopState.STOP and shown(loop) == (True, True)


def test_a_step_is_a_move_and_a_recipe_is_both() -> None:
    other = {"name": "b", "speed_m_per_s": 0.015, "tension_n": (TENSION_N + [3.0, 0.0, 0.0, 0.0, 0.0, 0.0]).tolist()}
    line = LINE.model_copy(update={"recipes": [*LINE.recipes, LINE.recipes[0].model_copy(update=other)]})
    loop = started(SteppedLoop(line, DESIGNS["lqi"], PLANT, 1))
    told(loop, SetTension(span=2, tension_n=39.0, step=True))
    assert shown(loop) == (True, False)
    loop = told(started(SteppedLoop(line, DESIGNS["lqi"], PLANT, 1)), SelectRecipe(name="b"))
    assert shown(loop) == (True, True)


def test_a_stop_before_both_were_seen_begins_anew_and_so_does_whatever_stops_the_line_by_itself() -> None:
    loop = told(started(SteppedLoop(LINE, DESIGNS["lqi"], PLANT, 1)), MOVE, Stop())
    assert loop.cycle.machine.phase is Phase.OFF and shown(loop) == (False, False)
    told(started(loop), SPEED)
    assert shown(loop) == (False, True)
    told(loop, SetTension(span=2, tension_n=36.0))
    assert shown(loop) == (True, True)
    told(loop, Stop())
    assert loop.arm().ok
    loop.cycle.change(stop(loop.cycle.machine, loop.now_s, "a drive does not become ready"))
    loop.step(10)
    assert loop.cycle.machine.state is LoopState.STOP and shown(loop) == (True, True)  # it led nothing
    started(loop)
    loop.cycle.change(stop(loop.cycle.machine, loop.now_s, "the line PLC does not answer"))
    loop.step(300)
    assert loop.cycle.machine.state is LoopState.STOP and shown(loop) == (False, False)


def test_a_set_point_that_what_is_measured_does_not_follow_shows_nothing() -> None:
    loop = started(SteppedLoop(LINE, DESIGNS["lqi"], PLANT, 1))
    cycle = loop.cycle
    stuck = cycle.inputs.tension.value.copy()
    trial, inputs = cycle.configurations.trial, Inputs(LINE.n)
    inputs.tension.value[:], inputs.unwind_speed.value[:] = stuck, cycle.setpoints.speed_m_per_s
    cycle.setpoints.step_tension(1, 39.0, loop.now_s)
    for _ in range(1000):
        trial.step(cycle.machine, inputs, usable=True)
    assert shown(loop) == (False, False)


def test_what_a_loop_is_given_goes_no_further_than_a_first_configuration() -> None:
    line = LINE.model_copy(update={"recipes": [LINE.recipes[0].model_copy(update={"speed_m_per_s": 0.1})]})
    loop = SteppedLoop(line, DESIGNS["lqi"], PLANT, 1)
    begin(loop.cycle, None, print)
    assert loop.cycle.configurations.running.region == first_region(line)
    started(loop)
    most = line.gate.first_speed_max_m_per_s
    assert loop.cycle.machine.phase is Phase.RUNNING and loop.cycle.setpoints.speed_target_m_per_s == most
    refused = loop.command(SetSpeed(speed_m_per_s=0.1))
    assert not refused.ok and "judged" in refused.text
