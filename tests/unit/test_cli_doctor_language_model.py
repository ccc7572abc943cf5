"""What doctor says of the language model: it never fails a line, since the rules decide without it."""

import asyncio
from typing import Any

from gateway.cli.doctor_check import Check
from gateway.cli.doctor_language_model import language_model
from gateway.core.line import Agents
from tests.stand_in.engine import Engine, digest
from tests.stand_in.personas import PERSONAS
from tests.stand_in.server import StandIn


def looked_at(engine: Engine, **changed: Any) -> dict[str, Check]:
    async def story() -> list[Check]:
        async with StandIn(engine) as server:
            return await language_model(Agents(llm="ollama", url=server.url).model_copy(update=changed))

    checks = asyncio.run(story())
    assert all(check.verdict != "FAIL" for check in checks)
    return {check.subject: check for check in checks}


def test_off_means_that_the_rules_decide() -> None:
    (check,) = asyncio.run(language_model(Agents()))
    assert (check.verdict, check.measured) == ("OK", "off: the rules decide")


def test_a_model_that_answers() -> None:
    engine = Engine(PERSONAS["perfect"])
    checks = looked_at(engine)
    assert {check.verdict for check in checks.values()} == {"OK"}
    assert "Ollama 0.12.3" in checks["server"].measured
    assert digest("qwen3:4b")[:12] in checks["model"].measured and "2.5 GB" in checks["model"].measured
    assert checks["in memory"].measured.startswith("not loaded") and "300 s" in checks["in memory"].measured
    assert checks["context"].measured == "40960 tokens"
    assert not engine.loaded, "it is not loaded to be looked at"


def test_a_model_in_memory() -> None:
    checks = looked_at(Engine(PERSONAS["perfect"], loaded={"qwen3:4b": 16_384}))
    assert checks["in memory"].measured == "loaded"
    checks = looked_at(Engine(PERSONAS["perfect"], loaded={"qwen3:4b": 4096}))
    assert "context of 4096 tokens" in checks["in memory"].measured and "anew" in checks["in memory"].measured


def test_a_model_that_can_read_less_than_it_is_to() -> None:
    check = looked_at(Engine(PERSONAS["perfect"]), context_tokens=65_536)["context"]
    assert check.verdict == "warning" and "set agents.context_tokens to 40960 or less" in check.todo


def test_a_model_that_is_not_there() -> None:
    checks = looked_at(Engine(PERSONAS["perfect"], models=["qwen3:14b"]))
    assert list(checks) == ["model"] and checks["model"].verdict == "warning"
    assert "nearest is qwen3:14b" in checks["model"].measured and "rules decide" in checks["model"].todo


def test_a_server_that_is_not_there() -> None:
    (check,) = asyncio.run(language_model(Agents(llm="ollama", url="http://127.0.0.1:1")))
    assert (check.subject, check.verdict, check.wanted) == ("server", "warning", "http://127.0.0.1:1")
    assert "ollama serve" in check.todo and "rules decide" in check.todo
