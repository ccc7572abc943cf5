"""Commands against periods: a stop goes before everything, into an arming, and into the end of the process."""

import asyncio
from dataclasses import replace

import numpy as np
import pytest

from drivers.memory import MemoryLink
from gateway.control.design import design_lqg, task_of
from gateway.core.controller import config_hash
from gateway.core.deployment import Deployment
from gateway.core.messages import Arm, AskConfiguration, Deploy, Hold, Rollback, SetSpeed, SetTension, Start, Stop
from gateway.core.states import LoopState, Phase
from gateway.loop.machine import Machine
from gateway.loop.pacer import Tick
from gateway.loop.process import run_until
from gateway.loop.runner import MAX_WAITING, Runner
from gateway.loop.wiring import CONTRADICTED, FILE
from safety.actions import Action, found
from tests.closed_loop.conftest import start, stepped
from tests.support.gateway_key import door_of


class Story:
    """A runner whose periods are run by the test."""

    def __init__(self, loop):
        self.loop = loop
        self.runner = Runner(loop.cycle)

    async def periods(self, count):
        for _ in range(count):
            self.loop.now_s = self.loop.periods * self.loop.line.control.period_s
            await self.runner.period(Tick(self.loop.now_s, self.loop.now_s, 0))
            self.loop.periods += 1
            await asyncio.sleep(0)

    async def until(self, answer, most=1000):
        for _ in range(most):
            if answer.done():
                return answer.result()
            await self.periods(1)
        raise AssertionError("no answer")

    def order(self, command):
        return asyncio.ensure_future(self.runner.submit(command))


def test_a_stop_is_taken_however_many_commands_wait():
    async def story():
        told = Story(start(stepped()))
        waiting = [told.order(SetTension(span=1, tension_n=30.0)) for _ in range(MAX_WAITING + 3)]
        stop = told.order(Stop())
        await asyncio.sleep(0)
        await told.periods(1)
        assert (await stop).ok and told.loop.cycle.machine.phase is Phase.SLOWING
        replies = [await answer for answer in waiting]
        assert sum("too many" in reply.text for reply in replies) == 3

    asyncio.run(story())


def test_a_hold_and_what_the_gateway_orders_are_taken_however_many_ask_and_however_often():
    async def story():
        told = Story(start(stepped()))
        asked = [told.order(AskConfiguration()) for _ in range(2 * MAX_WAITING)]
        held = [told.order(Hold()) for _ in range(2 * MAX_WAITING)]
        rollback = told.order(Rollback(reason="a test's"))
        stop = told.order(Stop())
        for _ in range(5):
            await asyncio.sleep(0)
        assert all(answer.done() and answer.result().ok for answer in asked)  # before any period
        assert (await told.until(stop)).ok and told.loop.cycle.machine.phase is Phase.SLOWING
        assert len({(await told.until(answer)).text for answer in held}) == 1
        assert "too many" not in (await told.until(rollback)).text

    asyncio.run(story())


def test_a_hold_goes_before_what_waits_and_a_start_that_waits_does_not_undo_it():
    async def story():
        told = Story(start(stepped()))
        waiting = [told.order(SetTension(span=1, tension_n=30.0)) for _ in range(MAX_WAITING)]
        hold = told.order(Hold())
        await asyncio.sleep(0)
        await told.periods(1)
        assert (await hold).ok and told.loop.cycle.machine.phase is Phase.HOLDING
        for answer in waiting:
            await told.until(answer)
        started, held = told.order(Start()), told.order(Hold())
        assert (await told.until(held)).ok and not (await told.until(started)).ok
        assert told.loop.cycle.machine.phase is Phase.HOLDING
        held, started = told.order(Hold()), told.order(Start())
        assert (await told.until(held)).ok and (await told.until(started)).ok
        assert told.loop.cycle.machine.phase is Phase.RUNNING

    asyncio.run(story())


def test_a_stop_goes_into_an_arming_and_nothing_is_left_half_way(monkeypatch):
    released = []

    async def never(self):
        await asyncio.Event().wait()

    async def release(self):
        released.append(self)
        self.silence()

    async def story():
        told = Story(stepped())
        await told.periods(3)
        monkeypatch.setattr(MemoryLink, "prepare", never)
        monkeypatch.setattr(MemoryLink, "release", release)
        arming = told.order(Arm())
        await told.periods(3)
        assert not arming.done() and not (await told.until(told.order(Arm()))).ok
        stop = told.order(Stop())
        assert (await told.until(stop)).ok
        reply = await told.until(arming)
        assert not reply.ok and "stopped" in reply.text
        assert told.loop.cycle.machine.state is LoopState.SILENT and len(released) == 1
        monkeypatch.undo()
        assert (await told.until(told.order(Arm()))).state == "READY"

    asyncio.run(story())


