"""A configuration swapped on a line that runs, in stepped time; the recorder at the simulated drives judges."""

import numpy as np
import pytest
from hypothesis import settings
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, initialize, invariant, precondition, rule

from gateway.cli.stepped import SteppedLoop
from gateway.control.design import design_lqg, design_lqi, design_lqr, design_pid, design_scheduled, task_of
from gateway.core.controller import config_hash
from gateway.core.deployment import Deployment, Region
from gateway.core.doubts import Doubt
from gateway.core.experiment import Abort, Experiment, Leg
from gateway.core.messages import (
    AskConfiguration,
    Deploy,
    Hold,
    Keep,
    Renew,
    Rollback,
    RunExperiment,
    SelectRecipe,
    SetSpeed,
    SetTension,
    Stop,
    WatchGood,
)
from gateway.core.states import LoopState, Phase
from gateway.core.theta import nominal_theta
from safety.recovery_prediction import recovery_prediction
from tests.closed_loop.conftest import demo_line, real_plant

TENSION_N = np.array([28.0, 36.0, 20.0, 40.0, 24.0, 32.0])
LINE = demo_line()
TASK = task_of(LINE)
GOOD = design_lqi(TASK)
LAWS = {
    "pid": design_pid(TASK),
    "lqg": design_lqg(TASK),
    "lqr": design_lqr(TASK),
    "scheduled": design_scheduled(TASK, design_lqi, [0.02, 0.1]),
}
CANDIDATE = LAWS["lqg"]


def on_ramps(line):
    return line.model_copy(update={"moves": line.moves.model_copy(update={"shape": "ramp"})})


def producing(config=GOOD, speed_m_per_s=0.05, seed=1, line=LINE):
    loop = SteppedLoop(line, config, real_plant(), seed)
    loop.begin_in_production(TENSION_N, speed_m_per_s)
    loop.step(30)
    return loop


def deployment(config=CANDIDATE, **changes):
    given = {"controller": config, "hash": config_hash(config), "epoch": 1, "lease_s": 2.0}
    return Deploy(deployment=Deployment(**(given | changes)))


def in_service(loop):
    return loop.command(AskConfiguration()).in_service


def rates(loop):
    """Largest change of the torque at a drive from one command to the next, and what is allowed, in Nm."""
    torque_nm = np.array([event["commanded_nm"] for event in loop.truth.recorder.recording().of_kind("torques")])
    return np.abs(np.diff(torque_nm, axis=0)).max(axis=1)


@pytest.mark.parametrize("name", LAWS)
def test_a_swap_is_without_a_jump_and_the_lease_ends_it_within_a_period(name):
    loop = producing()
    before_nm = loop.cycle.outputs.torque_nm.copy()
    reply = loop.command(deployment(LAWS[name]))
    assert reply.ok and reply.in_service.hash == config_hash(LAWS[name]), reply
    assert reply.in_service.on_probation and reply.in_service.last_known_good == config_hash(GOOD)
    deployed_s = loop.now_s
    loop.step()
    assert np.abs(loop.cycle.outputs.torque_nm - before_nm).max() < 0.5
    while in_service(loop).on_probation:
        before_nm = loop.cycle.outputs.torque_nm.copy()
        loop.step()
        assert loop.now_s < 3.0
    assert np.abs(loop.cycle.outputs.torque_nm - before_nm).max() < 0.5
    assert loop.now_s - deployed_s == pytest.approx(2.0 + LINE.control.period_s, abs=0.0101)
    assert in_service(loop).hash == config_hash(GOOD)
    assert "lease" in in_service(loop).why
    loop.step(100)
    assert rates(loop).max() <= LINE.limits.torque_rate_nm_per_s * LINE.control.period_s * (1.0 + 1e-9)
    assert loop.truth.recorder.unsafe_total == 0
    assert np.abs(loop.truth.recorder.recording().tension_n - TENSION_N).max() < 4.0
    kinds = [kind for kind, _ in loop.told]
    assert kinds == ["deployed", "rolled-back"]


