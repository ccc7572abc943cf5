"""The loop's states in any order of commands, faults, cancellations, cuts and deaths, against a model of them.

After every period it is asked what runs under what. A sequence that breaks an invariant is shrunk by hypothesis. The
invariants, each with the place that asks it:

- What is in service, what would be gone back to, the epoch and what watches are the model's (`_service`).
- An experiment runs only in RUNNING, and only under the configuration and region it was begun under (`_experiment`).
- Nothing is on probation in STOP, nor past its lease (`_probation`).
- In RUNNING and HOLDING the speed aimed at lies within the region of what runs, and the speed asked for does not rise
  beyond it but in a judged experiment (`_speed`).
- There is torque only in phases with torque, and limit, rate and enabling at the drives are kept (`_torque`).
- At rest, with no arming under way and none that came through since, every link is released (`_links`).
- The first exception of a part ends in STOP and never ends the process; only a second one does (`_failures`).
- The disk has what was decided last within a bounded time of being able to (`_disk`).
- What a process finds that starts after a death is what was decided last, or what was under way (`Model.begin_anew`).
- Every command is answered (`teardown`), every epoch used once (`Model.carried_out`).
"""

import asyncio
import shutil
import tempfile
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, initialize, precondition, rule

from gateway.control.design import design_lqg, design_lqr, design_mpc, design_pid, task_of
from gateway.core.controller import config_hash
from gateway.core.deployment import Deployment, RecoveryPrediction, Region
from gateway.core.experiment import Abort, Experiment, Leg
from gateway.core.messages import (
    AbortExperiment,
    Arm,
    Command,
    Deploy,
    Hold,
    Keep,
    Narrow,
    Renew,
    Reply,
    Rollback,
    RunExperiment,
    SelectRecipe,
    SetSpeed,
    SetTension,
    Start,
    Stop,
    WatchGood,
)
from gateway.core.states import Phase
from gateway.core.theta import nominal_theta
from gateway.loop.kept import FILE, Kept
from safety.recovery_prediction import recovery_prediction
from tests.closed_loop.loop_invariants import FOLLOWS_AGAIN_PERIODS, Invariants
from tests.closed_loop.loop_model import Model, first_law, runs_of
from tests.closed_loop.loop_world import BREAKABLE, GIVEN, LINE, PARTS, PERIOD_S, Ask, Broken, Life

TASK = task_of(LINE)
LAWS = {
    "given": GIVEN,
    "lqg": design_lqg(TASK),
    "pid": design_pid(TASK),
    "lqr": design_lqr(TASK),
    "mpc": design_mpc(TASK),
}
BY_HASH = {config_hash(config): config for config in LAWS.values()}
REGIONS = (
    Region(),
    Region(speed_max_m_per_s=0.06, tension_step_max_n=3.0, speed_step_max_m_per_s=0.02),
    Region(speed_max_m_per_s=0.04, tension_step_max_n=1.0, speed_step_max_m_per_s=0.005),
)
LEASES_S = (0.05, 0.2, 5.0)
ANSWERED_PERIODS = 400  #: within which every command is answered, arming and slow disks included
RATE_NM = LINE.limits.torque_rate_nm_per_s * PERIOD_S


@cache
def watch_for(hash_: str, kind: str) -> RecoveryPrediction:
    """`kind` "long": with more torques in flight than the line's own file has any room for."""
    theta = nominal_theta(LINE)
    if kind == "long":
        theta = replace(theta, torque_lag_s=0.12)
    return recovery_prediction(theta, BY_HASH[hash_], LINE, [0.03])


def experiment(speed_m_per_s: float | None, amplitude_n: float, duration_s: float) -> Experiment:
    return Experiment(
        format=1, name="try", amplitude_n=[amplitude_n] * LINE.n, dwell_s=0.1,
        legs=[Leg(duration_s=duration_s, speed_m_per_s=speed_m_per_s)],
        abort=Abort(deviation_n=15.0, saturated_share=1.0, reversal_share=1.0),
    )  # fmt: skip


