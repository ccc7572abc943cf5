"""Unsafe configurations forced in, in stepped time: the fallback takes over while it still can. The recorder judges."""

import numpy as np
import pytest

from gateway.cli.rehearse_designs import truth_of
from gateway.cli.stepped import SteppedLoop
from gateway.control.design import design_lqg, design_lqi, design_lqr, design_mpc
from gateway.control.design.task import task_on
from gateway.core.controller import config_hash
from gateway.core.deployment import Deployment
from gateway.core.doubts import Doubt
from gateway.core.messages import Deploy, Keep, SetSpeed, SetTension, WatchGood
from gateway.core.states import LoopState, Phase
from gateway.core.theta import Theta
from safety.recovery_prediction import recovery_prediction
from tests.closed_loop.conftest import demo_line, real_plant

TENSION_N = np.array([28.0, 36.0, 20.0, 40.0, 24.0, 32.0])
LINE, PLANT = demo_line(), real_plant()
THETA = Theta(truth_of(PLANT), np.zeros(6), 0.0, LINE.control.latency_s)
TASK = task_on(LINE, THETA)
GOOD, PREDICTIVE = design_lqi(TASK), design_mpc(TASK)


def scaled(config, factor):
    gain = (factor * np.array(config.gain_state)).tolist()
    return config.model_copy(update={"gain_state": gain})


UNSAFE = {
    "sign": scaled(GOOD, -1.0),
    "one sign": scaled(GOOD, np.array([[1.0], [1.0], [-1.0], [1.0], [1.0], [1.0]])),
    "gain": scaled(design_lqg(TASK), 20.0),
    "no feedback of speed": design_lqr(TASK).model_copy(
        update={"gain_state": (np.array(design_lqr(TASK).gain_state) * np.repeat([3.0, -0.2], 6)).tolist()}
    ),
}


def producing(config=GOOD):
    loop = SteppedLoop(LINE, config, PLANT, 3)
    loop.begin_in_production(TENSION_N, 0.05)
    loop.step(20)
    return loop


def watch_for(config=GOOD):
    return recovery_prediction(THETA, config, LINE, [0.01, 0.05, 0.1])


def deploy(loop, config, watch):
    deployment = Deployment(controller=config, hash=config_hash(config), epoch=1, lease_s=60.0, watch=watch)
    assert loop.command(Deploy(deployment=deployment)).ok


def band(loop):
    tension_n = loop.truth.recorder.recording().tension_n
    return tension_n.min(), tension_n.max()


@pytest.mark.parametrize("name", UNSAFE)
def test_an_unsafe_configuration_gives_way_before_a_tension_leaves_its_band(name):
    loop = producing()
    deploy(loop, UNSAFE[name], watch_for())
    loop.step(200)
    lowest, highest = band(loop)
    assert LINE.limits.tension_min_n < lowest and highest < LINE.limits.tension_max_n
    assert loop.cycle.machine.phase is Phase.RUNNING
    assert loop.cycle.configurations.running.hash == config_hash(GOOD)
    assert loop.cycle.configurations.why.startswith("rolled back")
    assert np.abs(loop.truth.world.tension_n - TENSION_N).max() < 3.0


def test_left_to_itself_it_would_have_left_the_band():
    """The same configurations, controlling from the start: what the test above is worth."""
    for config in UNSAFE.values():
        loop = producing(config)
        loop.step(300)
        lowest, highest = band(loop)
        left = lowest < LINE.limits.tension_min_n or highest > LINE.limits.tension_max_n
        # One of them only swings between the torque limits for ever, which wears a line out.
        assert left or loop.cycle.machine.state is LoopState.STOP or loop.cycle.watch.doubts & Doubt.SATURATED


def test_without_an_accepted_model_nothing_is_predicted():
    loop = producing()
    deploy(loop, GOOD, None)
    loop.step(50)
    assert not loop.cycle.configurations.in_service(loop.now_s).watched and not loop.alarms


def push_where_it_should_pull(loop):
    """All of a sudden: something is wrong with the law that no judge saw."""
    law = loop.cycle.torque_path.law
    ask, rest_nm = law.ask, loop.cycle.outputs.torque_nm.copy()

    def wrong(*given):
        decision = ask(*given)
        decision.torque_nm = 2.0 * rest_nm - decision.torque_nm
        return decision

    law.ask = wrong


def test_where_the_last_known_good_itself_would_not_recover_the_line_stops_under_control():
    loop = producing()
    deploy(loop, GOOD, watch_for())
    assert loop.command(Keep(epoch=1, watch=watch_for())).ok
    loop.step(50)
    assert loop.cycle.machine.phase is Phase.RUNNING
    push_where_it_should_pull(loop)
    for _ in range(200):
        loop.step()
        if loop.cycle.machine.state is LoopState.STOP:
            break
    assert loop.cycle.machine.state is LoopState.STOP and loop.stopped_by[0][1].rule == "unrecoverable-tension"
    lowest, highest = band(loop)
    assert LINE.limits.tension_min_n < lowest and highest < LINE.limits.tension_max_n


