"""A change of state is heard by all that depends on it: an experiment ends with the law that it was judged under."""

from dataclasses import replace

import pytest

from gateway.control.design import design_lqg, design_mpc, task_of
from gateway.core.controller import config_hash
from gateway.core.deployment import Deployment, Region
from gateway.core.experiment import Abort, Leg
from gateway.core.messages import Deploy, Keep, Rollback, RunExperiment, Stop, WatchGood
from gateway.core.states import Phase
from gateway.core.theta import nominal_theta
from safety.recovery_prediction import recovery_prediction
from tests.closed_loop.conftest import stepped
from tests.closed_loop.test_deploy import GOOD, LINE, deployment, producing
from tests.closed_loop.test_experiment import asked

SLOW = Region(speed_max_m_per_s=0.05, tension_step_max_n=1.0, speed_step_max_m_per_s=0.01)
PREDICTIVE = design_mpc(task_of(LINE))


def on_top_of_a_slow_one():
    """A predictive law that was judged for everything was kept on top of a linear one that was judged for little."""
    loop = producing()
    configurations = loop.cycle.configurations
    configurations.running = configurations.good = replace(configurations.good, region=SLOW)
    change = Deployment(controller=PREDICTIVE, hash=config_hash(PREDICTIVE), epoch=1, lease_s=60.0, shaped_first=False)
    assert loop.command(Deploy(deployment=change)).ok
    loop.step(20)
    watch = recovery_prediction(nominal_theta(LINE), GOOD, LINE, [0.05, 0.08])
    assert loop.command(Keep(epoch=1, watch=watch)).ok
    return loop


def experimenting(loop):
    patient = Abort(deviation_n=30.0, saturated_share=1.0, reversal_share=1.0)
    fast = asked(amplitude_n=[0.6] * 6, legs=[Leg(duration_s=8.0, speed_m_per_s=0.06)], abort=patient)
    reply = loop.command(RunExperiment(experiment=fast, proposal="0" * 64))
    assert reply.ok, reply.reasons
    loop.step(200)
    assert loop.cycle.experiments.run is not None and loop.cycle.setpoints.speed_m_per_s > 0.05
    return loop


def a_person(loop):
    assert loop.command(Rollback(reason="it hums")).ok


def the_monitor(loop):
    """The law that runs asks for what the other one could not mend."""
    law = loop.cycle.torque_path.law
    ask, rest_nm = law.ask, loop.cycle.outputs.torque_nm.copy()

    def wrong(*given):
        decision = ask(*given)
        decision.torque_nm = 3.0 * rest_nm - 2.0 * decision.torque_nm
        return decision

    law.ask = wrong
    loop.step(100)
    law.ask = ask


def a_law_that_fails(loop):
    law = loop.cycle.torque_path.law
    ask = law.ask
    law.ask = lambda *_: 1 / 0
    loop.step()
    law.ask = ask


@pytest.mark.parametrize("taken_back_by", [a_person, the_monitor, a_law_that_fails])
def test_an_experiment_ends_when_what_it_was_judged_under_is_taken_back(taken_back_by):
    loop = experimenting(on_top_of_a_slow_one())
    taken_back_by(loop)
    assert loop.cycle.configurations.running.hash == config_hash(GOOD)
    assert loop.cycle.experiments.run is None
    ended = next(event for event in loop.events if event.kind == "experiment-abort")
    assert "taken back" in ended.data["reason"]
    loop.step(400)
    assert loop.cycle.machine.phase is Phase.RUNNING
    assert loop.cycle.setpoints.speed_m_per_s <= SLOW.speed_max_m_per_s
    assert loop.truth.recorder.unsafe_total == 0


def test_an_experiment_ends_with_the_lease_of_what_it_runs_under():
    loop = producing()
    assert loop.command(deployment(design_lqg(task_of(LINE)), lease_s=1.0, shaped_first=False)).ok
    loop.step(5)
    assert loop.command(RunExperiment(experiment=asked())).ok
    loop.step(200)
    kinds = [kind for kind, _ in loop.told]
    assert loop.cycle.experiments.run is None
    assert kinds[-2:] == ["rolled-back", "experiment-abort"], kinds


def test_a_stop_takes_back_what_is_on_probation_and_ends_the_experiment_once():
    loop = producing()
    assert loop.command(deployment(lease_s=60.0, shaped_first=False)).ok
    assert loop.command(RunExperiment(experiment=asked())).ok
    loop.step(20)
    assert loop.command(Stop()).ok
    kinds = [kind for kind, _ in loop.told]
    assert kinds.count("experiment-abort") == 1 and kinds.count("rolled-back") == 1
    assert loop.cycle.configurations.probation is None


def test_what_was_prepared_for_another_way_back_is_not_taken():
    """Between the preparation and the boundary somebody else's change has come: it is refused, not kept unwatched."""
    loop = producing()
    watch = recovery_prediction(nominal_theta(LINE), GOOD, LINE, [0.05])
    configurations = loop.cycle.configurations
    recovery = loop.cycle.admission.recovery

    def late(*given):
        found = recovery(*given)
        configurations.good = configurations.running = replace(configurations.good, hash="f" * 64)
        return found

    loop.cycle.admission.recovery = late
    reply = loop.command(WatchGood(watch=watch))
    assert not reply.ok and "meanwhile" in reply.reasons[0]
    assert configurations.good.recovery is None


def test_a_lease_that_cannot_be_looked_at_has_ended_also_on_a_line_that_nothing_stops(monkeypatch):
    loop = stepped()
    loop.step(3)
    assert loop.command(deployment(lease_s=60.0)).ok

    def broken(_):
        raise RuntimeError("a defect")

    monkeypatch.setattr(loop.cycle.configurations, "lapsed", broken)
    loop.step(1)
    found = loop.cycle.configurations
    assert loop.cycle.machine.phase is Phase.SILENT
    assert found.probation is None and found.running is found.good
