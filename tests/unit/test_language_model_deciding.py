"""A question to a language model, from the first call to the choice or the reason why there is none. Virtual time."""

import asyncio
import json
import random
from collections.abc import Sequence

import httpx
import pytest
from hypothesis import given
from hypothesis import strategies as st

from agents.language_model.budget import Budget
from agents.language_model.client import LanguageModel
from agents.language_model.deciding import MOST_TRIES, Answered, Exchange, Unanswered, decide
from agents.language_model.no_answer import NoAnswer
from gateway.core.questions import wrong_with
from tests.stand_in.engine import Engine, digest
from tests.stand_in.in_process import InProcess
from tests.stand_in.personas import PERSONAS
from tests.stand_in.spoken import Form, Message, Persona, Spoken
from tests.unit.language_model_support import PROMPT, QUESTION, SETTINGS, asked_of, decided, says, virtually

GOOD = json.dumps({"because": "0.75 N", "option": "mpc", "times_integral": 1, "times_torque": 1})


def in_turn(*answers: Spoken) -> Persona:
    """The answers in their order; after the last, that again."""
    left = list(answers)

    def persona(messages: Sequence[Message], form: Form, rng: random.Random) -> Spoken:
        return left.pop(0) if len(left) > 1 else left[0]

    return persona


def answered(found: Answered | Unanswered) -> Answered:
    assert isinstance(found, Answered), found
    return found


def unanswered(found: Answered | Unanswered) -> Unanswered:
    assert isinstance(found, Unanswered), found
    return found


def test_a_model_reasons_freely_and_then_answers_in_the_form() -> None:
    found = answered(asked_of("perfect"))
    assert found.choice.option == "mpc" and found.choice.factors == {}  # 1 turns nothing
    reason, answer = found.exchanges
    assert (reason.purpose, answer.purpose, answer.parsed) == ("reason", "answer", found.choice)
    assert answer.messages[2].content == reason.raw, "it answers with what it thought before it"
    assert {one.digest for one in found.exchanges} == {digest("qwen3:4b")}
    assert all(one.tokens_in and one.tokens_out and not one.refused for one in found.exchanges)


def test_an_exchange_as_json_is_read_back_the_same() -> None:
    for exchange in unanswered(asked_of("unit_confused")).exchanges:
        assert Exchange.model_validate_json(exchange.model_dump_json()) == exchange


def test_what_was_wrong_is_told_and_the_next_try_counts() -> None:
    bad = GOOD.replace("mpc", "mpd")
    found = answered(asked_of(in_turn(Spoken("I think."), Spoken(bad), Spoken(GOOD))))
    reason, refused, taken = found.exchanges
    assert refused.refused and refused.parsed is None and (refused.number, taken.number) == (1, 2)
    assert taken.messages[-2].content == bad and "the nearest is mpc" in taken.messages[-1].content


def test_three_tries_and_no_more() -> None:
    engine = Engine(PERSONAS["non_json"])
    found = unanswered(virtually(decided(engine)))
    assert (found.kind, len(found.exchanges)) == ("no-choice", 1 + MOST_TRIES)
    assert "no JSON" in found.text
    chats = [body for path, body in engine.requests if path == "/api/chat" and body["messages"]]
    thinking = [body.get("think") for body in chats]
    assert thinking == [False, False, None, None], "who ignores the form may think first"


def test_what_ends_without_a_word_is_asked_again_without_an_empty_message() -> None:
    engine = Engine(in_turn(Spoken(""), Spoken(""), Spoken(GOOD)))
    assert answered(virtually(decided(engine))).choice.option == "mpc"
    sent = [message for path, body in engine.requests if path == "/api/chat" for message in body["messages"]]
    assert all(message.get("content") for message in sent)


def test_after_a_broken_wire_the_same_is_asked_again() -> None:
    torn = Spoken(GOOD, end="hang-up", after_tokens=4)
    found = answered(asked_of(in_turn(Spoken("I think."), torn, Spoken(GOOD))))
    _, broken, taken = found.exchanges
    assert broken.failure == "broken" and GOOD.startswith(broken.raw) and broken.raw
    assert taken.messages == broken.messages


def test_reasons_that_never_end_do_not_keep_it_from_answering() -> None:
    found = answered(asked_of(in_turn(Spoken("and " * 3000), Spoken(GOOD))))
    reason, answer = found.exchanges
    assert reason.failure == "length" and [said.role for said in answer.messages] == ["system", "user", "user"]


@pytest.mark.parametrize("name", ["http_500", "silent_cut"])
def test_where_no_other_try_helps_there_is_none(name: str) -> None:
    found = unanswered(asked_of(name))
    assert found.kind in ("refused", "cut") and len(found.exchanges) == 1
    assert found.exchanges[0].refused == [found.text]


# time


@pytest.mark.parametrize("name", ["slow", "hung", "hung_mid_stream"])
def test_all_tries_together_have_the_time_for_one_answer(name: str) -> None:
    async def story() -> tuple[Answered | Unanswered, float]:
        began_s = asyncio.get_running_loop().time()
        return await decided(Engine(PERSONAS[name])), asyncio.get_running_loop().time() - began_s

    found, seconds = virtually(story())
    assert unanswered(found).kind == "late"
    assert seconds == pytest.approx(SETTINGS.answer_max_s)
    assert sum(one.seconds for one in found.exchanges) == pytest.approx(SETTINGS.answer_max_s)


def test_a_slow_model_that_ends_in_time_is_heard() -> None:
    slow_enough = SETTINGS.model_copy(update={"answer_max_s": 1000.0})
    found = answered(asked_of("slow", slow_enough))
    assert all(one.seconds == pytest.approx(2.0 * ((one.tokens_out or 0) - 1)) for one in found.exchanges)