def test_the_largest_step_of_a_kept_configuration_is_left_alone():
    loop = producing()
    deploy(loop, GOOD, watch_for())
    assert loop.command(Keep(epoch=1, watch=watch_for())).ok
    step_n = LINE.limits.tension_step_max_n
    assert loop.command(SetTension(span=3, tension_n=TENSION_N[2] + step_n, step=True)).ok
    loop.step(250)
    assert loop.cycle.machine.phase is Phase.RUNNING and not loop.alarms


def predictive_kept():
    loop = producing()
    deploy(loop, PREDICTIVE, watch_for())
    other = loop.command(Keep(epoch=1, watch=watch_for(PREDICTIVE)))
    assert not other.ok and "go back to" in other.reasons[0]
    reply = loop.command(Keep(epoch=1, watch=watch_for()))
    assert reply.ok and not reply.in_service.on_probation and reply.in_service.watched
    assert (reply.in_service.hash, reply.in_service.last_known_good) == (config_hash(PREDICTIVE), config_hash(GOOD))
    return loop


def test_predictive_control_is_kept_with_a_linear_law_to_go_back_to_and_makes_the_largest_step():
    loop = predictive_kept()
    step_n = LINE.limits.tension_step_max_n
    assert loop.command(SetTension(span=3, tension_n=TENSION_N[2] + step_n, step=True)).ok
    loop.step(250)
    found = loop.cycle.configurations.in_service(loop.now_s)
    assert loop.cycle.machine.phase is Phase.RUNNING and not loop.alarms and found.hash == config_hash(PREDICTIVE)
    assert loop.command(WatchGood(watch=watch_for())).in_service.hash == config_hash(PREDICTIVE)


def test_where_kept_predictive_control_goes_wrong_the_linear_law_takes_over_and_the_line_goes_on():
    loop = predictive_kept()
    push_where_it_should_pull(loop)
    loop.step(300)
    found = loop.cycle.configurations.in_service(loop.now_s)
    assert loop.cycle.machine.phase is Phase.RUNNING and found.hash == found.last_known_good == config_hash(GOOD)
    assert "would come to" in found.why
    lowest, highest = band(loop)
    assert LINE.limits.tension_min_n < lowest and highest < LINE.limits.tension_max_n


def kept_at(speed_m_per_s, line=LINE):
    loop = SteppedLoop(line, GOOD, PLANT, 3)
    loop.begin_in_production(TENSION_N, speed_m_per_s)
    loop.step(20)
    watch = recovery_prediction(THETA, GOOD, line, [0.01, 0.05, 0.1])
    deploy(loop, GOOD, watch)
    assert loop.command(Keep(epoch=1, watch=watch)).ok
    return loop


def slow_line():
    """Whose rollers give way at 0.102 m/s, and are watched from there on."""
    return LINE.model_copy(update={"limits": LINE.limits.model_copy(update={"speed_max_m_per_s": 0.08})})


def test_a_step_that_makes_a_roller_too_fast_is_refused_and_a_smaller_one_done():
    loop = kept_at(0.08, slow_line())
    large = SetTension(span=3, tension_n=TENSION_N[2] + LINE.limits.tension_step_max_n, step=True)
    refused = loop.command(large)
    assert not refused.ok and [one.code for one in refused.findings] == ["step-unsafe-speed"]
    assert loop.command(large.model_copy(update={"tension_n": TENSION_N[2] + 3.0})).ok
    loop.step(100)
    assert loop.cycle.machine.phase is Phase.RUNNING and not loop.alarms
    assert loop.command(large.model_copy(update={"step": False})).ok
    forced = kept_at(0.08, slow_line())
    forced.cycle.setpoints.step_tension(2, large.tension_n, forced.now_s)
    forced.step(50)
    assert forced.cycle.machine.state is LoopState.STOP and forced.stopped_by[0][1].rule == "unrecoverable-speed"


def test_a_step_of_the_speed_is_foreseen_too():
    loop = kept_at(0.01, slow_line())
    refused = loop.command(SetSpeed(speed_m_per_s=0.08, step=True))
    assert not refused.ok and [one.code for one in refused.findings] == ["step-unsafe-speed"]
    assert loop.command(SetSpeed(speed_m_per_s=0.04, step=True)).ok
    loop.step(100)
    assert loop.cycle.machine.phase is Phase.RUNNING and not loop.alarms


def test_the_papers_step_of_the_speed_is_let_happen():
    loop = kept_at(0.01)
    assert loop.command(SetSpeed(speed_m_per_s=0.1, step=True)).ok
    loop.step(200)
    assert loop.cycle.machine.phase is Phase.RUNNING and not loop.alarms
