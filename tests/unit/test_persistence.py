"""The loop that starts next runs what was decided last, in whatever order and whichever write fails."""

import asyncio
import threading
from dataclasses import replace

import numpy as np
import pytest

from gateway.cli.stepped import SteppedLoop
from gateway.control.design import design_lqg, design_lqi, design_mpc, design_pid, task_of
from gateway.core.controller import config_hash
from gateway.core.deployment import Deployment, first_region
from gateway.core.messages import Deploy, Keep, Narrow, Rollback, Stop, WatchGood
from gateway.core.theta import nominal_theta
from gateway.loop import persistence, runner
from gateway.loop.deploy import prepare
from gateway.loop.kept import BEFORE, Durable, Kept, Store, fingerprint
from gateway.loop.pacer import Tick
from gateway.loop.persistence import NOT_PERSISTED, PERSISTED
from gateway.loop.runner import MAX_TO_ITS_END, Runner
from safety.recovery_prediction import recovery_prediction
from tests.closed_loop.conftest import demo_line, real_plant
from tests.support.gateway_key import proof_of, store_of

LINE = demo_line()
GIVEN, OTHER, THIRD, PREDICTIVE = (design(task_of(LINE)) for design in (design_lqi, design_pid, design_lqg, design_mpc))
WATCH = recovery_prediction(nominal_theta(LINE), GIVEN, LINE, [0.05])
TENSION_N = np.array([28.0, 36.0, 20.0, 40.0, 24.0, 32.0])


class Disk(Store):
    """Refuses the writes whose numbers, from 1, are in `refused`."""

    def __init__(self, folder):
        super().__init__(folder, GIVEN)
        self.refused, self.asked = set(), 0

    def write(self, durable):
        self.asked += 1
        if self.asked in self.refused:
            raise OSError(28, "No space left on device")
        super().write(durable)


class Story:
    """Commands against periods; every `await` on it runs one more period."""

    def __init__(self, store):
        self.loop = SteppedLoop(LINE, GIVEN, real_plant(), 1)
        self.loop.begin_in_production(TENSION_N, 0.05)
        self.loop.step(5)
        self.store, self.runner = store, Runner(self.loop.cycle, store)

    async def period(self):
        loop = self.loop
        loop.now_s = loop.periods * LINE.control.period_s
        await self.runner.period(Tick(loop.now_s, loop.now_s, 0))
        loop.periods += 1
        await asyncio.sleep(0.001)

    async def ask(self, command):
        answer = asyncio.ensure_future(self.runner.submit(command, proof_of(command, LINE)))
        while not answer.done():
            await self.period()
        return answer.result()

    async def until(self, holds):
        for _ in range(20_000):
            if holds():
                return
            await self.period()
        raise AssertionError("it does not come to that")

    def kinds(self):
        return [kind for kind, _ in self.loop.told]

    def on_disk(self):
        kept = store_of(self.store.path.parent, GIVEN).read(LINE, print)
        return None if kept is None else kept.durable

    def as_decided(self):
        return self.on_disk() == self.loop.cycle.configurations.durable


def told(store, story):
    async def run():
        telling = Story(store)
        try:
            await story(telling)
        finally:
            telling.runner.close()

    asyncio.run(run())


def deploy(epoch=1, controller=OTHER, **changes):
    return Deploy(
        deployment=Deployment(controller=controller, hash=config_hash(controller), epoch=epoch, lease_s=60.0, **changes)
    )


@pytest.fixture(autouse=True)
def again_soon(monkeypatch):
    monkeypatch.setattr(persistence, "AGAIN_S", 0.01)


@pytest.mark.parametrize("refused", [(), (2,), (2, 3, 4)])
def test_a_rollback_while_the_disk_takes_what_is_kept_is_what_the_next_loop_runs(tmp_path, refused):
    """The first write from then on is that of `keep`; what follows puts right what was decided otherwise meanwhile."""

    async def story(it):
        assert (await it.ask(deploy())).ok
        assert not await it.runner.persisted(10.0)
        it.store.refused = {it.store.asked + number for number in refused}
        write = it.store.write

        def taken_back_meanwhile(durable):
            write(durable)
            if durable.controller == OTHER:
                it.loop.cycle.roll_back("it hums")

        it.store.write = taken_back_meanwhile
        reply = await it.ask(Keep(epoch=1, watch=None))
        assert not reply.ok and reply.in_service.hash == config_hash(GIVEN)
        await it.until(it.as_decided)
        assert not await it.runner.persisted(10.0)
        assert it.on_disk().controller == GIVEN
        await it.period()
        assert (NOT_PERSISTED in it.kinds()) == bool(refused)
        assert it.kinds().count(NOT_PERSISTED) == it.kinds().count(PERSISTED)  # told once, and that it is over

    told(Disk(tmp_path), story)