def test_loading_has_a_time_of_its_own() -> None:
    assert asked_of("perfect", load_s=SETTINGS.load_max_s - 1.0).__class__ is Answered
    found = unanswered(asked_of("perfect", load_s=SETTINGS.load_max_s + 1.0))
    assert found.kind == "late" and found.exchanges == ()


# the context and the budget


def test_a_server_that_gives_less_context_is_not_asked() -> None:
    engine = Engine(PERSONAS["perfect"], most_context=4096)
    found = unanswered(virtually(decided(engine)))
    assert found.kind == "cut" and "4096" in found.text and "agents.context_tokens is 16384" in found.text
    assert not any(body["messages"] for path, body in engine.requests if path == "/api/chat")


def test_a_question_that_does_not_fit_is_not_sent() -> None:
    facts = ["0.123456789 " * 40] * 60
    engine = Engine(PERSONAS["perfect"])
    question = QUESTION.model_copy(update={"facts": facts})
    found = unanswered(virtually(decided(engine, question=question)))
    assert found.kind == "too-long" and "allowed: 14336" in found.text
    assert not any(body["messages"] for path, body in engine.requests if path == "/api/chat")


def test_a_task_has_its_tokens_and_no_more() -> None:
    async def story() -> tuple[list[Answered | Unanswered], Budget]:
        budget, engine = Budget(1500), Engine(PERSONAS["perfect"])
        return [await decided(engine, budget=budget) for _ in range(4)], budget

    found, budget = virtually(story())
    assert isinstance(found[0], Answered)
    last = unanswered(found[-1])
    assert last.kind == "spent" and "agents.task_max_tokens is 1500" in last.text and last.exchanges == ()
    counted = sum((one.tokens_in or 0) + (one.tokens_out or 0) for each in found for one in each.exchanges)
    assert budget.spent_tokens == counted >= 1500


@pytest.mark.parametrize("name", ["hung", "garbage", "error_mid_stream", "http_500"])
def test_what_fails_costs_too(name: str) -> None:
    async def story() -> Budget:
        budget = Budget(100_000)
        await decided(Engine(PERSONAS[name]), budget=budget)
        return budget

    assert virtually(story()).spent_tokens >= 100


def test_each_piece_is_heard_as_it_comes() -> None:
    async def story() -> tuple[list[str], Answered | Unanswered]:
        heard = list[str]()
        async with LanguageModel(SETTINGS, transport=InProcess(Engine(PERSONAS["perfect"]))) as model:
            found = await decide(model, PROMPT, QUESTION, budget=Budget(10_000), heard=heard.append)
        return heard, found

    heard, found = virtually(story())
    assert len(heard) > 10 and "".join(heard) == "".join(one.raw for one in found.exchanges)


# whatever comes


@pytest.mark.parametrize("name", sorted(PERSONAS))
@pytest.mark.parametrize("seed", range(4))
def test_no_persona_gives_a_choice_that_does_not_fit(name: str, seed: int) -> None:
    found = asked_of(name, seed=seed)
    if isinstance(found, Answered):
        assert wrong_with(found.choice, QUESTION) == []
    else:
        assert found.text


LINE = b'{"model":"m","created_at":"","message":{"role":"assistant","content":"a"},"done":%b}\n'
BODY = st.lists(
    st.binary(max_size=60)
    | st.sampled_from([LINE % b"false", LINE % b"true", LINE % b'"x"', b"[]\n", b"1\n", b"null\n", b'{"error":{}}\n',
                       b'{"error":"[]"}\n', b'{"message":[]}\n', b"\n", b"[" * 3000 + b"\n", b'"\\ud800"\n'])
    | st.builds(json.dumps, st.dictionaries(st.sampled_from(["message", "done", "error", "model", "eval_count"]),
                                            st.none() | st.integers() | st.text(max_size=3) | st.lists(st.none()))
                ).map(lambda text: text.encode() + b"\n"),
    max_size=5,
).map(b"".join)  # fmt: skip


@given(BODY)
def test_whatever_bytes_come_nothing_is_raised_and_nothing_wrong_chosen(body: bytes) -> None:
    found = asked_of(says("", raw=body or b"\n"))
    if isinstance(found, Answered):
        assert wrong_with(found.choice, QUESTION) == []


NEAR = st.dictionaries(
    st.sampled_from(["because", "option", "times_torque"]), st.text(max_size=4) | st.floats() | st.just("mpc")
).map(json.dumps)


@given(st.text(max_size=200) | NEAR)
def test_whatever_words_come_nothing_is_raised_and_nothing_wrong_chosen(text: str) -> None:
    found = asked_of(says(text))
    if isinstance(found, Answered):
        assert wrong_with(found.choice, QUESTION) == []


class Lying(InProcess):
    """Says `body` where `path` is asked for."""

    def __init__(self, path: str, body: bytes) -> None:
        super().__init__(Engine(PERSONAS["perfect"]))
        self._lie = path, body

    async def handle_async_request(self, request: httpx.Request) -> httpx.Response:
        path, body = self._lie
        if request.url.path == path:
            return httpx.Response(200, content=body)
        return await super().handle_async_request(request)


@given(body=BODY, path=st.sampled_from(["/api/version", "/api/tags", "/api/ps", "/api/show"]))
def test_whatever_the_server_says_of_itself_the_failure_is_one_exception(body: bytes, path: str) -> None:
    async def story() -> None:
        async with LanguageModel(SETTINGS, transport=Lying(path, body)) as model:
            try:
                await model.look()
            except NoAnswer as error:
                assert error.text

    virtually(story())