def test_a_second_arming_waits_for_nothing_and_releases_nothing(monkeypatch):
    released = []

    async def release(self):
        released.append(self)

    async def story():
        told = Story(stepped())
        await told.periods(3)
        monkeypatch.setattr(MemoryLink, "release", release)
        first = told.order(Arm())
        for _ in range(10):  # it is proven, and waits for its period
            await asyncio.sleep(0)
        second = told.order(Arm())
        assert "under way" in (await told.until(second)).text
        assert (await told.until(first)).state == "READY" and not released

    asyncio.run(story())


def test_a_stop_while_devices_are_given_time_to_come_back_leaves_every_link_released(monkeypatch):
    released = []

    async def release(self):
        released.append(self)
        if len(released) == 1:
            for _ in range(30):
                await asyncio.sleep(0)

    async def story():
        told = Story(stepped())
        await told.periods(3)
        cycle = told.loop.cycle
        cycle.machine = Machine(Phase.OFF)
        cycle.inputs.tension.time_s[:] = np.nan
        monkeypatch.setattr(MemoryLink, "release", release)
        arming = told.order(Arm())
        for _ in range(10):
            await asyncio.sleep(0)
        assert (await told.until(told.order(Stop()))).ok
        assert "stopped" in (await told.until(arming)).text and len(released) == 2

    asyncio.run(story())


async def turns(count):
    for _ in range(count):
        await asyncio.sleep(0)


class SlowLink(MemoryLink):
    """Takes so many turns of the event loop to be prepared, and to be released."""

    def __init__(self, loop, prepares, releases):
        super().__init__(loop.line, loop.truth)
        self.prepares, self.releases = prepares, releases
        self.active = self.released = False

    async def prepare(self):
        await turns(self.prepares)
        self.active = True

    async def release(self):
        await turns(self.releases)
        self.active, self.released = False, True


@pytest.mark.parametrize("stops", [1, 2, 3])
def test_however_many_stops_come_into_an_arming_every_link_is_released(stops):
    """The first begins to undo it, which takes its time; the others cut nothing of that."""

    async def story():
        told = Story(stepped())
        await told.periods(3)
        links = [SlowLink(told.loop, *takes) for takes in ((0, 9), (0, 30), (999, 5))]
        told.loop.cycle.links[:] = links
        arming = told.order(Arm())
        await turns(10)
        assert links[0].active and links[1].active
        asked = []
        for _ in range(stops):
            asked.append(told.order(Stop()))
            await turns(4)
        assert all([(await told.until(stop)).ok for stop in asked])
        assert "stopped" in (await told.until(arming)).text
        assert all(link.released and not link.active for link in links)

    asyncio.run(story())


def test_arm_answers_when_the_drives_are_ready_and_not_before():
    async def story():
        told = Story(stepped())
        await told.periods(3)
        reply = await told.until(told.order(Arm()))
        assert reply.ok and reply.state == "READY"
        assert not (await told.until(told.order(Arm()))).ok

    asyncio.run(story())


@pytest.mark.parametrize("command", [Start(), SetSpeed(speed_m_per_s=0.1)])
def test_an_ending_loop_stops_the_line_and_takes_no_other_command(command):
    async def story():
        told = Story(start(stepped()))
        await told.runner.end()
        assert "ending" in (await told.runner.submit(command)).text
        await told.periods(1)
        assert told.loop.cycle.machine.phase is Phase.SLOWING
        await told.periods(400)
        assert told.runner.at_rest and not told.loop.truth.world.torque_nm.any()
        assert told.loop.truth.recorder.unsafe_total == 0

    asyncio.run(story())


@pytest.mark.parametrize(
    "payload",
    [b"", b"nonsense", b'{"command": "arm", "command": "start"}', b'{"command": "fly"}',
     b'{"command": "set", "span": 1}',
     b'{"command": "set", "span": true, "tension_n": 30}', b'{"command": "speed", "speed_m_per_s": NaN}',
     b"[" * 3000, b'{"command": "hold", "now": 1}', b" " * 5000],
)  # fmt: skip
def test_what_is_no_command_is_answered_and_does_nothing(payload):
    async def story():
        told = Story(stepped())
        before = told.loop.cycle.machine
        door = door_of(told.runner, told.loop.line, told.loop.cycle.clock)
        assert b'"ok":false' in await door.command(payload)
        door.close()
        await told.periods(2)
        assert told.loop.cycle.machine == before

    asyncio.run(story())


