"""Streams of the chat endpoint, byte for byte as a server writes them, and what the client makes of each."""

import asyncio

import pytest

from agents.language_model.budget import Budget
from agents.language_model.client import LanguageModel
from agents.language_model.no_answer import Kind, NoAnswer
from agents.language_model.replies import Reply, Said
from gateway.core.line import Agents
from tests.stand_in.engine import Engine
from tests.stand_in.failures import RECORDED, recorded
from tests.stand_in.server import StandIn

SKY = [Said("user", "Why is the sky blue?")]

WHOLE = {
    "chat": "The",
    "structured": '{"age": 22, "available": false}',
    "words": "The sky is blue since air scatters short waves more (λ < 500 nm).",
    "thinking": "Scattering.",
}
NOT_WHOLE: dict[str, tuple[Kind, str]] = {
    "thinking-only": ("empty", ""),
    "tools": ("empty", ""),
    "length": ("length", "The sky is blue"),
    "error": ("broken", "The sky is"),
    "no-end": ("broken", "The sky is blue since"),
    "torn": ("broken", "The sky"),
    "cut": ("cut", "The sky is blue"),
    "no-counts": ("cut", "The"),
    "load": ("cut", ""),
}


@pytest.mark.parametrize("name", WHOLE)
def test_a_whole_stream(name: str) -> None:
    reply = asyncio.run(streamed(name))
    assert isinstance(reply, Reply) and reply.text == WHOLE[name]
    assert reply.thinking == ("They ask of Rayleigh." if name == "thinking" else "")
    assert reply.tokens_in in (26, 34) and reply.tokens_out > 0


@pytest.mark.parametrize("name", NOT_WHOLE)
def test_a_stream_that_is_no_answer(name: str) -> None:
    failed = asyncio.run(streamed(name))
    assert isinstance(failed, NoAnswer) and (failed.kind, failed.so_far) == NOT_WHOLE[name]


def test_every_recorded_stream_is_tried_and_described() -> None:
    names = {path.stem for path in RECORDED.glob("*.ndjson")}
    described = (RECORDED / "README.md").read_text(encoding="utf-8")
    assert names == {*WHOLE, *NOT_WHOLE} and all(f"`{name}.ndjson`" in described for name in names)


async def streamed(name: str) -> Reply | NoAnswer:
    async with StandIn(Engine(recorded(f"{name}.ndjson"))) as server, LanguageModel(Agents(url=server.url)) as model:
        try:
            return await model.chat(SKY, 10.0, Budget(1000))
        except NoAnswer as failed:
            return failed
