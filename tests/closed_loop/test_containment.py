"""An exception of what only watches stops the line in order; a second one ends the process; no start repeats it."""

import asyncio
from dataclasses import replace

import numpy as np
import pytest

from drivers.memory import MemoryLink
from gateway.cli.stepped import SteppedLoop
from gateway.control.design import design_lqi, design_mpc, task_of
from gateway.core.deployment import Region
from gateway.core.messages import Arm, AskConfiguration, SetSpeed, WatchGood
from gateway.core.states import LoopState, Phase
from gateway.core.theta import nominal_theta
from gateway.loop import process
from gateway.loop.containment import PART_FAILED
from gateway.loop.kept import SET_ASIDE, Durable, OnTop, fingerprint
from gateway.loop.pacer import Tick
from gateway.loop.runner import Runner
from safety.recovery_prediction import recovery_prediction
from tests.closed_loop.conftest import demo_line, real_plant
from tests.support.gateway_key import proven, store_of

TENSION_N = np.array([28.0, 36.0, 20.0, 40.0, 24.0, 32.0])


def timed(period_s=0.01, latency_s=0.01):
    line = demo_line()
    control = line.control.model_copy(update={"period_s": period_s, "latency_s": latency_s})
    return line.model_copy(update={"control": control})


def producing(line=None, seed=1):
    line = line or demo_line()
    loop = SteppedLoop(line, design_lqi(task_of(line)), real_plant(), seed)
    loop.begin_in_production(TENSION_N, 0.05)
    loop.step(30)
    return loop


def broken(*_, **__):
    raise RuntimeError("a defect")


def at_line(loop, name):
    """Where the part of this name is called."""
    return {
        "monitor": (loop.cycle.guard, "against"),
        "stuck": (loop.cycle.watch, "find_stuck"),
        "jumps": (loop.cycle.watch, "reject_jumps"),
        "drives": (loop.cycle.watch.drives, "compare"),
        "warnings": (loop.cycle.watch.drives, "find_told"),
        "doubts": (loop.cycle.watch, "controlled"),
        "lease": (loop.cycle.configurations, "lapsed"),
        "experiment": (loop.cycle.experiments, "look"),
        "telemetry": (loop.cycle, "_record"),
        "rest": (loop.cycle, "_estimate"),
        "law": (loop.cycle.torque_path.law, "ask"),
        "link": (loop.cycle.links[0], "trigger"),
    }[name]


PARTS = [
    "monitor",
    "stuck",
    "jumps",
    "drives",
    "warnings",
    "doubts",
    "lease",
    "experiment",
    "telemetry",
    "rest",
    "link",
]


@pytest.mark.parametrize("name", PARTS)
def test_the_first_exception_stops_the_line_in_order_and_every_other_part_goes_on(name, monkeypatch):
    loop = producing()
    monkeypatch.setattr(*at_line(loop, name), broken)
    before_nm = loop.cycle.outputs.torque_nm.copy()
    loop.step()
    assert loop.cycle.machine.state is LoopState.STOP
    assert "a defect" in loop.cycle.machine.reason
    fastest = max(loop.line.moves.torque_off_rate_nm_per_s, loop.line.limits.torque_rate_nm_per_s)
    rate_nm = fastest * loop.line.control.period_s
    assert np.abs(loop.cycle.outputs.torque_nm - before_nm).max() <= rate_nm + 1e-9
    assert loop.step_until(Phase.OFF, 30.0)
    assert not loop.cycle.outputs.torque_nm.any()
    assert loop.truth.recorder.unsafe_total == 0


def test_a_second_part_that_fails_in_the_same_run_is_raised(monkeypatch):
    loop = producing()
    monkeypatch.setattr(*at_line(loop, "monitor"), broken)
    loop.step(3)
    monkeypatch.setattr(*at_line(loop, "stuck"), broken)
    with pytest.raises(RuntimeError, match="a defect"):
        loop.step(3)