def test_a_rollback_reaches_the_drives_with_the_very_next_command():
    """From the period of the trigger on, torques are those of a line that the good one has taken over."""
    loop = producing()
    assert loop.command(deployment()).ok
    loop.step(20)
    asked_by = []
    good, candidate = loop.cycle.configurations.good.law, loop.cycle.configurations.running.law
    for law, name in ((good, "good"), (candidate, "candidate")):
        original = law.ask
        law.ask = lambda *a, _original=original, _name=name: asked_by.append(_name) or _original(*a)
    loop.step()
    assert set(asked_by) == {"candidate"}
    assert loop.command(Rollback(reason="worse than before")).ok
    asked_by.clear()
    loop.step()
    assert set(asked_by) == {"good"}
    assert in_service(loop).why == "rolled back: worse than before"
    last = loop.truth.recorder.recording().of_kind("torques")[-1]
    loop.step()
    assert loop.truth.recorder.recording().of_kind("torques")[-1]["time_s"] > last["time_s"]


def test_a_renewed_lease_goes_on_and_keep_ends_probation():
    loop = producing()
    assert loop.command(deployment(lease_s=0.2)).ok
    for _ in range(10):
        loop.step(15)
        assert loop.command(Renew(epoch=1)).ok
    assert loop.command(Keep(epoch=1)).ok
    loop.step(100)
    found = in_service(loop)
    assert found.hash == found.last_known_good == config_hash(CANDIDATE)
    assert (found.on_probation, found.why, found.lease_left_s, found.epoch) == (False, "kept", None, 1)
    assert loop.command(Rollback(reason="again")).ok  # idempotent: what is good runs already
    assert in_service(loop).hash == config_hash(CANDIDATE)
    assert not loop.command(Renew(epoch=1)).ok


@pytest.mark.parametrize("broken", ["nan", "raises"])
def test_a_law_that_fails_on_probation_gives_way_in_the_same_period(broken):
    loop = producing()
    assert loop.command(deployment()).ok
    loop.step(5)
    law = loop.cycle.configurations.running.law

    def fails(*given):
        if broken == "raises":
            raise ValueError("no solution")
        decision = original(*given)
        decision.torque_nm = decision.torque_nm * np.nan
        return decision

    original, law.ask = law.ask, fails
    loop.step()
    assert loop.cycle.machine.phase is Phase.RUNNING
    assert in_service(loop).hash == config_hash(GOOD)
    loop.step(100)
    assert loop.truth.recorder.unsafe_total == 0 and loop.cycle.machine.phase is Phase.RUNNING


def test_a_stop_is_made_by_the_last_known_good():
    loop = producing()
    assert loop.command(deployment()).ok
    loop.step(5)
    assert loop.command(Stop()).ok
    assert in_service(loop).hash == config_hash(GOOD) and "stop" in in_service(loop).why
    assert loop.step_until(Phase.OFF, 12.0)
    assert loop.truth.recorder.unsafe_total == 0


def codes(reply):
    return [one.code for one in reply.findings]


def moving(loop):
    assert loop.command(SetTension(span=1, tension_n=33.0)).ok
    loop.step(5)


@pytest.mark.parametrize(
    ("prepare", "changes", "code"),
    [
        (lambda loop: None, {"epoch": 2}, "epoch-not-next"),
        (lambda loop: None, {"hash": "0" * 64}, "configuration-altered"),
        (lambda loop: None, {"controller": design_lqi(task_of(demo_line(2)))}, "configuration-misfit"),
        (lambda loop: None, {"controller": GOOD.model_copy(update={"period_s": 0.02})}, "configuration-misfit"),
        (lambda loop: None, {"controller": GOOD.model_copy(update={"latency_s": 0.0})}, "configuration-misfit"),
        (moving, {}, "setpoints-move"),
        (lambda loop: loop.command(Stop()), {}, "no-change-now"),
        (lambda loop: loop.command(deployment()), {"epoch": 2}, "on-probation"),
        (lambda loop: setattr(loop.cycle.watch, "doubts", Doubt.CELL_DRIFTS), {}, "doubt-cell-drifts"),
        (lambda loop: setattr(loop.cycle.account, "held", 1), {}, "signals-held"),
        (lambda loop: None, {"region": Region(speed_max_m_per_s=0.04)}, "line-too-fast"),
    ],
)
def test_a_deployment_that_must_not_be_is_refused_and_nothing_changes(prepare, changes, code):
    loop = producing()
    prepare(loop)
    before = in_service(loop)
    if "controller" in changes:
        changes = changes | {"hash": config_hash(changes["controller"])}
    reply = loop.command(deployment(**changes))
    assert not reply.ok and code in codes(reply), reply
    assert in_service(loop).hash == before.hash and in_service(loop).epoch == before.epoch


