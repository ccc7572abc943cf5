"""What the phases leave to somebody's judgement: a question with its options, and the choice that answers it. JSON.

Whoever answers - the rules, a language model - chooses among what the algorithms offer, and may turn the knobs that the
question names by factors within their bounds. An answer names nothing else: there is no way to say more torque, another
limit, or another line. What comes of it is a proposal like any other, which the gate judges.
"""

import json
from collections.abc import Mapping
from math import isfinite
from typing import Annotated, Literal, Self, get_args

from pydantic import Field, ValidationError, model_validator

from gateway.core.json_problems import NotJson, document_of, problems
from gateway.core.line import Name, Positive, Strict
from gateway.core.nearest import nearest
from gateway.core.topics import AgentName

Decision = Literal[
    "identify.data",
    "identify.experiment",
    "identify.structure",
    "identify.method",
    "identify.fidelity",
    "design.model",
    "design.architecture",
    "design.weights",
    "design.tuning",
    "design.selection",
    "adapt.diagnosis",
    "adapt.change",
    "adapt.convergence",
    "monitor.detect",
    "monitor.diagnosis",
    "monitor.action",
    "run.setpoint",
    "run.safety",
]
DECISIONS: tuple[Decision, ...] = get_args(Decision)
Sentence = Annotated[str, Field(min_length=1, max_length=600)]
OptionId = Annotated[str, Field(pattern=r"^[a-z0-9][a-z0-9_-]{0,63}$")]
MOST_BYTES = 65_536  #: of a question or a choice as JSON
AGENTS: dict[str, AgentName] = {
    "identify": "sysid",
    "design": "initial-control",
    "adapt": "adaptation",
    "monitor": "monitoring",
    "run": "monitoring",
}  #: who answers the decisions of a phase


class Figure(Strict):
    """A number that speaks for or against something. null: there is none, or it has no end."""

    name: Annotated[str, Field(min_length=1, max_length=80)]
    value: float | None
    unit: Annotated[str, Field(max_length=20)] = ""


def figure(name: str, value: float | None, unit: str = "") -> Figure:
    """With four digits: more say nothing. What is no finite number is not known."""
    known = None if value is None or not isfinite(value) else float(f"{value:.4g}")
    return Figure(name=name[:80], value=known, unit=unit)


class Option(Strict):
    id: OptionId
    title: Sentence
    figures: Annotated[list[Figure], Field(max_length=32)] = []


class Knob(Strict):
    """A number of the option that is chosen, turned by a factor. 1 leaves it."""

    name: OptionId
    meaning: Sentence  #: what more of it does
    least: Positive
    most: Positive
    of: Annotated[list[OptionId], Field(max_length=40)] = []  #: options that have it; nothing: all

    @model_validator(mode="after")
    def _check(self) -> Self:
        if not self.least <= 1.0 <= self.most:
            raise ValueError(f"least is {self.least:g} and most {self.most:g}; allowed: 1 between them")
        return self


class Question(Strict):
    """Everything on which to decide."""

    format: Annotated[int, Field(ge=1, le=1)]
    decision: Decision
    site: Name
    line: Name
    task: Sentence  #: what is to be decided
    facts: Annotated[list[Sentence], Field(max_length=64)] = []  #: what is known, in words with numbers
    figures: Annotated[list[Figure], Field(max_length=64)] = []  #: and in numbers alone
    options: Annotated[list[Option], Field(min_length=1, max_length=40)]
    usual: OptionId  #: what the rules choose
    why: Sentence  #: and why they do
    knobs: Annotated[list[Knob], Field(max_length=16)] = []
    run: Annotated[str, Field(pattern=r"^([0-9a-f]{16})?$")] = ""  #: of who asks, whose questions are one task

    @property
    def agent(self) -> AgentName:
        """Who answers it."""
        return AGENTS[self.decision.partition(".")[0]]

    @model_validator(mode="after")
    def _check(self) -> Self:
        for what, names in (("options", [one.id for one in self.options]), ("knobs", [one.name for one in self.knobs])):
            if twice := sorted({name for name in names if names.count(name) > 1}):
                raise ValueError(f"{what} has {', '.join(twice)} twice; allowed: each once")
        options = [one.id for one in self.options]
        if strange := sorted({name for knob in self.knobs for name in knob.of} - set(options)):
            raise ValueError(f"knobs are of {', '.join(strange)}; allowed: the options, {', '.join(options)}")
        if self.usual not in options:
            raise ValueError(f"usual is {self.usual}; allowed: one of the options")
        return self


class Choice(Strict):
    """An answer."""

    option: OptionId
    factors: dict[OptionId, Positive] = {}  #: by knob; what is not named stays
    reason: Annotated[str, Field(min_length=1, max_length=2000)]


class ChoiceRefused(Exception):
    """It answers no question, or not this one; `reasons` are all of them."""

    def __init__(self, reasons: list[str]) -> None:
        super().__init__("; ".join(reasons))
        self.reasons = reasons


def usual_choice(question: Question) -> Choice:
    """What the rules answer."""
    return Choice(option=question.usual, reason=question.why)


def factors_that_turn(choice: Choice) -> dict[str, float]:
    """Those other than 1, by knob."""
    return {name: factor for name, factor in choice.factors.items() if factor != 1.0}


def parse_choice(payload: bytes, question: Question) -> Choice:
    """The choice in `payload` (JSON), for `question`. Raises ChoiceRefused with every reason."""
    if len(payload) > MOST_BYTES:
        raise ChoiceRefused([f"it has {len(payload)} bytes; allowed: {MOST_BYTES}"])
    try:
        choice = Choice.model_validate(document_of(payload))
    except NotJson as error:
        raise ChoiceRefused([str(error)]) from error
    except ValidationError as error:
        raise ChoiceRefused(problems(error, Choice)) from error
    if against := wrong_with(choice, question):
        raise ChoiceRefused(against)
    return choice


def wrong_with(choice: Choice, question: Question) -> list[str]:
    """Why `choice` is no answer to `question`; empty: it is one."""
    options = [one.id for one in question.options]
    against = [] if choice.option in options else [_unknown("option", choice.option, options)]
    knobs = {one.name: one for one in question.knobs if choice.option in one.of or not one.of}
    return against + _wrong_factors(choice.factors, knobs)


def _wrong_factors(factors: Mapping[str, float], knobs: Mapping[str, Knob]) -> list[str]:
    against: list[str] = []
    for name, factor in factors.items():
        if (knob := knobs.get(name)) is None:
            against.append(_unknown("factors names", name, list(knobs)))
        elif not knob.least <= factor <= knob.most:
            against.append(f"factors.{name} is {factor:g}; allowed: {knob.least:g} to {knob.most:g}")
    return against


def _unknown(what: str, name: str, allowed: list[str]) -> str:
    like = nearest(name, allowed)
    hint = f"; the nearest is {like}" if like else ""
    return f"{what} is {name}; allowed: {', '.join(allowed) or 'none'}{hint}"


def question_json(question: Question) -> str:
    """As a model is shown it: one line, keys in the order in which they are declared: so it reads as it is meant."""
    return json.dumps(question.model_dump(mode="json", exclude={"run"}), allow_nan=False)
