"""A loop's process in stepped time, on a folder that outlives it: its links, its disk and its work aside can go wrong.

The runner, the cycle, the store and `process.run_until` are the product's; its pacer, its thread and `os.fsync` are
stand-ins that the clock of a test moves. A life ends in order, by an exception, or at any moment, within a write too.
"""

import asyncio
import os
from collections import deque
from collections.abc import Callable
from contextlib import ExitStack
from dataclasses import dataclass, field, replace
from pathlib import Path
from unittest.mock import patch

import numpy as np

from gateway.cli.stepped import SteppedLoop
from gateway.control.design import design_lqi, task_of
from gateway.core.line import Line
from gateway.core.messages import Arm, Command, Reply
from gateway.loop import deaths, kept, process, runner
from gateway.loop.pacer import Tick
from gateway.loop.process import begin, run_until
from gateway.loop.runner import Runner
from sim_plant.plant import Plant
from tests.closed_loop.conftest import demo_line, real_plant
from tests.support.gateway_key import proof_of, store_of

FIRST_M_PER_S = 0.04  #: of a configuration that nobody has judged; between the speeds that a sequence asks for
LINE: Line = demo_line(2)
LINE = LINE.model_copy(update={"gate": LINE.gate.model_copy(update={"first_speed_max_m_per_s": FIRST_M_PER_S})})
PLANT: Plant = real_plant(2)
PERIOD_S = LINE.control.period_s
GIVEN = design_lqi(task_of(LINE))
SPEED_M_PER_S = 0.03  #: of a life that begins in production
MOST_TURNS = 40  #: of the event loop, until a period is over


class Broken(RuntimeError):
    """What a part of the loop raises where a test wants it to."""


class Killed(BaseException):
    """The process dies here. No Exception: nothing in the product may go on after it."""


class SteppedTime(asyncio.SelectorEventLoop):
    """Timers go by a time that only the test moves."""

    now_s = 0.0

    def time(self) -> float:
        return self.now_s


@dataclass
class Disk:
    """How the folder fares, at each `fsync` of the store: before and after a file is put in its place."""

    refused: int = 0  #: calls that are still refused
    passing: int = 0  #: that succeed before those
    dies_after: int | None = None  #: calls, until the process dies within one
    slow_before: int = 0  #: periods, until a write begins
    slow_after: int = 0  #: until whoever waits for it hears of it
    refusals: int = 0  #: so far

    def fsync(self, _: int) -> None:
        if self.dies_after is not None:
            self.dies_after -= 1
            if self.dies_after < 0:
                raise Killed
        if self.passing:
            self.passing -= 1
        elif self.refused:
            self.refused -= 1
            self.refusals += 1
            raise OSError(28, "No space left on device")


class FaultyOs:
    """The module `os`, but for `fsync`."""

    def __init__(self, fsync: Callable[[int], None]) -> None:
        self.fsync = fsync

    def __getattr__(self, name: str) -> object:
        return getattr(os, name)


class SteppedAside:
    """As `aside.Aside`: one piece of work after the other. What has begun goes on even where nobody waits for it."""

    def __init__(self, life: "Life") -> None:
        self._life = life
        self._queue: deque[tuple[Callable[[], object], asyncio.Future[object]]] = deque()
        self._pump: asyncio.Task[None] | None = None

    @property
    def idle(self) -> bool:
        return self._pump is None or self._pump.done()

    async def do(self, work: Callable[[], object]) -> object:
        future = asyncio.get_running_loop().create_future()
        self._queue.append((work, future))
        if self.idle:
            self._pump = asyncio.create_task(self._work())
        return await future

    async def _work(self) -> None:
        disk = self._life.disk
        while self._queue:
            work, future = self._queue.popleft()
            if future.cancelled():
                continue
            await asyncio.sleep(disk.slow_before * PERIOD_S)
            result, error = None, None
            try:
                result = work()
            except Killed:
                self._life.dead = True
                await asyncio.Event().wait()
            except Exception as found:
                error = found
            await asyncio.sleep(disk.slow_after * PERIOD_S)
            if future.done():
                continue
            if error is None:
                future.set_result(result)
            else:
                future.set_exception(error)

    def close(self) -> None: ...


