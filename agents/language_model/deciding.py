"""A question asked of a language model: it reasons freely, may have something computed, and answers in the form, with
three tries at most. Nothing that `wrong_with` refuses comes out of here, and no failure but as `Unanswered`; the caller
then goes on by the rules.
"""

from collections.abc import Awaitable, Callable, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any, Literal

from agents.code.calls import CallRefused
from agents.language_model.asking import (
    MOST_REPEATED,
    Passage,
    again_message,
    answer_format,
    first_messages,
    form_message,
    read_answer,
)
from agents.language_model.budget import Budget
from agents.language_model.client import Heard, LanguageModel
from agents.language_model.computing import calls_format, calls_message, read_calls, results_message
from agents.language_model.no_answer import Kind, NoAnswer
from agents.language_model.replies import Said
from gateway.core.computations import Computed
from gateway.core.line import NonNegative, Strict
from gateway.core.questions import Choice, ChoiceRefused, Question

MOST_TRIES = 3  #: of an answer in the form
COMPUTING_SHARE = 0.5  #: of the time that is left, for asking what to compute and for doing it: the answer needs some
#: Calls, unread, and the seconds that there are; one result for each. Raises nothing.
Compute = Callable[[Sequence[Any], float], Awaitable[list[Computed]]]
#: Another try may go better: what came was cut off, torn or nothing.
WORTH_ANOTHER_TRY: frozenset[Kind] = frozenset({"length", "broken", "empty"})
#: After which the model is not asked anything more.
GONE: frozenset[Kind] = frozenset({"absent", "no-model"})


class Exchange(Strict):
    """One call of the model and all that came of it."""

    purpose: Literal["reason", "compute", "answer"]
    number: int  #: of this purpose, from 1
    model: str
    digest: str  #: of its weights
    messages: list[Said]  #: as they were sent
    raw: str  #: the answer, byte for byte; of a failure, what had come
    thinking: str = ""  #: apart from the answer, of models that do that
    parsed: Choice | None = None
    computed: list[Computed] = []  #: what it has asked for, and what came of it
    refused: list[str] = []  #: why it is no answer
    failure: Kind | None = None  #: where there is no whole answer
    tokens_in: int | None = None
    tokens_out: int | None = None
    seconds: NonNegative


@dataclass(frozen=True)
class Answered:
    choice: Choice
    exchanges: tuple[Exchange, ...]


@dataclass(frozen=True)
class Unanswered:
    """`text` says why, in a sentence."""

    kind: Kind
    text: str
    exchanges: tuple[Exchange, ...]


async def decide(
    model: LanguageModel,
    prompt: str,
    question: Question,
    knowledge: Sequence[Passage] = (),
    *,
    budget: Budget,
    heard: Heard | None = None,
    compute: Compute | None = None,
) -> Answered | Unanswered:
    """What `model` chooses, with every exchange.

    `prompt`: the system's message. `budget`: of the task that the question belongs to. `heard` is told each piece of
    what the model says. `compute` carries out what the model wants computed; None: nothing. The model's settings bound
    the time, `load_max_s` to be ready, then `answer_max_s` for all, and the calls, `computations_max`.
    """
    conversation: _Conversation | None = None
    try:
        budget.check()
        ready = await model.ready()
        conversation = _Conversation(model, ready.digest, budget, heard)
        base = first_messages(prompt, question, knowledge)
        reasons = await conversation.reasons(base)
        told = [*base, *([Said("assistant", reasons)] if reasons else [])]
        choice = await conversation.answer_with(compute, told, question)
    except NoAnswer as error:
        return Unanswered(error.kind, error.text, tuple(conversation.exchanges) if conversation else ())
    return Answered(choice, tuple(conversation.exchanges))


def _told_again(messages: list[Said], said: Exchange) -> list[Said]:
    """The same, with what was wrong; a wire that broke is nothing that the model could do better."""
    if said.failure == "broken":
        return messages
    repeated = [Said("assistant", said.raw[:MOST_REPEATED])] if said.raw.strip() else []
    return [*messages, *repeated, again_message(said.refused)]


