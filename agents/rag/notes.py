"""A note of the knowledge: Markdown behind a head in TOML, which stands between two lines of +++. Pure.

    +++
    title = "Eccentric roller: tension swings once per turn"
    tier = 2
    ...
    +++

    One idea: why it is so, what it does to the line, and what to do about it.

Tier 1 is control theory, tier 2 practice of roll-to-roll lines, tier 3 what is known of this line. A note names the
decisions that it serves: one that serves none is of no use to anybody who decides.
"""

import re
import tomllib
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Annotated, Literal, Self

from pydantic import Field, ValidationError, model_validator

from gateway.core.json_problems import problems
from gateway.core.line import Fraction, Strict
from gateway.core.questions import Decision
from gateway.core.toml_places import line_of, places
from gateway.core.toml_syntax import syntax_problem

FaultClass = Literal["material", "mechanical", "sensor", "environment", "process", "drive"]
Words = Annotated[str, Field(min_length=1, max_length=300)]
FENCE = "+++"
PARTS = ("Symptom", "Signature", "Test", "Action")  #: of a failure mode, in this order
_PART = re.compile(r"^## (.+)$", re.MULTILINE)


class NoteRefused(Exception):
    """A text is no note; `reasons` are all of them."""

    def __init__(self, name: str, reasons: Sequence[str]) -> None:
        super().__init__(f"{name}: {'; '.join(reasons)}")
        self.reasons = list(reasons)


class Head(Strict):
    """What is known of a note without reading it."""

    title: Words
    tier: Literal[1, 2, 3]
    topic: Words
    sources: Annotated[list[Words], Field(min_length=1)]
    confidence: Fraction  #: how sure it is, for what it applies to
    applies_to: Words
    serves: Annotated[list[Decision], Field(min_length=1)]
    keywords: Annotated[list[Words], Field(min_length=1)]
    asked: list[Words] = []  #: questions that it answers, as people put them: in other words than its own
    kind: Literal["note", "failure"] = "note"
    fault_class: Annotated[FaultClass | None, Field(alias="class")] = None
    adjustable: bool | None = None  #: whether set-points or control can answer it, without hands
    date: Annotated[str | None, Field(pattern=r"^\d{4}-\d{2}-\d{2}$")] = None  #: from when it is
    replaces: list[Words] = []  #: names of notes that it stands in place of
    contradicts: list[Words] = []  #: names of notes that say otherwise

    @model_validator(mode="after")
    def _check(self) -> Self:
        told = (self.fault_class is not None, self.adjustable is not None)
        if told != (self.kind == "failure",) * 2:
            raise ValueError("class and adjustable are for notes of kind failure, and those have both")
        return self


@dataclass(frozen=True)
class Note:
    """`name`: of its file, without the ending."""

    name: str
    head: Head
    text: str  #: Markdown

    @property
    def parts(self) -> dict[str, str]:
        """Of a failure mode, by heading: symptom, signature, test, action."""
        return parts_of(self.text)


def parts_of(text: str) -> dict[str, str]:
    """Of Markdown, by heading of the second level."""
    pieces = _PART.split(text)
    return {title.strip(): part.strip() for title, part in zip(pieces[1::2], pieces[2::2], strict=True)}


def parse_note(name: str, content: str) -> Note:
    """Raises NoteRefused with every reason."""
    begin, found, rest = content.partition(f"{FENCE}\n")
    head, ended, text = rest.partition(f"\n{FENCE}\n")
    if begin or not found or not ended:
        raise NoteRefused(name, [f"it does not begin with a head between two lines of {FENCE}"])
    try:
        document = tomllib.loads(head)
    except (ValueError, RecursionError) as error:
        wrong = syntax_problem(error, head, name)
        raise NoteRefused(name, [f"line {wrong.line + 1}: its head: {wrong.wrong}"]) from error
    try:
        note = Note(name, Head.model_validate(document), text.strip())
    except ValidationError as error:
        raise NoteRefused(name, _mistakes(error, head)) from error
    if not note.text:
        raise NoteRefused(name, ["it has a head and no text"])
    if note.head.kind == "failure" and tuple(note.parts) != PARTS:
        raise NoteRefused(name, [f"its headings are {', '.join(note.parts) or 'none'}; allowed: {', '.join(PARTS)}"])
    return note


def _mistakes(error: ValidationError, head: str) -> list[str]:
    """Each with its line in the note; the head begins on the second."""
    where = places(head)
    lines = [line_of(where, one["loc"]) + 1 for one in error.errors(include_url=False)]
    words = problems(error, Head)
    return [f"line {line}: {one}" for line, one in zip(lines, words, strict=False)] + words[len(lines) :]