class SlowLink:
    """In front of a link, or of nothing: what it was told, and how long that takes, in periods."""

    def __init__(self, name: str, inner: object, life: "Life") -> None:
        self.name, self._inner, self._life = name, inner, life
        self.health = inner.health
        self.active = False
        self.serials, self.watched = {}, frozenset()

    async def prepare(self) -> None:
        self._life.armed_since_prepared = False
        await self._wait(self._life.prepare_periods)
        await self._inner.prepare()
        self.active = True

    def withhold(self, devices: object) -> None: ...

    def silence(self) -> None:
        self._inner.silence()
        self.active = False

    async def release(self) -> None:
        await self._wait(self._life.release_periods)
        self.silence()

    def trigger(self, now_s: float) -> None:
        self._life.raise_if_broken("trigger")
        self._inner.trigger(now_s)

    async def collect(self, inputs: object, deadline_s: float) -> None:
        self._life.raise_if_broken("collect")
        await self._inner.collect(inputs, deadline_s)

    def write(self, outputs: object) -> None:
        self._life.raise_if_broken("write")
        self._inner.write(outputs)

    async def open(self) -> None: ...

    async def close(self) -> None: ...

    @staticmethod
    async def _wait(periods: int) -> None:
        if periods:
            await asyncio.sleep(periods * PERIOD_S)


class Nothing:
    """A second bus, whose devices matter to nobody."""

    def __init__(self, health: object) -> None:
        self.health = health

    async def prepare(self) -> None: ...

    def silence(self) -> None: ...

    def trigger(self, now_s: float) -> None: ...

    async def collect(self, inputs: object, deadline_s: float) -> None: ...

    def write(self, outputs: object) -> None: ...


class Pacer:
    """Ticks when the test says so."""

    def __init__(self, _: float) -> None:
        self.waiting: asyncio.Future[Tick] | None = None

    async def wait(self) -> Tick:
        self.waiting = asyncio.get_running_loop().create_future()
        return await self.waiting

    def close(self) -> None: ...


class WatchedLoop(SteppedLoop):
    """Tells the life of what it tells anybody."""

    life: "Life"

    def _record(self, frame: object) -> None:
        self.life.raise_if_broken("telemetry")

    def _tell(self, kind: str, text: str, **data: object) -> None:
        self.told.append((kind, text))
        self.life.raise_if_broken("events")


#: Parts of a period, as attributes of the cycle, that a test can have raise.
PARTS = {
    "monitor": "guard.against",
    "doubts": "watch.controlled",
    "stuck": "watch.find_stuck",
    "jumps": "watch.reject_jumps",
    "experiment": "experiments.look",
    "lease": "configurations.lapsed",
    "control": "setpoints.advance",
}
BREAKABLE = (*PARTS, "telemetry", "events", "trigger", "collect", "write", "command")


@dataclass
class Ask:
    """A command that somebody waits for."""

    command: Command
    task: asyncio.Task[Reply]
    left: int | None = None  #: the period in which whoever asked went away; the command may be done all the same

    @property
    def answered(self) -> bool:
        return self.left is None and self.task.done()


