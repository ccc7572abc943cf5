"""What an Ollama server says, as far as it is believed: of a model, and of an answer. Pure."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import ollama

from agents.language_model.no_answer import NoAnswer
from agents.language_model.tokens import least_tokens
from gateway.core.line import Agents
from gateway.core.line_problem import printable
from gateway.core.nearest import nearest

MOST_LISTED = 12  #: models that a message names
MOST_LETTERS_A_TOKEN = 32  #: more in an answer, and the server does not keep to num_predict
Role = Literal["system", "user", "assistant"]


@dataclass(frozen=True)
class Said:
    """A message of a conversation."""

    role: Role
    content: str


@dataclass(frozen=True)
class Served:
    """A model that the server has."""

    version: str  #: of the server
    model: str
    digest: str  #: says which weights these are; the name does not
    size_bytes: int | None
    loaded_context_tokens: int | None  #: with which it is in memory; 0: it is there, and the server does not say
    trained_context_tokens: int | None  #: the most that the model can have

    def check_context(self, settings: Agents) -> None:
        """Raises NoAnswer where the model has less than what is configured, by its making or by the server."""
        trained, loaded = self.trained_context_tokens or 0, self.loaded_context_tokens or 0
        has = min((count for count in (trained, loaded) if count), default=settings.context_tokens)
        if has < settings.context_tokens:
            text = f"{settings.url} gives {self.model} {has} tokens of context"
            raise NoAnswer("cut", f"{text}; agents.context_tokens is {settings.context_tokens}: set it to that or less")


@dataclass(frozen=True)
class Reply:
    """A whole answer."""

    text: str
    thinking: str
    tokens_in: int
    tokens_out: int
    seconds: float


class Collected:
    """An answer as it comes."""

    def __init__(self) -> None:
        self.text = ""
        self._thinking = ""
        self._pieces = 0
        self._last: ollama.ChatResponse | None = None

    def add(self, part: ollama.ChatResponse) -> str:
        """The text in `part`; none where the answer has already ended."""
        if self._last is not None and self._last.done:
            return ""
        piece, thought = _whole(part.message.content), _whole(part.message.thinking)
        self.text += piece
        self._thinking += thought
        self._pieces += bool(piece or thought)
        self._last = part
        return piece

    def tokens(self, messages: Sequence[Said]) -> int:
        """What it cost: as the server says at its end, else at least what was sent and has come."""
        counted = _count(self._last, "prompt_eval_count"), _count(self._last, "eval_count")
        return max(_floor(messages), counted[0]) + max(self._pieces, counted[1])

    def reply(self, messages: Sequence[Said], settings: Agents, seconds: float) -> Reply:
        """Raises NoAnswer where it is not whole, or not to what was sent."""
        last = self._last
        if last is None or not last.done:
            raise NoAnswer("broken", f"{settings.url}: the answer ended before its end", self.text)
        tokens_in, tokens_out = _count(last, "prompt_eval_count"), _count(last, "eval_count")
        longest = MOST_LETTERS_A_TOKEN * settings.answer_tokens
        if last.done_reason == "length" or len(self.text) + len(self._thinking) > longest:
            text = f"the answer was cut off at agents.answer_tokens ({settings.answer_tokens})"
            raise NoAnswer("length", text, self.text)
        if tokens_in < _floor(messages) or tokens_in + tokens_out > settings.context_tokens:
            text = f"the server read {tokens_in} tokens of at least {_floor(messages)} and wrote {tokens_out}, in a "
            raise NoAnswer("cut", f"{text}context of {settings.context_tokens}: it has cut the question", self.text)
        if not self.text.strip():
            raise NoAnswer("empty", f"{settings.model} ended without a word", self.text)
        return Reply(self.text, self._thinking, tokens_in, tokens_out, seconds)


def listed_model(settings: Agents, listed: ollama.ListResponse) -> ollama.ListResponse.Model:
    """The configured model among those that the server has. Raises NoAnswer where it has not."""
    wanted = full_name(settings.model)
    if wanted.rpartition(":")[2].endswith("cloud"):
        text = f"{settings.model} would be asked elsewhere; what is asked of this line stays on this network"
        raise NoAnswer("no-model", f"{text}: set agents.model to one that the server has itself")
    names = {full_name(one.model or ""): one for one in listed.models}
    if (found := names.get(wanted)) is not None:
        return found
    known = ", ".join(printable(name) for name in list(names)[:MOST_LISTED]) or "none"
    like = nearest(wanted, names)
    hint = f"; the nearest is {printable(like)}" if like else ""
    raise NoAnswer(
        "no-model",
        f"{settings.url} does not have {settings.model}; it has: {known}{hint}. `ollama pull {settings.model}` gets it",
    )


def served(
    settings: Agents,
    version: str,
    listed: ollama.ListResponse.Model,
    loaded: ollama.ProcessResponse,
    shown: ollama.ShowResponse,
) -> Served:
    """All that is known of the model `listed`."""
    return Served(
        version=printable(version),
        model=settings.model,
        digest=printable(listed.digest or ""),
        size_bytes=listed.size,
        loaded_context_tokens=loaded_context(settings.model, loaded),
        trained_context_tokens=_trained_context(shown),
    )


def loaded_context(model: str, loaded: ollama.ProcessResponse) -> int | None:
    """Tokens of context with which `model` is in memory; None where it is not, 0 where the server does not say."""
    for one in loaded.models:
        if full_name(one.model or one.name or "") == full_name(model):
            return max(one.context_length or 0, 0)
    return None


def full_name(model: str) -> str:
    """As the server has it: with the tag."""
    return model if ":" in model.rpartition("/")[2] else f"{model}:latest"


def _trained_context(shown: ollama.ShowResponse) -> int | None:
    for key, value in (shown.modelinfo or {}).items():
        if key.endswith(".context_length") and isinstance(value, int) and value > 0:
            return value
    return None


def _whole(text: str | None) -> str:
    """Without halves of characters, which no record could hold."""
    return (text or "").encode("utf-8", "replace").decode()


def _floor(messages: Sequence[Said]) -> int:
    return sum(least_tokens(said.content) for said in messages)


def _count(last: ollama.ChatResponse | None, which: Literal["prompt_eval_count", "eval_count"]) -> int:
    count = None if last is None else getattr(last, which)
    return count if isinstance(count, int) and count > 0 else 0