def test_arming_gives_what_failed_another_chance(monkeypatch):
    loop = producing()
    monkeypatch.setattr(*at_line(loop, "doubts"), broken)
    loop.step(2)
    assert loop.cycle.containment.failed
    assert loop.step_until(Phase.OFF, 30.0)
    loop.step(50)
    assert loop.arm().ok and not loop.cycle.containment.failed


def test_a_command_that_fails_is_answered_and_stops_the_line(monkeypatch):
    async def story():
        loop = producing()
        runner = Runner(loop.cycle)
        monkeypatch.setattr("gateway.loop.runner.carry_out", broken)
        answer = asyncio.ensure_future(runner.submit(SetSpeed(speed_m_per_s=0.06)))
        await asyncio.sleep(0)
        await runner.period(Tick(loop.now_s, loop.now_s, 0))
        reply = await answer
        runner.close()
        assert not reply.ok and "failed" in reply.text
        assert loop.cycle.machine.state is LoopState.STOP

    asyncio.run(story())


@pytest.mark.parametrize(
    ("period_s", "latency_s", "lag_s"),
    [(0.01, 0.01, 0.0), (0.01, 0.01, 0.12), (0.004, 0.06, 0.0), (0.002, 0.004, 0.022)],
)
def test_a_model_by_which_a_torque_acts_late_is_watched_by(period_s, latency_s, lag_s):
    line = timed(period_s, latency_s)
    loop = producing(line)
    theta = replace(nominal_theta(line), torque_lag_s=lag_s)
    reply = loop.command(WatchGood(watch=recovery_prediction(theta, loop.config, line, [0.05])))
    assert reply.ok, reply.reasons
    loop.step(20)
    assert loop.command(AskConfiguration()).in_service.watched
    # Where the model says that nobody could recover the line that late, the line stops in order.
    assert not loop.cycle.containment.failed
    assert loop.cycle.machine.phase is Phase.RUNNING or "would come to" in loop.cycle.machine.reason


class SteppedPacer:
    """Ticks of the loop's own time, and never a wait."""

    def __init__(self, loop):
        self._loop = loop

    async def wait(self):
        await asyncio.sleep(0)
        loop = self._loop
        loop.now_s = loop.periods * loop.line.control.period_s
        loop.periods += 1
        return Tick(loop.now_s, loop.now_s, 0)

    def close(self): ...


def one_life(store, line, monkeypatch, *, breaks):
    """A loop's process from its start on; returns the hash of what it ran and what was said."""
    said = []

    async def story():
        loop = SteppedLoop(line, design_lqi(task_of(line)), real_plant(), 1)
        process.begin(loop.cycle, store.read(line, said.append), said.append)
        loop.begin_in_production(TENSION_N, 0.05)
        runner = Runner(loop.cycle, store)
        monkeypatch.setattr(process, "TimerPacer", lambda period_s: SteppedPacer(loop))
        ending = asyncio.Event()
        for owner, name in [at_line(loop, part) for part in breaks]:
            monkeypatch.setattr(owner, name, broken)
        asyncio.get_running_loop().call_later(0.2, ending.set)
        try:
            await process.run_until(runner, line, ending, store)
        except RuntimeError:
            assert breaks
        finally:
            runner.close()
        return loop.cycle.configurations.running

    return asyncio.run(story()), said


def test_what_has_ended_the_loop_twice_is_set_aside_for_what_ran_before(tmp_path, monkeypatch):
    line = demo_line()
    given = design_lqi(task_of(line))
    watch = recovery_prediction(nominal_theta(line), given, line, [0.05])
    store = store_of(tmp_path, given)
    judged = Region(speed_max_m_per_s=0.08)
    store.write(Durable(3, given, judged))
    store.write(proven(Durable(4, given, judged, watch), line))
    for _ in range(2):
        running, said = one_life(store_of(tmp_path, given), line, monkeypatch, breaks=["doubts", "telemetry"])
        assert running.watch == watch and not said
    running, said = one_life(store_of(tmp_path, given), line, monkeypatch, breaks=[])
    assert running.watch is None and running.region == judged
    assert (tmp_path / SET_ASIDE).exists()
    assert "2 times in a row" in said[0] and "a defect" in said[0]
    kept = store_of(tmp_path, given).read(line, said.append)
    assert (kept.epoch, kept.watch) == (4, None)


