"""The agents of a line that runs, for a command that works by itself: their bus has a thread of its own here."""

import asyncio
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from gateway.cli.asked_agents import AskedAgents
from gateway.cli.background import in_background
from gateway.commissioning.decisions import AGENTS
from gateway.core.line import Line
from gateway.mailbox.bus import BusUnavailable, connect
from gateway.mailbox.paths import default_run_folder
from gateway.mailbox.port import Mailbox


class CannotBeAsked(Exception):
    """The text says why."""


@contextmanager
def agents_beside(line: Line, run_dir: Path | None) -> Iterator[AskedAgents]:
    """The agents on the bus in `run_dir`, or in the line's own run folder. Raises CannotBeAsked."""
    if AGENTS not in line.gate.authors:
        raise CannotBeAsked(f'gate.authors is {", ".join(line.gate.authors) or "empty"}; "agents" decide here: add it')
    loop = asyncio.new_event_loop()
    thread = in_background(loop.run_forever)
    try:
        folder = run_dir or default_run_folder(line)
        bus = asyncio.run_coroutine_threadsafe(connect(folder, line.site, line.line), loop).result()
        try:
            yield AskedAgents(line, bus, loop)
        finally:
            asyncio.run_coroutine_threadsafe(_ended(bus), loop).result()
    except BusUnavailable as error:
        raise CannotBeAsked(str(error)) from error
    finally:
        loop.call_soon_threadsafe(loop.stop)
        thread.join()
        loop.close()


async def _ended(bus: Mailbox) -> None:
    """Whoever still waits for an answer goes on by the rules."""
    waiting = asyncio.all_tasks() - {asyncio.current_task()}
    for task in waiting:
        task.cancel()
    await asyncio.gather(*waiting, return_exceptions=True)
    await bus.close()
