"""The agents' process on a real bus: it answers the phases, its records are kept, and its death costs nothing."""

import asyncio
import json
import sys
from contextlib import asynccontextmanager
from pathlib import Path

import pytest

from agents.code.materials import Given
from agents.process import begin
from agents.rag.stages import Asked, Retrieval
from gateway.cli.asked_agents import AskedAgents
from gateway.commissioning.decisions import Decided
from gateway.core.interactions import Interaction, unpack
from gateway.core.line import Line
from gateway.core.messages import Reply
from gateway.core.questions import Question, usual_choice
from gateway.core.topics import AGENT_DECIDE, AGENT_NAMES, ASK_LOG
from gateway.mailbox.zenoh_mailbox import ZenohMailbox
from tests.protocol.bus_support import LINE, answer_of, client, is_here, never, router, run
from tests.unit.language_model_support import QUESTION

pytestmark = pytest.mark.wires

#: As `r2rgate agents` has it.
PROCESS = """
import sys
from pathlib import Path
from agents.process import run_agents
from tests.protocol.bus_support import LINE
sys.exit(run_agents(LINE, Path(sys.argv[1]), Path(sys.argv[2]), Path(sys.argv[1]) / "heads.txt"))
"""


async def decided(bus: ZenohMailbox, question: Question = QUESTION, line: Line = LINE) -> Decided:
    decider = AskedAgents(line, bus, asyncio.get_running_loop())
    return await asyncio.to_thread(decider.decide, question)


async def answered(bus: ZenohMailbox, question: Question = QUESTION) -> Decided:
    """Once it is known here that somebody answers: that travels by itself."""
    found = await decided(bus, question)
    while "nobody answers" in found.instead:
        found = await decided(bus, question)
    return found


def serve_log(bus: ZenohMailbox) -> list[Interaction]:
    kept: list[Interaction] = []

    async def keep(packed: bytes) -> bytes:
        kept.append(unpack(packed))
        return Reply(ok=True, state="", text="kept").model_dump_json().encode()

    for agent in AGENT_NAMES:
        bus.serve(ASK_LOG.of(agent), keep)
    return kept


@asynccontextmanager
async def process(folder: Path):
    child = await asyncio.create_subprocess_exec(
        sys.executable, "-c", PROCESS, folder, folder / "knowledge", stdout=asyncio.subprocess.PIPE
    )
    assert child.stdout is not None
    try:
        while not (await child.stdout.readline()).startswith(b"agents of "):
            assert child.returncode is None
        yield child
    finally:
        if child.returncode is None:
            child.kill()
        await child.wait()


def test_the_process_answers_until_it_is_killed_and_then_the_rules_do_at_once() -> None:
    async def story(folder: Path) -> None:
        async with router(folder) as gateway, client(folder) as phases:
            kept = serve_log(gateway)
            absent = await decided(phases)
            assert absent.instead and absent.choice == usual_choice(QUESTION) and not absent.interaction
            async with process(folder) as child:
                found = await answered(phases)
                assert (found.choice, found.by, found.instead) == (usual_choice(QUESTION), "rules", "")
                assert kept[0].id == found.interaction
                assert kept[0].question is not None and kept[0].question.model_copy(update={"run": ""}) == QUESTION
                assert kept[0].notes and kept[0].agent == "adaptation"
                child.kill()
                await child.wait()
                killed = await decided(phases)
            assert killed.instead and killed.choice == usual_choice(QUESTION)

    run(story)


def test_the_process_ends_when_it_is_told_to() -> None:
    async def story(folder: Path) -> None:
        async with router(folder), process(folder) as child:
            child.terminate()
            assert await child.wait() == 0

    run(story)


def test_an_agent_that_lies_hangs_or_sends_garbage_leaves_the_decision_to_the_rules() -> None:
    answers = [
        b"garbage", b"", b"{}", json.dumps({"choice": {"option": "lqj", "reason": "a"}, "by": "adaptation"}).encode(),
        json.dumps({"choice": {"option": "lqi", "factors": {"torque": 99}, "reason": "a"}, "by": "x"}).encode(),
        json.dumps({"choice": {"option": "mpc", "reason": "a"}, "by": "rules"}).encode(),
        json.dumps({"choice": {"option": "mpc", "reason": "a"}, "by": "anna (engineer)"}).encode(),
        json.dumps({"choice": {"option": "mpc", "reason": "a"}, "by": "adaptation", "interaction": "x" * 99}).encode(),
    ]  # fmt: skip

    async def story(folder: Path) -> None:
        async with router(folder), client(folder) as agent, client(folder) as phases:
            said = iter(answers)

            async def answer(_: bytes) -> bytes:
                return next(said)

            agent.serve(AGENT_DECIDE.of("adaptation"), answer)
            agent.serve(AGENT_DECIDE.of("sysid"), never)
            for _ in answers:
                found = await decided(phases)
                assert found.by == "rules" and found.choice == usual_choice(QUESTION)
                assert found.instead or found.author == "rules"
            told: list[str] = []
            hung = AskedAgents(
                LINE, phases, asyncio.get_running_loop(), within_s=0.2, tell=told.append, tell_every_s=0.05
            )
            found = await asyncio.to_thread(hung.decide, QUESTION.model_copy(update={"decision": "identify.data"}))
            assert found.by == "rules" and "did not answer" in found.instead
            assert told and all("sysid is thinking" in one for one in told)
            again = await asyncio.to_thread(hung.decide, QUESTION.model_copy(update={"decision": "identify.data"}))
            assert "a while ago" in again.instead  # it has had its time

    run(story)


def test_what_the_gateway_was_not_there_to_keep_goes_to_it_with_the_next() -> None:
    async def nothing(_: Asked) -> Retrieval:
        raise OSError("nothing here")

    async def story(folder: Path) -> None:
        async with router(folder) as gateway, client(folder) as agents, client(folder) as phases:
            told: list[str] = []
            begin(agents, LINE, nothing, None, told.append, Given())
            first = await answered(phases)
            assert "not in the log yet" in told[-1]
            kept = serve_log(gateway)
            await is_here(agents, ASK_LOG.of("adaptation"))
            second = await decided(phases)
            ids = [one.id for one in kept]
            assert first.interaction in ids and ids[-1] == second.interaction and len(ids) == len(set(ids))

    run(story)


def test_a_question_for_another_agent_is_an_error_to_who_asked_and_the_process_goes_on() -> None:
    async def nothing(_: Asked) -> Retrieval:
        raise OSError("nothing here")

    async def story(folder: Path) -> None:
        async with router(folder) as gateway, client(folder) as agents, client(folder) as phases:
            serve_log(gateway)
            begin(agents, LINE, nothing, None, lambda text: None, Given())
            topic = AGENT_DECIDE.of("sysid")
            for payload in (b"garbage", QUESTION.model_dump_json().encode()):
                try:
                    await answer_of(phases, topic, payload, 20.0)
                except Exception as error:
                    assert ("it is no JSON" if payload == b"garbage" else "decided by adaptation") in str(error)
                else:
                    raise AssertionError("it was answered")
            assert "nothing here" in (await answered(phases)).instead

    run(story)