def test_a_watch_for_another_fallback_is_refused():
    loop = producing()
    watch = recovery_prediction(nominal_theta(LINE), CANDIDATE, LINE, [0.05])
    reply = loop.command(deployment(watch=watch))
    assert not reply.ok and codes(reply) == ["prediction-of-another-fallback"]
    loop.command(deployment())
    reply = loop.command(Keep(epoch=1, watch=recovery_prediction(nominal_theta(LINE), GOOD, LINE, [0.05])))
    assert not reply.ok and in_service(loop).on_probation


def test_what_is_good_is_watched_by_a_model_that_is_accepted_later():
    loop = producing()
    watch = recovery_prediction(nominal_theta(LINE), GOOD, LINE, [0.05])
    assert not in_service(loop).watched
    other = loop.command(WatchGood(watch=recovery_prediction(nominal_theta(LINE), CANDIDATE, LINE, [0.05])))
    assert not other.ok and codes(other) == ["prediction-of-another-fallback"]
    reply = loop.command(WatchGood(watch=watch))
    assert reply.ok and reply.in_service.watched and reply.in_service.hash == config_hash(GOOD), reply
    loop.step(100)
    assert loop.cycle.machine.phase is Phase.RUNNING
    assert loop.command(deployment()).ok
    refused = loop.command(WatchGood(watch=watch))
    assert not refused.ok and codes(refused) == ["on-probation"]
    assert loop.command(Rollback(reason="a test")).ok and in_service(loop).watched


def test_what_was_not_judged_is_refused_with_what_lifts_it():
    loop = producing()
    region = Region(speed_max_m_per_s=0.08, tension_step_max_n=3.0, speed_step_max_m_per_s=0.01)
    assert loop.command(deployment(region=region, lease_s=60.0)).ok
    assert codes(loop.command(SetTension(span=1, tension_n=30.0, step=True))) == ["step-on-probation"]
    assert loop.command(Keep(epoch=1)).ok
    faster = loop.command(SetSpeed(speed_m_per_s=0.1))
    assert codes(faster) == ["speed-unjudged"] and faster.findings[0].parameters["allowed_m_per_s"] == 0.08
    recipe = loop.command(SelectRecipe(name="velocity"))
    assert codes(recipe) == ["speed-unjudged"] or loop.command(SetSpeed(speed_m_per_s=0.08)).ok
    large = loop.command(SetTension(span=1, tension_n=34.0, step=True))
    assert codes(large) == ["step-too-large-tension"] and large.findings[0].parameters["allowed_n"] == 3.0
    assert loop.command(SetTension(span=1, tension_n=30.0, step=True)).ok
    sudden = loop.command(SetSpeed(speed_m_per_s=0.02, step=True))
    assert codes(sudden) == ["step-too-large-speed"] and sudden.findings[0].parameters["allowed_m_per_s"] == 0.01


def test_an_experiment_with_a_verdict_of_its_own_may_leave_the_region_but_not_on_probation():
    loop = producing()
    faster = Experiment(
        format=1, amplitude_n=[1.0] * LINE.n, dwell_s=0.1, legs=[Leg(duration_s=1.5, speed_m_per_s=0.08)],
        abort=Abort(deviation_n=10.0),
    )  # fmt: skip
    judged, unjudged = RunExperiment(experiment=faster, proposal="a" * 64), RunExperiment(experiment=faster)
    assert loop.command(deployment(region=Region(speed_max_m_per_s=0.06), lease_s=60.0)).ok
    assert codes(loop.command(judged)) == ["on-probation"]
    assert loop.command(Keep(epoch=1)).ok
    assert codes(loop.command(unjudged)) == ["leg-unjudged"]
    assert loop.command(judged).ok
    loop.step(140)
    assert loop.truth.world.unwind_speed_m_per_s == pytest.approx(0.08)
    loop.step(200)
    assert loop.truth.world.unwind_speed_m_per_s == pytest.approx(0.05)


def test_on_probation_set_points_move_along_curves_and_afterwards_on_ramps_again():
    loop = producing(line=on_ramps(LINE))
    assert loop.command(deployment(lease_s=60.0)).ok
    assert loop.command(SetTension(span=1, tension_n=34.0)).ok
    seen = []
    for _ in range(150):
        loop.step()
        seen.append(loop.cycle.setpoints.tension_n[0])
    moves = np.diff([28.0, *seen])
    assert seen[-1] == 34.0 and moves[0] < 0.1 * moves.max()  # it begins slowly; a ramp would not
    assert moves.max() <= LINE.moves.tension_rate_n_per_s * LINE.control.period_s * (1 + 1e-9)
    assert loop.command(Keep(epoch=1)).ok
    loop.step()
    assert loop.command(SetTension(span=1, tension_n=28.0)).ok
    loop.step(2)
    assert loop.cycle.setpoints.tension_n[0] == pytest.approx(34.0 - 2 * 0.2)
    loop.step(100)
    assert loop.truth.recorder.unsafe_total == 0


