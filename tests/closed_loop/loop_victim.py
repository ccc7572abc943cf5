"""Loop processes to be killed at the writes of their configuration: real files, a real SIGKILL, a line in memory.

`python -m tests.closed_loop.loop_victim FOLDER` forks one for each line "SEED PLACE COUNT" on its standard input and
says when it is gone. Each starts as `process` does, notes what it runs, and takes decisions at random; when it comes to
PLACE the COUNTth time it kills itself. What it was asked, did and answered is in `notes.jsonl`, in that order.
"""

import asyncio
import json
import os
import random
import signal
import sys
import traceback
from collections.abc import Awaitable
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any
from unittest.mock import patch

from gateway.cli.lifetime import follow_parent
from gateway.cli.stepped import SteppedLoop
from gateway.core.controller import config_hash
from gateway.core.deployment import Deployment
from gateway.core.messages import Command, Deploy, Keep, Narrow, Reply, Rollback, WatchGood
from gateway.loop import kept, runner
from gateway.loop.kept import Store
from gateway.loop.pacer import Tick
from gateway.loop.process import begin
from gateway.loop.runner import Runner
from tests.closed_loop.loop_model import RUNS, runs_of
from tests.closed_loop.loop_states import LAWS, REGIONS, watch_for
from tests.closed_loop.loop_world import GIVEN, LINE, PERIOD_S, PLANT
from tests.support.gateway_key import proof_of, store_of

NOTES = "notes.jsonl"
DECISIONS = 12  #: of a life, at most
PLACES = (
    "asked", "before the part file", "part half written", "part written", "part on the disk", "in place",
    "folder on the disk", "written", "carried out", "answered",
)  # fmt: skip


@dataclass(frozen=True)
class Order:
    """A command in a few words, for whoever reads the notes."""

    kind: str
    epoch: int = 1
    law: str = "lqg"
    region: int = 0
    watch: str = ""  #: "", or what `watch_for` is asked for
    fallback: str = ""

    def command(self) -> Command:
        watch = watch_for(self.fallback, self.watch) if self.watch else None
        match self.kind:
            case "deploy":
                config = LAWS[self.law]
                given = Deployment(
                    controller=config, hash=config_hash(config), epoch=self.epoch, lease_s=5.0,
                    region=REGIONS[self.region], watch=watch,
                )  # fmt: skip
                return Deploy(deployment=given)
            case "keep":
                return Keep(epoch=self.epoch, watch=watch)
            case "watch-good":
                assert watch is not None
                return WatchGood(watch=watch)
            case "narrow":
                return Narrow(region=REGIONS[self.region])
            case _:
                return Rollback(reason="a person")