@pytest.mark.parametrize("command", [Keep(epoch=1, watch=None), WatchGood(watch=WATCH)])
def test_where_the_disk_refuses_nothing_is_granted_and_it_is_not_behind(tmp_path, command):
    async def story(it):
        if isinstance(command, Keep):
            assert (await it.ask(deploy())).ok
            assert not await it.runner.persisted(10.0)  # the deployment's own write takes no refusal meant for this
        before = it.loop.cycle.configurations.durable
        it.store.refused = {it.store.asked + 1}
        reply = await it.ask(command)
        assert not reply.ok and "nothing could be kept" in reply.reasons[0]
        assert it.loop.cycle.configurations.durable == before
        await it.until(it.as_decided)

    told(Disk(tmp_path), story)


def predictive_is_kept(it):
    async def steps():
        for command in (deploy(controller=PREDICTIVE), Keep(epoch=1, watch=WATCH)):
            assert (await it.ask(command)).ok
        assert it.on_disk().on_top.controller == PREDICTIVE

    return steps()


@pytest.mark.parametrize("command", [Rollback(reason="it hums"), Narrow(region=first_region(LINE))])
def test_what_is_taken_back_is_on_the_disk_when_it_is_answered(tmp_path, command):
    async def story(it):
        await predictive_is_kept(it)
        await it.ask(command)
        assert it.as_decided()

    told(Disk(tmp_path), story)


def test_an_answer_says_that_the_next_loop_would_not_know(tmp_path, monkeypatch):
    monkeypatch.setattr("gateway.loop.runner.PERSISTED_S", 0.05)

    async def story(it):
        await predictive_is_kept(it)
        it.store.refused = set(range(it.store.asked + 1, it.store.asked + 100_000))
        reply = await it.ask(Rollback(reason="it hums"))
        assert reply.ok and "does not know it yet" in reply.text and "No space left" in reply.text
        it.store.refused = set()
        await it.until(it.as_decided)
        assert not await it.runner.persisted(10.0)
        await it.period()
        assert it.on_disk().on_top is None and PERSISTED in it.kinds()

    told(Disk(tmp_path), story)


def test_a_deployment_that_is_not_made_leaves_what_was_kept_on_top(tmp_path):
    """Its epoch goes to the disk first; a loop that dies between the two goes on with what was in service."""

    async def story(it):
        await predictive_is_kept(it)
        seen = []
        decide = it.runner.cycle.deploy
        it.runner.cycle.deploy = lambda *given: (seen.append(it.on_disk()), decide(*given))
        assert (await it.ask(deploy(2))).ok
        assert (seen[0].epoch, seen[0].on_top.controller) == (2, PREDICTIVE)
        await it.until(it.as_decided)
        assert (it.on_disk().epoch, it.on_disk().on_top) == (2, None)  # on probation: what is good

    told(Disk(tmp_path), story)


@pytest.mark.wires
def test_a_keep_that_is_written_ahead_while_the_loop_ends_is_not_what_the_next_one_runs(tmp_path):
    async def story(it):
        assert (await it.ask(deploy())).ok
        assert not await it.runner.persisted(10.0)
        write, written = it.store.write, threading.Event()

        def hangs(durable):
            if durable.controller == OTHER:
                written.wait(10.0)
            write(durable)

        it.store.write = hangs
        keep = asyncio.ensure_future(it.runner.submit(Keep(epoch=1, watch=None)))
        await it.period()
        await it.runner.end()
        await it.until(lambda: it.runner.at_rest)
        over = asyncio.ensure_future(it.runner.over(10.0))
        await asyncio.sleep(0)
        written.set()
        await over
        assert not (await keep).ok
        assert it.on_disk().controller == GIVEN and it.as_decided()

    told(Disk(tmp_path), story)


def test_beside_the_file_lies_the_good_one_that_was_in_service_before_and_no_other(tmp_path):
    async def story(it):
        before = it.store.path.with_name(BEFORE)
        for epoch, controller in ((1, OTHER), (2, THIRD)):
            assert (await it.ask(deploy(epoch, controller))).ok
            assert (await it.ask(Keep(epoch=epoch, watch=None))).ok
            assert not await it.runner.persisted(10.0)
        assert Kept.model_validate_json(before.read_bytes()).controller == OTHER
        watch = recovery_prediction(nominal_theta(LINE), THIRD, LINE, [0.05])
        assert (await it.ask(WatchGood(watch=watch))).ok
        assert not await it.runner.persisted(10.0)
        assert Kept.model_validate_json(before.read_bytes()).controller == OTHER

    told(Disk(tmp_path), story)


