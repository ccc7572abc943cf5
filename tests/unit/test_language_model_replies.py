"""Answers that a server ends as if all were well, and which are not what was asked for."""

import gzip
import json
from typing import Any

import httpx
import pytest

from agents.language_model.bounded import MOST_RESPONSE_BYTES
from agents.language_model.budget import Budget
from agents.language_model.client import LanguageModel
from agents.language_model.no_answer import NoAnswer
from agents.language_model.replies import Reply, Said
from tests.unit.language_model_support import SETTINGS, virtually

ASKED = [Said("user", "Why is the sky blue?")]


def line(content: str = "", **more: Any) -> bytes:
    return json.dumps(
        {"model": "m", "message": {"role": "assistant", "content": content}, "done": False} | more
    ).encode()


def end(**more: Any) -> bytes:
    return line(done=True, done_reason="stop", **{"prompt_eval_count": 12, "eval_count": 2} | more)


async def chat(*lines: bytes, **headers: str) -> Reply:
    transport = httpx.MockTransport(
        lambda _: httpx.Response(200, headers=headers, stream=httpx.ByteStream(b"\n".join(lines)))
    )
    async with LanguageModel(SETTINGS, transport=transport) as model:
        return await model.chat(ASKED, 10.0, Budget(1_000_000))


def refused(*lines: bytes, **headers: str) -> NoAnswer:
    with pytest.raises(NoAnswer) as failed:
        virtually(chat(*lines, **headers))
    return failed.value


def test_a_whole_answer() -> None:
    reply = virtually(chat(line("As it "), line("scatters."), end()))
    assert (reply.text, reply.tokens_in, reply.tokens_out) == ("As it scatters.", 12, 2)


def test_what_comes_after_the_end_is_no_part_of_it() -> None:
    assert virtually(chat(line("Yes."), end(), line(" And raise the limits."), end())).text == "Yes."


@pytest.mark.parametrize("counts", [{"prompt_eval_count": 16_384}, {"eval_count": 16_380}])
def test_more_tokens_than_the_context_has(counts: dict[str, int]) -> None:
    failed = refused(line("Yes."), end(**counts))
    assert failed.kind == "cut" and "context of 16384" in failed.text


@pytest.mark.parametrize("counts", [{"prompt_eval_count": 4}, {"prompt_eval_count": -5}, {"prompt_eval_count": None}])
def test_fewer_tokens_than_were_sent(counts: dict[str, int | None]) -> None:
    assert refused(line("Yes."), end(**counts)).kind == "cut"


def test_an_answer_longer_than_it_may_be() -> None:
    failed = refused(line("word " * 20_000), end())
    assert failed.kind == "length" and "agents.answer_tokens (2048)" in failed.text


def test_a_line_that_does_not_end() -> None:
    failed = refused(b'{"message": "' + b"a" * MOST_RESPONSE_BYTES)
    assert failed.kind == "broken" and "more than any answer has" in failed.text


def test_what_is_compressed_is_not_unpacked() -> None:
    failed = refused(gzip.compress(line("Yes.") + b"\n" + end()), **{"content-encoding": "gzip"})
    assert failed.kind == "broken" and "compresses" in failed.text


def test_what_a_server_says_of_its_error_is_shown_without_its_control_characters() -> None:
    failed = refused(json.dumps({"error": "\x1b[2J" + 1000 * "x"}).encode())
    assert failed.kind == "broken" and "\\u001b" in failed.text and len(failed.text) < 400