@pytest.mark.wires
def test_a_cycle_that_breaks_twice_ends_and_tells_every_drive_to_take_torque_off(monkeypatch):
    """In real time: the last resort of the process waits for one more period."""

    async def story():
        loop = start(stepped())
        told = Story(loop)
        assert loop.truth.world.torque_nm.any()
        plant_s = loop.now_s

        def broken(*_):
            raise RuntimeError("a defect")

        monkeypatch.setattr(loop.cycle, "_estimate", broken)
        monkeypatch.setattr(loop.cycle, "_frame", broken)
        monkeypatch.setattr(MemoryLink, "trigger", lambda self, now_s: setattr(self, "_now_s", plant_s + 0.01))
        with pytest.raises(RuntimeError, match="a defect"):
            await run_until(told.runner, loop.line, asyncio.Event())
        loop.truth.sample(plant_s + 1.0)
        assert not loop.truth.world.torque_nm.any()
        enabled = loop.truth.sample(plant_s + 1.1).enabled
        assert not np.any(enabled)

    asyncio.run(story())


def test_a_stop_between_the_proofs_and_the_arming_period_is_not_lost(monkeypatch):
    released = []
    release = MemoryLink.release

    async def counted(self):
        released.append(self)
        await release(self)

    async def story():
        told = Story(stepped())
        await told.periods(3)
        monkeypatch.setattr(MemoryLink, "release", counted)
        arming = told.order(Arm())
        for _ in range(20):  # the proofs are done, no period has passed
            await asyncio.sleep(0)
        stop = told.order(Stop())
        for _ in range(5):
            await asyncio.sleep(0)
        await told.periods(3)
        assert (await stop).ok
        reply = await arming
        assert not reply.ok and "stopped" in reply.text
        assert told.loop.cycle.machine.phase is Phase.SILENT and released, "nothing stays active"

    asyncio.run(story())


@pytest.mark.parametrize(("missing", "deployed"), [(0, True), (1, True), (2, True), (50, False)])
def test_a_deployment_waits_for_a_late_frame_and_not_for_a_cell_that_is_gone(missing, deployed):
    async def story():
        told = Story(start(stepped()))
        cycle, config, plant = told.loop.cycle, design_lqg(task_of(told.loop.line)), told.loop.truth
        before, sample, left = cycle.configurations.running.hash, plant.sample, missing

        def missed(now_s):
            nonlocal left
            seen, left = sample(now_s), left - 1
            return seen if left < 0 else replace(seen, tension_n=np.where(np.arange(6) == 2, np.nan, seen.tension_n))

        plant.sample = missed
        await told.periods(min(missing, 1))
        assert cycle.account.held == min(missing, 1)
        deployment = Deployment(controller=config, hash=config_hash(config), epoch=1, lease_s=60.0)
        answer = told.order(Deploy(deployment=deployment))
        while left > 0:
            await told.periods(1)
            assert cycle.configurations.running.hash == before
        reply = await told.until(answer)
        assert reply.ok == deployed, reply
        assert deployed or "the line is unloading" in reply.reasons[0]

    asyncio.run(story())


def test_an_arming_that_is_refused_while_the_line_stops_gives_what_failed_no_other_chance(monkeypatch):
    async def story():
        told = Story(start(stepped()))
        cycle = told.loop.cycle

        asked = []

        def broken(*_):
            asked.append(1)
            raise RuntimeError("a defect")

        monkeypatch.setattr(cycle.watch, "controlled", broken)
        await told.periods(1)
        assert cycle.machine.state is LoopState.STOP and not told.runner.at_rest
        assert not (await told.until(told.order(Arm()))).ok
        await told.periods(3)
        assert cycle.containment.failed and len(asked) == 1

    asyncio.run(story())


def test_a_disk_that_does_not_take_which_cells_are_contradicted_is_told_once_until_it_does(tmp_path, monkeypatch):
    monkeypatch.setattr("gateway.loop.runner.AGAIN_S", 0.001)

    async def story():
        told = Story(stepped())
        wiring, folder = told.loop.cycle.wiring, tmp_path / "data"
        tries, settle = [], wiring.settle

        def tried(contradicted):
            tries.append(contradicted)
            return settle(contradicted)

        wiring.path, wiring.settle = folder / FILE, tried
        folder.write_text("no folder")
        wiring.contradict([found("load-cell-contradicted", Action.BRAKE, span=1)])
        while len(tries) < 3:
            await told.periods(1)
        folder.unlink()
        while wiring.behind or len(told.loop.events) < 2:
            await told.periods(1)
        codes = [(one.kind, one.data["findings"][0].rule) for one in told.loop.events]
        assert codes == [("alarm", "contradicted-cells-not-kept"), ("file", "contradicted-cells-kept")]
        assert (folder / CONTRADICTED).exists()

    asyncio.run(story())