def test_what_was_taken_back_in_the_period_that_ends_the_loop_does_not_come_back(tmp_path, monkeypatch):
    """The law on top fails, and then two watchers: what runs next is what it stood on."""
    line = demo_line()
    given, top = design_lqi(task_of(line)), design_mpc(task_of(line))
    on_top = OnTop(controller=top, region=Region())
    store_of(tmp_path, given).write(proven(Durable(3, given, Region(), None, on_top), line))
    running, _ = one_life(
        store_of(tmp_path, given), line, monkeypatch, breaks=["law", "monitor", "doubts", "telemetry"]
    )
    assert running.config == given
    running, _ = one_life(store_of(tmp_path, given), line, monkeypatch, breaks=[])
    assert running.config == given


def test_failing_links_and_commands_say_nothing_of_a_configuration(tmp_path, monkeypatch):
    line = demo_line()
    given = design_lqi(task_of(line))
    store_of(tmp_path, given).write(Durable(3, given, Region()))
    for _ in range(3):
        one_life(store_of(tmp_path, given), line, monkeypatch, breaks=["link", "telemetry"])
    assert not store_of(tmp_path, given).deaths.too_often(fingerprint(Durable(3, given, Region())))


def test_a_loop_that_is_told_to_end_arms_nothing_that_was_proven():
    async def story():
        loop = SteppedLoop(demo_line(), design_lqi(task_of(demo_line())), real_plant(), 1)
        runner = Runner(loop.cycle)
        for _ in range(3):
            loop.now_s = loop.periods * loop.line.control.period_s
            await runner.period(Tick(loop.now_s, loop.now_s, 0))
            loop.periods += 1
        arming = asyncio.ensure_future(runner.submit(Arm()))
        for _ in range(20):  # it is proven, and waits for its period
            await asyncio.sleep(0)
        await runner.end()
        await runner.period(Tick(loop.now_s, loop.now_s, 0))
        assert not (await arming).ok and loop.cycle.machine.phase is Phase.SILENT
        runner.close()

    asyncio.run(story())


def test_the_last_act_reaches_every_link_at_once(monkeypatch):
    """One that takes its time to be released keeps the zero from no other."""

    class Held(MemoryLink):
        async def release(self):
            await asyncio.sleep(0.05)
            others.append(bool(told.count("trigger") >= 2))

        def trigger(self, now_s):
            told.append("trigger")

    async def story():
        loop = producing()
        loop.cycle.links[:] = [Held(loop.line, loop.truth), Held(loop.line, loop.truth)]
        monkeypatch.setattr(process, "TimerPacer", lambda period_s: SteppedPacer(loop))
        runner = Runner(loop.cycle)
        monkeypatch.setattr(runner, "period", broken)
        with pytest.raises(RuntimeError):
            await process.run_until(runner, loop.line, asyncio.Event())
        runner.close()

    told, others = [], []
    asyncio.run(story())
    assert others == [True, True]


def test_an_orderly_end_after_a_run_forgives(tmp_path, monkeypatch):
    line = demo_line()
    given = design_lqi(task_of(line))
    store_of(tmp_path, given).write(Durable(3, given, Region()))
    for breaks in (["doubts", "telemetry"], [], ["doubts", "telemetry"], []):
        running, said = one_life(store_of(tmp_path, given), line, monkeypatch, breaks=breaks)
        assert not said
    assert not (tmp_path / SET_ASIDE).exists()


def test_what_has_failed_in_a_line_that_rests_is_told_as_well(monkeypatch):
    loop = SteppedLoop(demo_line(), design_lqi(task_of(demo_line())), real_plant(), 1)
    monkeypatch.setattr(*at_line(loop, "jumps"), broken)
    loop.step(2)
    assert [finding.rule for _, finding in loop.alarms] == [PART_FAILED]
    assert loop.cycle.machine.state is LoopState.SILENT