@dataclass
class Life:
    """One process, from its start on the folder to its end. `world_s` is its own time, from 0."""

    folder: Path
    carried_out: Callable[[Command, Reply, float], None]
    rolled_back: Callable[[], None]
    disk: Disk = field(default_factory=Disk)
    asks: list[Ask] = field(default_factory=list[Ask])
    dead: bool = False
    prepare_periods: int = 0
    release_periods: int = 0
    armed_since_prepared: bool = False
    raised: list[str] = field(default_factory=list[str])  #: parts, since somebody has armed
    broken: dict[str, int] = field(default_factory=dict[str, int])  #: how often a part will raise
    ran: bool = False  #: a period has come to its end since `period` was called
    failed: bool = False  #: a period has raised: the process is about to end
    led_to_it: list[str] = field(default_factory=list[str])  #: what had raised then
    blind: int = 0  #: periods without load cells
    jump_n: float = 0.0  #: of the next sample

    def __post_init__(self) -> None:
        self.time = SteppedTime()
        self.pacer = Pacer(PERIOD_S)
        self.said: list[str] = []
        self.store = store_of(self.folder, GIVEN)
        self.loop = WatchedLoop(LINE, GIVEN, PLANT, 1)
        self.loop.life = self
        self.cycle = cycle = self.loop.cycle
        inner = cycle.links[0]
        self.links = [SlowLink("memory", inner, self), SlowLink("second", Nothing(inner.health), self)]
        cycle.links[:] = self.links
        self._patches = ExitStack()
        enter = self._patches.enter_context
        enter(patch.object(kept, "os", FaultyOs(self.disk.fsync)))
        enter(patch.object(deaths, "os", FaultyOs(lambda _: None)))
        enter(patch.object(process, "TimerPacer", lambda _: self.pacer))
        enter(patch.object(process, "monotonic", lambda: self.loop.now_s))
        enter(patch.object(runner, "carry_out", self._carry_out))
        begin(cycle, self.store.read(LINE, self.said.append), self.said.append)
        self.aside = SteppedAside(self)
        with patch.object(runner, "Aside", lambda: self.aside):
            self.runner = Runner(cycle, self.store)
        self._watch_runner()
        self._watch_parts()
        self.ending = asyncio.Event()
        self.task = self.time.create_task(run_until(self.runner, LINE, self.ending, self.store))
        self.turn()

    def begin_in_production(self) -> None:
        """As if it had been armed and started long ago."""
        speed_m_per_s = min(SPEED_M_PER_S, self.cycle.configurations.running.region.speed_max_m_per_s or 1.0)
        self.loop.begin_in_production(np.array(LINE.recipes[0].tension_n), speed_m_per_s)
        self.links[1].active = self.armed_since_prepared = True

    def order(self, command: Command) -> Ask:
        async def asked() -> Ask:
            return Ask(command, asyncio.create_task(self.runner.submit(command, proof_of(command, LINE))))

        ask = self.time.run_until_complete(asked())
        self.asks.append(ask)
        return ask

    def turn(self, turns: int = 1) -> None:
        """So many turns of the event loop; no time passes."""
        self.time.run_until_complete(_turns(turns))

    def period(self, turns: int = 3) -> None:
        """One control period, then so many turns of the event loop."""
        loop = self.loop
        self.ran = False
        loop.periods += 1
        loop.now_s = self.time.now_s = loop.periods * PERIOD_S
        self.time.run_until_complete(self._period(turns))

    async def _period(self, turns: int) -> None:
        now_s, waiting = self.loop.now_s, self.pacer.waiting
        if waiting is not None and not waiting.done():
            waiting.set_result(Tick(now_s, now_s, 0))
        for _ in range(MOST_TURNS):
            await asyncio.sleep(0)
            after = self.pacer.waiting
            if self.task.done() or (after is not None and not after.done()):
                break
        await _turns(turns)

    @property
    def over(self) -> bool:
        return self.dead or self.task.done()

    def close(self) -> None:
        """Whatever was under way is gone: nothing reaches the disk any more."""
        self.disk.refused, self.disk.passing, self.disk.dies_after = 1 << 30, 0, None
        self.store.deaths.count = self.store.deaths.forgive = lambda *_: None
        self.rolled_back, self.carried_out = (lambda: None), (lambda *_: None)
        for _ in range(MOST_TURNS):
            pending = asyncio.all_tasks(self.time)
            for task in pending:
                task.cancel()
            self.loop.periods += 1
            self.loop.now_s = self.time.now_s = self.loop.periods * PERIOD_S
            self.turn(5)
            if not asyncio.all_tasks(self.time):
                break
        for task in (self.task, *(ask.task for ask in self.asks)):
            if task.done() and not task.cancelled():
                task.exception()
        self._patches.close()
        self.time.close()

    def raise_if_broken(self, part: str) -> None:
        if self.broken.get(part):
            self.broken[part] -= 1
            self.raised.append(part)
            raise Broken(part)

    def _watch_runner(self) -> None:
        period = self.runner.period

        async def watched(tick: Tick) -> None:
            try:
                await period(tick)
            except Exception:
                self.failed, self.led_to_it = True, list(self.raised)
                raise
            self.ran = True

        self.runner.period = watched

    def _carry_out(self, cycle: object, command: Command, now_s: float, *given: object) -> Reply:
        self.raise_if_broken("command")
        reply = _carry_out(cycle, command, now_s, *given)
        if isinstance(command, Arm) and reply.ok:
            self.armed_since_prepared = True
        self.carried_out(command, reply, now_s)
        return reply

    def _watch_parts(self) -> None:
        cycle = self.cycle
        for part, name in PARTS.items():
            holder, attribute = name.split(".")
            self._before(getattr(cycle, holder), attribute, lambda part=part: self.raise_if_broken(part))
        self._before(cycle.containment, "begin_anew", self.raised.clear)
        roll_back = cycle.configurations.roll_back

        def watched(reason: str) -> bool:
            done = roll_back(reason)
            if done:
                self.rolled_back()
            return done

        cycle.configurations.roll_back = watched
        sample = self.loop.truth.sample

        def seen(now_s: float) -> object:
            found = sample(now_s)
            if self.blind:
                self.blind -= 1
                return replace(found, tension_n=np.full(LINE.n, np.nan))
            if self.jump_n:
                jumped, self.jump_n = found.tension_n + self.jump_n, 0.0
                return replace(found, tension_n=jumped)
            return found

        self.loop.truth.sample = seen

    @staticmethod
    def _before(holder: object, name: str, do: Callable[[], None]) -> None:
        inner = getattr(holder, name)

        def called(*given: object) -> object:
            do()
            return inner(*given)

        setattr(holder, name, called)


_carry_out = runner.carry_out


async def _turns(count: int) -> None:
    for _ in range(count):
        await asyncio.sleep(0)