class _Conversation:
    """The calls of one question, and the time that is left for them."""

    def __init__(self, model: LanguageModel, digest: str, budget: Budget, heard: Heard | None) -> None:
        self.exchanges: list[Exchange] = []
        self._model = model
        self._digest = digest
        self._budget = budget
        self._heard = heard
        self._until_s = model.now_s() + model.settings.answer_max_s

    async def reasons(self, messages: list[Said]) -> str:
        """What the model thinks of the question; "" where that has no end: it may answer all the same."""
        said = await self._call("reason", 1, messages)
        return "" if said.failure else said.raw

    async def answer_with(self, compute: Compute | None, told: list[Said], question: Question) -> Choice:
        """After what it wants computed; without it where it does not fit into the context. Raises NoAnswer."""
        form = form_message(question)
        more = told if compute is None else await self.computations(told, compute)
        try:
            return await self.answer([*more, form], question)
        except NoAnswer as error:
            if error.kind != "too-long" or more is told:
                raise
        return await self.answer([*told, form], question)

    async def computations(self, messages: list[Said], compute: Compute) -> list[Said]:
        """`messages`, with what the model has had computed. Each call costs one of those that it may ask for, as does a
        list that is none; what is wrong is told, and it may ask again while there are some left. What fails here ends
        the computations, not the answer. Raises NoAnswer where the model is not there any more."""
        left, number = self._model.settings.computations_max, 0
        now_s = self._model.now_s()
        until_s = now_s + COMPUTING_SHARE * (self._until_s - now_s)
        while left > 0:
            number += 1
            asked = [*messages, calls_message(left, first=number == 1)]
            try:
                said = await self._call("compute", number, asked, calls_format(left), _refused_calls, until_s=until_s)
            except NoAnswer as error:
                if error.kind in GONE:
                    raise
                return messages
            calls = [] if said.failure or said.refused else read_calls(said.raw)
            if said.failure or not (calls or said.refused):
                return messages
            refused = list(said.refused)
            if len(calls) > left:
                refused.append(f"{len(calls)} calls were asked for; allowed: {left}")
            results = await self._computed(calls[:left], compute, until_s)
            messages = [*asked, Said("assistant", said.raw[:MOST_REPEATED]), results_message(results, refused)]
            left -= max(len(calls), 1)
            if not refused and all(one.done for one in results):
                break
        return messages

    async def _computed(self, calls: Sequence[Any], compute: Compute, until_s: float) -> list[Computed]:
        """Kept beside the exchange that has asked for it."""
        if not calls:
            return []
        results = await compute(calls, max(until_s - self._model.now_s(), 0.0))
        self.exchanges[-1] = self.exchanges[-1].model_copy(update={"computed": results})
        return results

    async def answer(self, messages: list[Said], question: Question) -> Choice:
        """Raises NoAnswer when no try is one."""
        form = answer_format(question)
        told, think, refused = messages, False, list[str]()
        for number in range(1, MOST_TRIES + 1):
            said = await self._call("answer", number, told, form, partial(_read, question), think)
            if said.parsed is not None:
                return said.parsed
            refused = said.refused
            told = _told_again(messages, said)
            if not said.raw.lstrip().startswith("{"):
                think = None  # some engines keep to the form only where the model may think first
        raise NoAnswer("no-choice", f"{MOST_TRIES} tries gave no answer; the last: {'; '.join(refused)}")

    async def _call(
        self,
        purpose: Literal["reason", "compute", "answer"],
        number: int,
        messages: list[Said],
        form: dict[str, Any] | None = None,
        read: Callable[[str], dict[str, Any]] = lambda text: {},
        think: bool | None = False,
        until_s: float | None = None,
    ) -> Exchange:
        """One exchange, kept, with what `read` finds in the answer. Raises NoAnswer where no other try helps."""
        began_s = self._model.now_s()
        failed: NoAnswer | None = None
        try:
            left_s = (self._until_s if until_s is None else until_s) - began_s
            reply = await self._model.chat(messages, left_s, self._budget, form, think, self._heard)
            came: dict[str, Any] = {"raw": reply.text, "thinking": reply.thinking}
            came |= {"tokens_in": reply.tokens_in, "tokens_out": reply.tokens_out}
            came |= read(reply.text)
        except NoAnswer as error:
            failed = error
            came = {"raw": error.so_far, "failure": error.kind, "refused": [error.text]}
        self.exchanges.append(
            Exchange(
                purpose=purpose,
                number=number,
                model=self._model.settings.model,
                digest=self._digest,
                messages=messages,
                seconds=self._model.now_s() - began_s,
                **came,
            )
        )
        if failed is not None and failed.kind not in WORTH_ANOTHER_TRY:
            raise failed
        return self.exchanges[-1]


def _refused_calls(text: str) -> dict[str, Any]:
    try:
        read_calls(text)
        return {}
    except CallRefused as refused:
        return {"refused": refused.reasons}


def _read(question: Question, text: str) -> dict[str, Any]:
    try:
        return {"parsed": read_answer(text, question)}
    except ChoiceRefused as refused:
        return {"refused": refused.reasons}
