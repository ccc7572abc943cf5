"""The agents of a line that runs, asked by a command that works by itself."""

import asyncio
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest

from gateway.cli.agents_beside import CannotBeAsked, agents_beside
from gateway.commissioning.decisions import Decided
from gateway.core.interactions import Answer
from gateway.core.questions import Choice, usual_choice
from gateway.core.topics import AGENT_DECIDE
from tests.protocol.bus_support import LINE, client, never, router, run
from tests.unit.language_model_support import QUESTION

pytestmark = pytest.mark.wires


def test_a_command_asks_them_and_goes_on_by_the_rules_once_they_are_gone() -> None:
    chosen = Answer(choice=Choice(option="mpc", reason="the least error"), by="adaptation")

    def command(folder: Path, gone: asyncio.Event, loop: asyncio.AbstractEventLoop, over: asyncio.Event) -> None:
        """In a thread, as a command has no event loop of its own."""
        with agents_beside(LINE, folder) as asked:
            found = asked.decide(QUESTION)
            assert (found.choice, found.by) == (chosen.choice, "adaptation")
            loop.call_soon_threadsafe(gone.set)
            asyncio.run_coroutine_threadsafe(over.wait(), loop).result()
            after = asked.decide(QUESTION)
            assert (after.choice, after.by) == (usual_choice(QUESTION), "rules") and after.instead

    async def story(folder: Path) -> None:
        gone, over = asyncio.Event(), asyncio.Event()
        async with router(folder):
            async with client(folder) as agent:

                async def answer(_: bytes) -> bytes:
                    return chosen.model_dump_json().encode()

                agent.serve(AGENT_DECIDE.of("adaptation"), answer)
                works = asyncio.create_task(asyncio.to_thread(command, folder, gone, asyncio.get_running_loop(), over))
                gone_or_failed = asyncio.create_task(gone.wait())
                await asyncio.wait([works, gone_or_failed], return_when=asyncio.FIRST_COMPLETED)
                gone_or_failed.cancel()
            over.set()
            await works

    run(story)


def test_a_command_that_ends_while_somebody_is_asked_waits_for_nobody() -> None:
    def command(folder: Path, loop: asyncio.AbstractEventLoop, asked_now: asyncio.Event) -> Decided:
        with ThreadPoolExecutor(1) as beside:
            with agents_beside(LINE, folder) as asked:
                out = beside.submit(asked.decide, QUESTION)
                asyncio.run_coroutine_threadsafe(asked_now.wait(), loop).result()
            return out.result()

    async def story(folder: Path) -> None:
        asked_now = asyncio.Event()

        async def thinks(_: bytes) -> bytes:
            asked_now.set()
            return await never(b"")

        async with router(folder), client(folder) as agent:
            agent.serve(AGENT_DECIDE.of("adaptation"), thinks)
            found = await asyncio.to_thread(command, folder, asyncio.get_running_loop(), asked_now)
            assert (found.choice, found.by) == (usual_choice(QUESTION), "rules") and found.instead

    run(story)


def test_where_no_gateway_runs_or_agents_decide_nothing_that_is_said(tmp_path: Path) -> None:
    with pytest.raises(CannotBeAsked, match="no gateway on"), agents_beside(LINE, tmp_path):
        pass
    closed = LINE.model_copy(update={"gate": LINE.gate.model_copy(update={"authors": ["rules"]})})
    with pytest.raises(CannotBeAsked, match="gate.authors is rules"), agents_beside(closed, tmp_path):
        pass
