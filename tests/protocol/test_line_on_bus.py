"""What agents ask of the line on a real bus: they get what is stored, and a stranger gets nothing."""

import asyncio
from contextlib import asynccontextmanager
from pathlib import Path

import pytest

from agents.line_on_bus import LineNotTold, LineOnBus
from gateway.core.controller import config_hash
from gateway.core.line_model import model_hash
from gateway.core.line_queries import OfHash
from gateway.core.topics import AGENT_TOPICS, ASK_KNOWLEDGE, ASK_MODEL, ASK_UNANSWERED
from gateway.mailbox.inprocess import Hub, InProcessMailbox
from gateway.mailbox.zenoh_mailbox import ZenohMailbox
from gateway.supervisor.agents_cases import AgentsCases
from gateway.supervisor.gate import Gate
from gateway.supervisor.line_desk import LineDesk
from tests.protocol.bus_support import client, raw_answers, router, run
from tests.protocol.test_agents import answered, process, serve_log
from tests.support.gateway_key import to_loop_over
from tests.unit.deployer_support import LINE, Death, FakeJudge, FakeLoop, FakeSurroundings, controller
from tests.unit.knowledge_support import Records
from tests.unit.language_model_support import QUESTION
from tests.unit.supervisor_support import until
from tests.unit.test_line_desk import recording

pytestmark = pytest.mark.wires


@asynccontextmanager
async def served(bus: ZenohMailbox, data: Path):
    """A desk with a real gate over records; it is the loop's word that is missing, and what the gate goes by."""
    gate = Gate(
        LINE, InProcessMailbox(Hub()), to_loop_over(InProcessMailbox(Hub()), LINE), data, FakeJudge(),
        lambda configurations, models: FakeSurroundings(FakeLoop(Death())), lambda *_, **__: None, lambda: 1.0,
        lambda: 1_800_000_000.0,
    )  # fmt: skip
    try:
        while gate.deployer is None:
            await gate.look()
        found = [(recording(2500, 1), 1.0), (recording(20, 2), 0.0)]
        LineDesk(LINE, gate, data, lambda most_s: found, AgentsCases(gate.audit.append)).serve_on(bus)
        yield gate.deployer
    finally:
        await gate.close()


def records(folder: Path) -> Path:
    data = folder / "data"
    data.mkdir()
    return data


def test_an_agent_gets_the_model_the_controller_recordings_and_what_is_known() -> None:
    async def story(folder: Path) -> None:
        data = records(folder)
        with Records(data) as kept:
            kept.deployed("softer in span 2")
            model = kept.model(3100.0)
        async with router(folder) as bus, served(bus, data) as deployer, client(folder) as agents:
            deployer.book.model = model_hash(model)
            line = LineOnBus(agents, "code")
            assert await line.model() == model
            assert config_hash(await line.controller()) == kept.in_service == config_hash(controller(1))
            assert [one.digest() for one in await line.recordings()] == [
                recording(2500, 1).digest(), recording(20, 2).digest()
            ]  # fmt: skip
            known = await line.knowledge()
            assert {"line", "model-1", "in-service"} < {one.name for one in known}
            assert any("> softer in span 2" in one.text for one in known)

    run(story)


def test_what_is_no_row_of_the_table_is_not_reached_and_no_other_line_is() -> None:
    async def story(folder: Path) -> None:
        data = records(folder)
        with Records(data) as kept:
            kept.model()
        async with router(folder) as bus, served(bus, data), client(folder) as agents:
            assert await LineOnBus(agents, "code").knowledge()  # it is there
            ask = OfHash().model_dump_json().encode()
            for name in ("ask/stranger/model", "ask/code/audit", "ask/code/knowledge/all", "ask/code/models",
                         "gateway/decision", "loop/command"):  # fmt: skip
                assert await raw_answers(agents, f"demo/line-1/{name}", ask) == [], name
            for refused in await raw_answers(agents, "demo/line-1/ask/*/model", ask):
                assert "is more than one key" in refused
            async with client(folder, line="line-2") as beside:
                with pytest.raises(LineNotTold):
                    await LineOnBus(beside, "code").model()

    run(story)


def test_the_agents_process_answers_with_what_is_known_of_the_line() -> None:
    async def story(folder: Path) -> None:
        data = records(folder)
        with Records(data) as kept:
            kept.measured(0.9, "span 3 swings because its web is softer")
        async with router(folder) as bus, served(bus, data), client(folder) as phases:
            log = serve_log(bus)
            task = "What does the last measurement of span 3 say?"
            question = QUESTION.model_copy(update={"task": task, "facts": []})
            async with process(folder):
                await answered(phases, question)
            assert log[0].notes[0].key in ("line:measurement-1", "line:recent")
            assert log[0].notes[0].tier == 3

    run(story)


def test_a_flood_of_questions_costs_who_asks_and_nobody_else() -> None:
    async def story(folder: Path) -> None:
        data = records(folder)
        with Records(data):
            pass
        async with router(folder) as bus, served(bus, data), client(folder) as agents:
            ask = [agents.request(ASK_MODEL.of("code"), b"{}", 20.0) for _ in range(200)]
            flood = asyncio.gather(*ask, return_exceptions=True)
            assert await LineOnBus(agents, "sysid").knowledge()
            await flood
            await until(lambda: bus.counters.refused > 0)

    run(story)


def test_the_rows_are_asked_by_agents_and_answered_by_the_gateway() -> None:
    rows = [row for row in AGENT_TOPICS if row.name.startswith("ask/*/") and row is not ASK_UNANSWERED]
    assert ASK_KNOWLEDGE in rows and all((row.asks, row.answers) == ("agent", "gateway") for row in rows)
