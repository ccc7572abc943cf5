"""Starting an experiment on a line that runs, and following it through the gateway's status until its end."""

import asyncio
from collections.abc import Awaitable, Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

from gateway.core.experiment import Experiment
from gateway.core.messages import Command, Reply, RunExperiment
from gateway.core.status import GatewayStatus
from gateway.mailbox.port import Unreachable

LOOK_EVERY_S = 0.25
SLACK_S = 10.0  #: beyond its duration, until a run counts as lost
END, ABORT = "experiment-end", "experiment-abort"


@dataclass(frozen=True)
class Ended:
    complete: bool
    begun: bool  #: False: it was refused
    text: str
    reasons: list[str]
    history: str  #: the file with its data
    begin_s: float  #: Unix time
    end_s: float


class Line(Protocol):
    """What is asked of a gateway."""

    async def status(self) -> GatewayStatus: ...
    async def request(self, command: Command) -> Reply: ...


class Reached:
    """The line whose sockets lie in a folder."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder

    async def status(self) -> GatewayStatus:
        from gateway.cli.status_commands import ask_status

        return await ask_status(self._folder)

    async def request(self, command: Command) -> Reply:
        from gateway.cli.operate_commands import request

        return await request(self._folder, command)


async def follow(folder: Path, experiment: Experiment, show: Callable[[str], None]) -> Ended:
    """Run it to its end; `show` is given its progress. Raises Unreachable and PathTooLong."""
    return await follow_on(Reached(folder), experiment, show, asyncio.sleep)


async def follow_on(
    line: Line, experiment: Experiment, show: Callable[[str], None], sleep: Callable[[float], Awaitable[None]]
) -> Ended:
    """`follow`, with what it waits by."""
    before = await line.status()
    reply = await line.request(RunExperiment(experiment=experiment))
    if not reply.ok:
        return Ended(False, False, f"refused ({reply.state}): {reply.text}", reply.reasons, "", 0.0, 0.0)
    show(reply.text)
    try:
        return await _end(line, experiment, before.wall_s, show, sleep)
    except Unreachable as error:
        raise Unreachable(f"{error}; whether the experiment goes on, `r2rgate status` tells") from error


async def _end(
    line: Line,
    experiment: Experiment,
    since_s: float,
    show: Callable[[str], None],
    sleep: Callable[[float], Awaitable[None]],
) -> Ended:
    begin_s = since_s
    for _ in range(round((experiment.duration_s + SLACK_S) / LOOK_EVERY_S)):
        await sleep(LOOK_EVERY_S)
        now = await line.status()
        for event in now.events:
            if event.wall_s < since_s or not event.kind.startswith("experiment"):
                continue
            if event.kind == "experiment":
                begin_s = event.wall_s
            elif event.kind in (END, ABORT):
                return Ended(event.kind == END, True, event.text, [], now.historian.path, begin_s, event.wall_s)
            else:
                show(event.text)
        if not now.loop.running:
            raise Unreachable("the loop does not run any more")
    raise Unreachable(f"no end was told {SLACK_S:g} s after it was due")