OPERATORS = (
    Start(),
    Hold(),
    AbortExperiment(),
    SetTension(span=1, tension_n=29.0),
    SetTension(span=2, tension_n=34.0),
    SetTension(span=1, tension_n=28.5, step=True),
    SetSpeed(speed_m_per_s=0.035),
    SetSpeed(speed_m_per_s=0.05),
    SetSpeed(speed_m_per_s=0.1),
    SetSpeed(speed_m_per_s=0.032, step=True),
    *(SelectRecipe(name=recipe.name) for recipe in LINE.recipes),
)
periods = st.integers(0, 4)
turns = st.integers(0, 6)
kinds_of_watch = st.sampled_from(["none", "none", "usual", "long", "other"])


class LoopStates(RuleBasedStateMachine):
    """The loop's process on a folder, and what the model says of it."""

    def __init__(self) -> None:
        super().__init__()
        self.folder = Path(tempfile.mkdtemp(prefix="r2r-loop-states-"))
        self.life: Life | None = None
        self.passed = 0  #: periods, of all lives
        self.wrong: AssertionError | None = None  #: what the model has found within a period

    @initialize(production=st.sampled_from([True, True, True, False]))
    def begin(self, production):
        given = first_law(GIVEN, LINE)
        self.model = Model(given, given)
        self._begin_life(production)

    def teardown(self) -> None:
        try:
            if self.life is not None and not self.life.over and not self.life.ending.is_set():
                self._answered()
                self._caught_up()
        finally:
            if self.life is not None:
                self.life.close()
            shutil.rmtree(self.folder)

    # the line's people, and the gateway

    @rule(
        epoch=st.sampled_from([1, 1, 1, 1, 0, 2]),
        name=st.sampled_from(sorted(LAWS)),
        region=st.sampled_from(REGIONS),
        lease_s=st.sampled_from(LEASES_S),
        watch=kinds_of_watch,
        shaped=st.booleans(),
        then=periods,
        after=turns,
    )
    def deploy(self, epoch, name, region, lease_s, watch, shaped, then, after):
        self._order(self._deploy(epoch, name, region, lease_s, watch, shaped), then, after)

    @rule(then=periods, after=turns, off=st.sampled_from([0, 0, 0, 1]), watch=kinds_of_watch)
    def keep(self, then, after, off, watch):
        found = self._watch(self.model.good_if_kept.hash, watch)
        self._order(Keep(epoch=max(self.model.epoch + off, 1), watch=found), then, after)

    @rule(then=periods, after=turns)
    def renew(self, then, after):
        self._order(Renew(epoch=max(self.model.epoch, 1)), then, after)

    @rule(then=periods, after=turns, kind=st.sampled_from(["usual", "long", "other"]))
    def watch_good(self, then, after, kind):
        watch = self._watch(self.model.good.hash, kind)
        assert watch is not None
        self._order(WatchGood(watch=watch), then, after)

    @rule(then=periods, after=turns, region=st.sampled_from(REGIONS[1:]))
    def narrow(self, then, after, region):
        self._order(Narrow(region=region), then, after)

    @rule(then=periods, after=turns)
    def roll_back(self, then, after):
        self._order(Rollback(reason="a person"), then, after)

    @rule(then=periods, after=turns, command=st.sampled_from(OPERATORS))
    def operate(self, then, after, command):
        self._order(command, then, after)

    @rule(then=periods, after=turns, stops=st.integers(1, 2), between=turns)
    def stop(self, then, after, stops, between):
        for _ in range(stops):
            self._order(Stop(), 0, between)
        self._pass(then, after)

    @rule(then=periods, after=turns, prepare=st.sampled_from([0, 0, 3, 8]), release=st.sampled_from([0, 0, 2, 5]))
    def arm(self, then, after, prepare, release):
        self._alive().prepare_periods, self.life.release_periods = prepare, release
        self._order(Arm(), then, after)

    @rule(then=periods, speed=st.sampled_from([None, None, 0.04, 0.1]), step_n=st.sampled_from([0.4, 1.4]),
          judged=st.booleans(), duration_s=st.sampled_from([0.3, 2.0]))  # fmt: skip
    def begin_experiment(self, then, speed, step_n, judged, duration_s):
        proposal = "a" * 64 if judged else None
        self._order(RunExperiment(experiment=experiment(speed, step_n, duration_s), proposal=proposal), then, 3)

    # what seldom comes of the rest, most of which is trouble

    @precondition(lambda self: self.life is not None and self.life.cycle.machine.phase is Phase.RUNNING)
    @rule(
        name=st.sampled_from(["lqg", "mpc"]),
        kept=st.booleans(),
        lease_s=st.sampled_from([0.2, 0.4, 5.0]),
        region=st.sampled_from(REGIONS),
        end=st.sampled_from(["a person", "the law", "time", "nothing"]),
    )
    def an_experiment_under_another_controller(self, name, kept, lease_s, region, end):
        self._mend()
        if self.model.until_s is None:
            self._answer(self._deploy(1, name, region, lease_s, "none", False))
        if kept:
            self._answer(Keep(epoch=max(self.model.epoch, 1)))
        self._answer(RunExperiment(experiment=experiment(None, 0.4, 2.0), proposal="a" * 64))
        match end:
            case "a person":
                self.roll_back(2, 3)
            case "the law":
                self.the_law_fails("raises", 2)
            case "time":
                self._pass(45)
            case _:
                pass

    @rule(before=st.integers(0, 12), between=periods, release=st.sampled_from([2, 5]), after=turns)
    def two_stops_into_an_arming(self, before, between, release, after):
        if not self._alive().runner.at_rest:
            return
        self.arm(before, after, 4, release)
        self._order(Stop(), between, after)
        self._order(Stop(), release + 1, after)
        self._pass(8)

    @rule(slow=st.integers(0, 4), between=periods, refused=st.integers(1, 2))
    def a_rollback_against_a_keep(self, slow, between, refused):
        self._mend()
        if self.model.until_s is None:
            self._answer(self._deploy(1, "pid", REGIONS[0], 5.0, "none", False))
        disk = self._alive().disk
        disk.slow_after = slow
        keep = self._order(Keep(epoch=max(self.model.epoch, 1)), 0, 3)
        self._order(Rollback(reason="a person"), between, 3)
        disk.refused = refused
        while not keep.task.done() and not self._alive().over and self.life.disk is disk:
            self._pass(1)

    # what goes wrong

    @rule(number=st.integers(0, 3), then=periods, after=turns)
    def somebody_goes_away(self, number, then, after):
        asks = [ask for ask in self._alive().asks if not ask.task.done()]
        if asks:
            gone = asks[number % len(asks)]
            gone.task.cancel()
            gone.left = self.passed
        self._pass(then, after)

    @rule(part=st.sampled_from(BREAKABLE), times=st.sampled_from([1, 1, 2]), then=periods)
    def a_part_raises(self, part, times, then):
        self._alive().broken[part] = times
        self._pass(1 + then)

    @rule(how=st.sampled_from(["raises", "nan"]), then=periods)
    def the_law_fails(self, how, then):
        law = self._alive().cycle.configurations.running.law
        ask = law.ask

        def fails(*given):
            law.ask = ask
            if how == "raises":
                raise Broken("no solution")
            decision = ask(*given)
            decision.torque_nm = decision.torque_nm * np.nan
            return decision

        law.ask = fails
        self._pass(1 + then)

    @rule(refused=st.integers(1, 4), passing=st.integers(0, 3))
    def the_disk_refuses(self, refused, passing):
        self._alive()
        self.life.disk.refused, self.life.disk.passing = refused, passing

    @rule(full=st.booleans())
    def the_disk_is_full(self, full):
        self._alive().disk.refused = (1 << 30) if full else 0

    @rule(before=st.sampled_from([0, 1, 4]), after=st.sampled_from([0, 1, 4]))
    def the_disk_is_slow(self, before, after):
        self._alive()
        self.life.disk.slow_before, self.life.disk.slow_after = before, after

    @rule(
        what=st.sampled_from(["blind", "late", "jump", "drive", "permissive", "emergency stop", "mended"]), then=periods
    )
    def the_line_fails(self, what, then):
        life = self._alive()
        truth = life.loop.truth
        match what:
            case "blind":
                life.blind = 12
            case "late":
                life.blind = 1
            case "jump":
                life.jump_n = 40.0
            case "drive":
                truth.take_off(0, life.loop.now_s)
            case "permissive":
                truth.plc.permissive = False
            case "emergency stop":
                truth.plc.emergency_stop = True
            case _:
                truth.plc.permissive, truth.plc.emergency_stop, life.blind = True, False, 0
        self._pass(then)

    @rule(count=st.sampled_from([1, 2, 5, 12, 30, 130]))
    def time_passes(self, count):
        self._pass(count)

    @rule(phase=st.sampled_from([Phase.READY, Phase.RUNNING, Phase.OFF]))
    def the_line_comes_to(self, phase):
        """If it is on its way there."""
        for _ in range(250):
            ways = (Phase.ARMING, Phase.ENABLING, Phase.TENSIONING, Phase.SLOWING, Phase.UNLOADING)
            if self._alive().cycle.machine.phase is phase or self.life.cycle.machine.phase not in ways:
                return
            self._pass(1)

    @rule(production=st.booleans())
    def the_process_is_killed(self, production):
        self._alive()
        self._next_life(production)

    @rule(after=st.integers(0, 4))
    def the_process_will_die_within_a_write(self, after):
        self._alive().disk.dies_after = after

    @rule(wait=st.booleans())
    def the_loop_is_ended(self, wait):
        life = self._alive()
        life.ending.set()
        for _ in range(400 if wait else 1):
            self._pass(1)
            if self.life is not life:
                return

    # one period

    def _pass(self, count: int, after: int = 3) -> None:
        life = self._alive()
        for _ in range(count):
            speed = life.cycle.setpoints.speed_m_per_s
            life.period()
            self._note_under_way()
            self.passed += 1
            if self.wrong is not None:
                raise self.wrong
            if life.over:
                self._next_life(production=False)
                return
            if life.ran and not life.failed:
                self.must_hold.check(speed, self.passed)
        life.turn(after)
        if life.over:
            self._next_life(production=False)

    # lives

    def _on_disk(self):
        path, given = self.folder / FILE, first_law(GIVEN, LINE)
        if not path.exists():
            return Model(given, given).durable
        return runs_of(Kept.model_validate_json(path.read_bytes()).durable)

    def _begin_life(self, production: bool) -> None:
        self.life = Life(self.folder, self._carried_out, self._rolled_back)
        self.must_hold = Invariants(self.life, self.model, self._on_disk)
        try:
            self.model.begin_anew(runs_of(self.life.cycle.configurations.durable))
        except AssertionError:  # nothing that comes later is to be told in its place
            self.life.close()
            self.life = None
            raise
        if production:
            self.life.begin_in_production()
        self._pass(2)

    def _next_life(self, production: bool) -> None:
        life, self.life = self.life, None
        assert life is not None
        if life.task.done():
            self._judge_end(life)
        life.close()
        self._begin_life(production)

    def _judge_end(self, life: Life) -> None:
        error = life.task.exception()
        if error is None:
            assert life.ending.is_set()
            active = [link.name for link in life.links if link.active]
            assert not (life.runner.at_rest and active), f"ended in order with {', '.join(active)} active"
            if life.cycle.account.ran:
                self.model.ends.pop(self.model.durable.key, None)
            return
        assert isinstance(error, Broken), f"the process has ended by {type(error).__name__}: {error}"
        assert len(life.led_to_it) >= 2, f"the first exception, of {life.led_to_it}, has ended the process"
        # A failing link, command, event or frame says nothing of a configuration, nor does a line that has never run.
        of_configuration = life.led_to_it[0] in PARTS and life.cycle.account.ran
        if of_configuration and life.cycle.configurations.probation is None:
            self.model.ends[self.model.durable.key] += 1

    def _alive(self) -> Life:
        assert self.life is not None
        return self.life

    # commands

    def _carried_out(self, command: Command, reply: Reply, now_s: float) -> None:
        self._judged(lambda: self.model.carried_out(command, reply, now_s))

    def _rolled_back(self) -> None:
        self._judged(self.model.rolled_back)

    def _judged(self, judge) -> None:
        """Within the loop, which would take what is raised for a fault of its own."""
        try:
            judge()
        except AssertionError as wrong:
            self.wrong = self.wrong or wrong

    def _note_under_way(self) -> None:
        if self.life is not None:
            self.model.under_way([ask.command for ask in self.life.asks if not ask.answered])

    def _order(self, command: Command, then: int, after: int) -> Ask:
        life = self._alive()
        ask = life.order(command)
        ask.task.add_done_callback(lambda task: self._answer_came(life, command, task))
        self._note_under_way()
        life.turn(after)
        self._pass(then)
        return ask

    def _answer_came(self, life: Life, command: Command, task: asyncio.Task[Reply]) -> None:
        """Whoever has taken something back is told once a loop that starts anew would know it, or that it would not."""
        if life is not self.life or task.cancelled() or not isinstance(command, Rollback | Narrow):
            return
        reply = task.result()
        if reply.ok and "does not know it yet" not in reply.text:
            self.model.settled()

    def _answer(self, command: Command) -> None:
        """Waits for it, a while."""
        life, ask = self._alive(), self._order(command, 0, 3)
        for _ in range(30):
            if ask.task.done() or self.life is not life:
                return
            self._pass(1)

    def _answered(self) -> None:
        life = self._alive()
        life.disk.refused = 0
        life.disk.dies_after = None
        for _ in range(ANSWERED_PERIODS):
            if all(ask.task.done() for ask in life.asks):
                return
            self._pass(1)
            if self.life is not life:
                return
        waiting = [ask.command for ask in life.asks if not ask.task.done()]
        raise AssertionError(f"not answered within {ANSWERED_PERIODS} periods: {waiting}")

    def _caught_up(self) -> None:
        """The disk takes writes again: it comes to what was decided."""
        for _ in range(FOLLOWS_AGAIN_PERIODS):
            life = self._alive()
            if life.over or life.ending.is_set() or self._on_disk() == self.model.durable:
                return
            self._pass(1)
        found = self._on_disk()
        assert found == self.model.durable, f"on the disk {found}; decided {self.model.durable}"

    def _mend(self) -> None:
        """Whatever was going to go wrong does not any more."""
        life = self._alive()
        disk, truth = life.disk, life.loop.truth
        disk.refused, disk.passing, disk.dies_after, disk.slow_before, disk.slow_after = 0, 0, None, 0, 0
        truth.plc.permissive, truth.plc.emergency_stop, life.blind = True, False, 0
        life.broken.clear()

    def _deploy(self, epoch: int, name: str, region: Region, lease_s: float, watch: str, shaped: bool) -> Deploy:
        config, number = LAWS[name], self.model.epoch + epoch
        return Deploy(
            deployment=Deployment(
                controller=config, hash=config_hash(config), epoch=max(number, 1), lease_s=lease_s, region=region,
                shaped_first=shaped, watch=self._watch(self.model.good.hash, watch),
            )
        )  # fmt: skip

    @staticmethod
    def _watch(fallback: str, kind: str) -> RecoveryPrediction | None:
        if kind == "none":
            return None
        if kind == "other":
            fallback = next(hash_ for name, hash_ in HASHES.items() if hash_ != fallback and name != "mpc")
        if fallback == HASHES["mpc"]:
            return None
        return watch_for(fallback, "usual" if kind == "other" else kind)


HASHES = {name: config_hash(config) for name, config in LAWS.items()}
