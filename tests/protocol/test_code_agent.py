"""Computations with everything real: the bus, a model over HTTP, and the confined process."""

from pathlib import Path

import pytest

from agents.code.materials import Given
from agents.language_model.client import LanguageModel
from agents.process import begin
from agents.rag.stages import Asked, Retrieval
from gateway.control.design import design_lqi, margins, task_of
from gateway.core.computations import ComputeReply, ComputeRequest
from gateway.core.interactions import Answer
from gateway.core.line import Agents
from gateway.core.topics import AGENT_COMPUTE, AGENT_DECIDE
from tests.protocol.bus_support import LINE, answer_of, client, router, run
from tests.protocol.test_agents import serve_log
from tests.stand_in.engine import Engine
from tests.stand_in.personas import PERSONAS
from tests.stand_in.server import StandIn
from tests.unit.language_model_support import QUESTION

LONG_S = 300.0  #: a fresh checkout compiles first
CONFIG = design_lqi(task_of(LINE))


async def nothing(_: Asked) -> Retrieval:
    raise OSError("nothing here")


@pytest.mark.wires
def test_a_phase_has_something_computed_over_the_bus_and_it_is_logged_as_the_code_agents() -> None:
    async def story(folder: Path) -> None:
        async with router(folder) as gateway, client(folder) as agents, client(folder) as phases:
            kept = serve_log(gateway)
            begin(agents, LINE, nothing, None, lambda text: None, Given(None, CONFIG))
            calls = [{"call": "margins"}, {"call": "marginz"}]
            request = ComputeRequest(format=1, asked_by="commissioning", task="is it stable", calls=calls)
            topic = AGENT_COMPUTE.of("code")
            answer = await answer_of(phases, topic, request.model_dump_json().encode(), LONG_S)
            reply = ComputeReply.model_validate_json(answer)
            done, refused = reply.results
            assert done.figures[0].value == pytest.approx(1e3 * margins(CONFIG, task_of(LINE)).delay_margin_s)
            assert "the nearest is margins" in refused.refused[0]
            assert (kept[0].id, kept[0].agent, kept[0].asked_by) == (reply.interaction, "code", "commissioning")
            assert kept[0].computations == reply.results
            for payload in (b"", b"{}", b'{"format": 1, "asked_by": "x", "task": "y", "calls": []}'):
                with pytest.raises(Exception, match="JSON|missing|few"):
                    await answer_of(phases, topic, payload, LONG_S)

    run(story)


@pytest.mark.wires
@pytest.mark.parametrize("persona", ["perfect", "adversarial"])
def test_a_model_over_http_has_something_computed_before_it_answers(persona: str) -> None:
    async def story(folder: Path) -> None:
        async with router(folder) as gateway, client(folder) as agents, client(folder) as phases:
            kept = serve_log(gateway)
            async with StandIn(Engine(PERSONAS[persona])) as server:
                settings = Agents(llm="ollama", url=server.url, answer_max_s=LONG_S)
                async with LanguageModel(settings) as model:
                    begin(agents, LINE, nothing, model, lambda text: None, Given(None, CONFIG))
                    topic = AGENT_DECIDE.of("adaptation")
                    answer = await answer_of(phases, topic, QUESTION.model_dump_json().encode(), LONG_S)
            assert Answer.model_validate_json(answer).by == "adaptation"
            of_code, of_adaptation = sorted(kept, key=lambda one: one.agent != "code")
            assert of_code.asked_by == of_adaptation.agent == "adaptation" and of_code.task == QUESTION.task
            computed = [row for exchange in of_adaptation.exchanges for row in exchange["computed"]]
            assert computed == [one.model_dump(mode="json") for one in of_code.computations]
            assert all(one.done for one in of_code.computations) is (persona == "perfect")

    run(story)


@pytest.mark.wires
def test_the_code_agent_decides_nothing() -> None:
    async def story(folder: Path) -> None:
        async with router(folder), client(folder) as agents, client(folder) as phases:
            begin(agents, LINE, nothing, None, lambda text: None, Given())
            with pytest.raises(Exception, match="nobody"):
                await phases.request(AGENT_DECIDE.of("code"), QUESTION.model_dump_json().encode(), 20.0)

    run(story)