def test_a_model_that_is_refused_at_the_boundary_is_not_on_the_disk(tmp_path):
    async def story(it):
        configurations = it.loop.cycle.configurations
        write = it.store.write

        def somebody_else_deploys(durable):
            write(durable)
            if durable.watch is not None:
                configurations.good = configurations.running = replace(configurations.good, hash="f" * 64)

        it.store.write = somebody_else_deploys
        assert not (await it.ask(WatchGood(watch=WATCH))).ok
        await it.until(lambda: it.on_disk() is not None and it.on_disk().watch is None)

    told(Disk(tmp_path), story)


@pytest.mark.wires
def test_a_keep_that_was_rolled_back_while_it_was_prepared_writes_nothing(tmp_path, monkeypatch):
    """It would write its own watch beside a configuration that this is not for."""
    begun, go_on = threading.Event(), threading.Event()

    def slow(cycle, command):
        found = prepare(cycle, command)
        if isinstance(command, Keep):
            begun.set()
            assert go_on.wait(30.0)
        return found

    async def story():
        told = Story(Disk(tmp_path))
        change = Deployment(controller=OTHER, hash=config_hash(OTHER), epoch=1, lease_s=60.0)
        assert (await told.ask(Deploy(deployment=change))).ok
        await told.until(told.as_decided)
        monkeypatch.setattr(runner, "prepare", slow)
        watch = recovery_prediction(nominal_theta(LINE), OTHER, LINE, [0.05])
        keep = asyncio.ensure_future(told.runner.submit(Keep(epoch=1, watch=watch)))
        await told.until(begun.is_set)
        assert (await told.ask(Rollback(reason="it hums"))).ok
        written, write = [], told.store.write
        monkeypatch.setattr(told.store, "write", lambda durable: written.append(durable) or write(durable))
        go_on.set()
        await told.until(keep.done)
        await told.until(told.as_decided)
        assert not keep.result().ok and not any(durable.watch for durable in written)
        told.runner.close()

    asyncio.run(story())


@pytest.mark.wires
def test_whoever_deploys_and_goes_away_leaves_no_epoch_that_could_be_used_twice(tmp_path, monkeypatch):
    """What was written ahead stays on the disk until it is decided, whoever waits for it."""
    begun, go_on = threading.Event(), threading.Event()

    async def story():
        told = Story(Disk(tmp_path))
        written, write = [], told.store.write

        def slow(durable):
            begun.set()
            assert go_on.wait(30.0)
            write(durable)
            written.append(durable.epoch)

        monkeypatch.setattr(told.store, "write", slow)
        change = Deployment(controller=OTHER, hash=config_hash(OTHER), epoch=1, lease_s=60.0)
        asked = asyncio.ensure_future(told.runner.submit(Deploy(deployment=change)))
        await told.until(begun.is_set)
        await told.period()
        go_on.set()
        for _ in range(10_000):
            if written:
                break
            await asyncio.sleep(0.001)
        for _ in range(5):
            await asyncio.sleep(0)  # it waits for its period
        asked.cancel()
        for _ in range(50):
            await asyncio.sleep(0.001)  # of no period: whoever would write now has the time to
        assert written == [1]
        await told.until(lambda: told.loop.cycle.configurations.epoch == 1)
        await told.until(told.as_decided)
        assert set(written) == {1}
        told.runner.close()

    asyncio.run(story())


def test_what_was_taken_back_is_nothing_to_go_back_to_either(tmp_path):
    """A `keep` that is written ahead and rolled back meanwhile must not come again when the good one ends processes."""
    store = store_of(tmp_path, GIVEN)
    good = Durable(0, GIVEN, first_region(LINE))
    for durable in (good, replace(good, epoch=1), replace(good, epoch=1, controller=OTHER), replace(good, epoch=1)):
        store.write(durable)
    for _ in range(2):
        store.deaths.count(fingerprint(good), "a defect")
    kept = store_of(tmp_path, GIVEN).read(LINE, print)
    assert kept is not None and kept.controller == GIVEN


@pytest.mark.wires
def test_what_waits_for_a_disk_that_hangs_is_bounded_and_a_stop_waits_for_none_of_it(tmp_path):
    hangs, begun = threading.Event(), threading.Event()

    async def story(it):
        def write(_):
            begun.set()
            hangs.wait()

        it.store.write = write
        waiting = [asyncio.ensure_future(it.runner.submit(WatchGood(watch=WATCH))) for _ in range(MAX_TO_ITS_END)]
        await it.until(begun.is_set)
        refused = await it.ask(WatchGood(watch=WATCH))
        assert not refused.ok and "waits for the disk" in refused.text
        for one in waiting[1:]:
            one.cancel()  # whoever gives up makes no room: it is begun all the same
        assert not (await it.ask(WatchGood(watch=WATCH))).ok
        assert (await it.ask(Stop())).ok and not waiting[0].done()
        hangs.set()
        await it.until(waiting[0].done)

    told(Disk(tmp_path), story)
