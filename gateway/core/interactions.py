"""What is known of one question that was asked of an agent: who, what, with which knowledge, what came of it. JSON.

The Code agent is asked no question, but to compute: then it says for whom and for what, and every call with its result.

The record of checklist "every interaction is logged": an agent makes it, the gateway keeps it, people read it.
"""

import zlib
from typing import Annotated, Any, Literal, NamedTuple, Self

from pydantic import Field, ValidationError, model_validator

from gateway.core.computations import MOST_CALLS, By, Computed
from gateway.core.json_problems import NotJson, document_of, problems
from gateway.core.line import NonNegative, Strict
from gateway.core.line_model import Instant
from gateway.core.questions import Choice, Question

MOST_BYTES = 1024 * 1024  #: of an interaction as JSON, unpacked
MOST_PACKED = 240 * 1024  #: bytes: it travels in one message of the bus (gateway/mailbox/port.py, MAX_PAYLOAD)
MOST_WHY = 400  #: letters


class Note(Strict):
    """A passage that the agent was shown."""

    key: str  #: of its document
    title: str
    tier: Literal[1, 2, 3]
    score: float
    passage: str
    overruled_by: list[str] = []
    speaks_to_a_model: list[str] = []  #: why it was marked as an instruction in disguise


class Answer(Strict):
    """To a question: the choice, and how it came about."""

    choice: Choice
    by: By  #: the agent's name; "rules" where no language model has answered
    instead: Annotated[str, Field(max_length=1000)] = ""  #: why the rules, where a model was asked
    interaction: Annotated[str, Field(pattern=r"^([0-9a-f]{16})?$")] = ""  #: its id in the log


class Unanswered(Strict):
    """A question that a phase has decided by the rules, because the agent it asked did not answer it."""

    question: Question
    why: Annotated[str, Field(min_length=1, max_length=MOST_WHY)]


class Interaction(Strict):
    format: Annotated[int, Field(ge=1, le=1)]
    id: Annotated[str, Field(pattern=r"^[0-9a-f]{16}$")]
    agent: By
    at: Instant
    question: Question | None = None  #: with `answer`; null: it was asked to compute
    notes: Annotated[list[Note], Field(max_length=40)] = []
    conflicts: Annotated[list[str], Field(max_length=100)] = []  #: among what was found, each with its rule
    prompt: str  #: SHA-256 of the agent's prompt
    model: str = ""  #: of the language model, with its digest; empty: none was asked
    #: Every call of the model, in its order, with what was computed for it.
    exchanges: Annotated[list[dict[str, Any]], Field(max_length=16)] = []
    answer: Answer | None = None
    asked_by: Annotated[str, Field(max_length=64)] = ""  #: of what was computed: an agent, or a phase
    task: Annotated[str, Field(max_length=600)] = ""  #: and for what
    computations: Annotated[list[Computed], Field(max_length=MOST_CALLS)] = []
    tokens_in: int = 0
    tokens_out: int = 0
    seconds: NonNegative

    @model_validator(mode="after")
    def _check(self) -> Self:
        if (self.question is None) is not (self.answer is None):
            raise ValueError("there is a question without an answer, or an answer without one; allowed: both or none")
        if (self.question is None) is not bool(self.computations and self.asked_by and self.task):
            raise ValueError("allowed: a question, or computations with asked_by and task, and not both")
        return self

    @property
    def in_short(self) -> "InShort":
        if self.question is not None and self.answer is not None:
            answer = self.answer
            return InShort(self.question.decision, answer.choice.option, answer.by, answer.instead)
        named = ", ".join(one.kind for one in self.computations)
        against = [one.refused[0] if one.refused else one.failed for one in self.computations if not one.done]
        return InShort("compute", f"{named} for {self.asked_by}", self.agent, "; ".join(against)[:1000])


class InShort(NamedTuple):
    """An interaction in a row of a table."""

    decision: str
    chosen: str  #: the option; the calls
    by: str
    instead: str  #: why the rules; what was not computed


class InteractionRefused(Exception):
    """Bytes that are no interaction; `reasons` are all of them."""

    def __init__(self, reasons: list[str]) -> None:
        super().__init__("; ".join(reasons))
        self.reasons = reasons


def pack(interaction: Interaction) -> bytes:
    """As it travels and is kept: JSON, compressed."""
    return zlib.compress(interaction.model_dump_json().encode())


def fits(interaction: Interaction) -> bool:
    """Whether it can be sent to the gateway and kept there."""
    text = interaction.model_dump_json().encode()
    return len(text) <= MOST_BYTES and len(zlib.compress(text)) <= MOST_PACKED


def unpack(packed: bytes) -> Interaction:
    """Raises InteractionRefused. What unpacks to more than `MOST_BYTES` is not unpacked further."""
    unpacker = zlib.decompressobj()
    try:
        text = unpacker.decompress(packed, MOST_BYTES)
    except zlib.error as error:
        raise InteractionRefused([f"it is not compressed as it should be: {error}"]) from error
    if not unpacker.eof or unpacker.unused_data:
        raise InteractionRefused([f"it is cut off, or has more than {MOST_BYTES} bytes unpacked"])
    try:
        return Interaction.model_validate(document_of(text))
    except NotJson as error:
        raise InteractionRefused([str(error)]) from error
    except ValidationError as error:
        raise InteractionRefused(problems(error, Interaction)) from error