def test_a_rollback_slows_down_to_what_the_last_known_good_was_judged_for():
    loop = producing()
    assert loop.command(deployment(region=Region(speed_max_m_per_s=0.06))).ok and loop.command(Keep(epoch=1)).ok
    assert loop.command(deployment(LAWS["pid"], epoch=2, region=Region(speed_max_m_per_s=0.1))).ok
    assert loop.command(SetSpeed(speed_m_per_s=0.1)).ok
    loop.step(150)
    loop.command(Rollback(reason="enough"))
    loop.step(200)
    assert loop.truth.world.unwind_speed_m_per_s == pytest.approx(0.06)


def test_a_silent_line_takes_a_deployment_and_starts_with_it():
    loop = SteppedLoop(LINE, GOOD, real_plant(), 1)
    loop.step(3)
    assert loop.command(deployment(lease_s=60.0)).ok
    assert loop.arm().ok and loop.step_until(Phase.READY, 1.0)
    assert in_service(loop).on_probation


def test_held_lines_take_one_too():
    loop = producing()
    assert loop.command(Hold()).ok
    loop.step(300)
    assert loop.cycle.machine.state is LoopState.HOLD
    assert loop.command(deployment()).ok
    loop.step(50)
    assert loop.truth.recorder.unsafe_total == 0


class Swaps(RuleBasedStateMachine):
    """Whatever is asked in whatever order: epochs go up one by one, and what is good is only ever what was kept."""

    @initialize()
    def begin(self):
        self.loop = producing(seed=2)
        self.epoch, self.good, self.running = 0, config_hash(GOOD), config_hash(GOOD)
        self.lease_until_s = None

    def _expire(self):
        if self.lease_until_s is not None and self.loop.now_s >= self.lease_until_s - 1e-9:
            self.running, self.lease_until_s = self.good, None

    @rule(name=st.sampled_from(sorted(LAWS)), ahead=st.integers(0, 2), lease_s=st.sampled_from([0.05, 0.2]))
    def deploy(self, name, ahead, lease_s):
        config = LAWS[name]
        loop, may = self.loop, self.lease_until_s is None and ahead == 1 and self.epoch + ahead > 0
        if self.epoch + ahead < 1:
            return
        loop.now_s = loop.periods * LINE.control.period_s
        reply = loop.command(deployment(config, epoch=self.epoch + ahead, lease_s=lease_s))
        assert reply.ok == may, reply
        if may:
            self.epoch += 1
            self.running, self.lease_until_s = config_hash(config), loop.now_s + lease_s

    @rule(off=st.integers(0, 1))
    def keep(self, off):
        reply = self.loop.command(Keep(epoch=self.epoch + off + (self.epoch == 0)))
        assert reply.ok == (self.lease_until_s is not None and off == 0)
        if reply.ok:
            self.good, self.lease_until_s = self.running, None

    @precondition(lambda self: self.lease_until_s is not None)
    @rule()
    def renew(self):
        lease_s = self.loop.cycle.configurations.probation.lease_s
        assert self.loop.command(Renew(epoch=self.epoch)).ok
        self.lease_until_s = self.loop.now_s + lease_s

    @rule()
    def roll_back(self):
        assert self.loop.command(Rollback(reason="asked")).ok
        self.running, self.lease_until_s = self.good, None

    @rule(periods=st.integers(1, 8))
    def time_passes(self, periods):
        for _ in range(periods):
            self.loop.step()
            self._expire()

    @invariant()
    def what_is_in_service_is_what_was_asked_for(self):
        found = in_service(self.loop)
        assert (found.hash, found.last_known_good, found.epoch) == (self.running, self.good, self.epoch)
        assert found.on_probation == (self.lease_until_s is not None)
        assert self.loop.cycle.machine.phase is Phase.RUNNING


TestSwaps = Swaps.TestCase
TestSwaps.settings = settings(max_examples=15, stateful_step_count=15)