class Victim:
    def __init__(self, folder: Path, seed: int, place: str, count: int) -> None:
        self._notes = os.open(folder / NOTES, os.O_WRONLY | os.O_CREAT | os.O_APPEND)
        self._rng = random.Random(seed)
        self._place, self._count = place, count
        self._orders: dict[int, Order] = {}
        self._loop = SteppedLoop(LINE, GIVEN, PLANT, 1)
        store = store_of(folder, GIVEN)
        begin(self._loop.cycle, store.read(LINE, lambda _: None), lambda _: None)
        self._configurations = self._loop.cycle.configurations
        self.note("begins", runs=RUNS.dump_python(runs_of(self._configurations.durable), mode="json"))
        self._watch_writes(store)
        self._runner = Runner(self._loop.cycle, store)

    def note(self, kind: str, **data: object) -> None:
        os.write(self._notes, (json.dumps({"kind": kind, **data}) + "\n").encode())

    def come_to(self, place: str, part: Path | None = None) -> None:
        if place != self._place:
            return
        self._count -= 1
        if self._count == 0:
            if part is not None:
                os.truncate(part, part.stat().st_size // 2)
            self.note("dies", place=place)
            os.kill(os.getpid(), signal.SIGKILL)

    async def live(self) -> None:
        periods = asyncio.create_task(self._periods())
        for _ in range(DECISIONS):
            await asyncio.gather(*(self._ask(order) for order in self._draw()))
            if self._rng.random() < 0.5 and not await self._runner.persisted(5.0):
                self.note("settled")
        self.note("dies", place="the end")
        os.kill(os.getpid(), signal.SIGKILL)
        await periods

    def _draw(self) -> list[Order]:
        """What somebody decides next; two at once where they are at odds."""
        rng, found = self._rng, self._configurations
        fallback = found.good.hash
        if found.probation is None:
            kind = rng.choice(["deploy", "deploy", "deploy", "watch-good", "narrow", "rollback"])
            law = rng.choice(["lqg", "pid", "lqr", "mpc"])
            watch = "usual" if kind == "watch-good" else ""
            return [Order(kind, found.epoch + 1, law, rng.randrange(kind == "narrow", len(REGIONS)), watch, fallback)]
        keep = Order("keep", found.epoch, watch=rng.choice(["", "usual"]), fallback=found.good_if_kept.hash)
        return rng.choice([[keep], [keep], [Order("rollback")], [keep, Order("rollback")], [Order("rollback"), keep]])

    async def _ask(self, order: Order) -> None:
        command = order.command()
        self._orders[id(command)] = order
        self.note("asked", order=asdict(order))
        self.come_to("asked")
        reply = await self._runner.submit(command, proof_of(command, LINE))
        late = "does not know it yet" in reply.text
        self.note("answered", order=asdict(order), ok=reply.ok, late=late, text=reply.text)
        self.come_to("answered")

    async def _periods(self) -> None:
        loop = self._loop
        while True:
            loop.periods += 1
            loop.now_s = loop.periods * PERIOD_S
            await self._runner.period(Tick(loop.now_s, loop.now_s, 0))
            await asyncio.sleep(self._rng.choice((0.0, 0.0, 0.0005)))

    def _watch_writes(self, store: Store) -> None:
        sound_open, sound_replace, sound_carry_out, write = Path.open, Path.replace, runner.carry_out, store.write

        def opened(path: Path, *given: Any, **named: Any) -> Any:
            self.come_to("before the part file")
            return sound_open(path, *given, **named)

        def replaced(path: Path, target: Path) -> Path:
            self.come_to("part on the disk")
            found = sound_replace(path, target)
            self.come_to("in place")
            return found

        def carried_out(cycle: Any, command: Command, *given: Any) -> Reply:
            reply = sound_carry_out(cycle, command, *given)
            self.note("carried out", order=asdict(self._orders[id(command)]), ok=reply.ok)
            self.come_to("carried out")
            return reply

        def written(durable: Any) -> None:
            write(durable)
            self.come_to("written")

        store.write = written
        patch.object(Path, "open", opened).start()
        patch.object(Path, "replace", replaced).start()
        patch.object(runner, "carry_out", carried_out).start()
        patch.object(kept, "os", TellingOs(self)).start()


class TellingOs:
    """The module `os`; says before and after each `fsync` where a write is."""

    def __init__(self, victim: Victim) -> None:
        self._victim = victim

    def fsync(self, number: int) -> None:
        path = Path(os.readlink(f"/proc/self/fd/{number}"))
        if path.suffix == ".part":
            self._victim.come_to("part half written", path)
            self._victim.come_to("part written")
        os.fsync(number)
        if path.suffix != ".part":
            self._victim.come_to("folder on the disk")

    def __getattr__(self, name: str) -> Any:
        return getattr(os, name)


def main() -> None:
    folder = Path(sys.argv[1])
    follow_parent()
    for name, config in LAWS.items():  # once, not in every child
        if name != "mpc":
            watch_for(config_hash(config), "usual")
    for line in sys.stdin:
        seed, count, place = line.strip().split(" ", 2)
        pid = os.fork()
        if pid == 0:
            try:
                follow_parent()
                work: Awaitable[None] = Victim(folder, int(seed), place, int(count)).live()
                asyncio.run(work)  # pyright: ignore[reportArgumentType]
            except BaseException:
                traceback.print_exc()
                sys.stderr.flush()
            finally:
                os._exit(1)
        _, status = os.waitpid(pid, 0)
        print("killed" if os.WIFSIGNALED(status) else "ended", flush=True)


if __name__ == "__main__":
    main()
