"""What a proposal says it rests on, out of the agents' log: what was asked before it was made, and with which notes.

Who decides reads it as a quotation: the gateway has kept these words, it has not written them.
"""

from collections.abc import Sequence
from typing import Annotated, Literal

from pydantic import Field

from gateway.core.line import Strict
from gateway.core.line_model import Digest
from gateway.core.proposal import Evidence

ASKED = "interaction "  #: how the evidence begins that names a question to an agent, by its id in the log
MOST_ASKED = 8  #: questions of a proposal that are told; more than that nobody reads
MOST_NOTES = 12
MOST_TITLE = 200  #: letters
MOST_PASSAGE = 600


def asked(interaction: str) -> Evidence:
    """A question that was asked before the proposal was made."""
    return Evidence(what=f"{ASKED}{interaction}")


def interactions_of(evidence: Sequence[Evidence]) -> list[str]:
    """Ids of what was asked before a proposal was made."""
    return [one.what.removeprefix(ASKED) for one in evidence if one.what.startswith(ASKED)]


class ShowAsked(Strict):
    proposal: Digest


class Before(Strict):
    """A question that was answered before the proposal was made."""

    interaction: str  #: its id in the log, as `r2rgate log` takes it
    agent: str  #: whose log it is in, as the gateway knows it
    task: str
    chosen: str  #: title of the option
    by_rules: bool  #: not by a language model
    instead: str  #: why the rules, where a language model was asked


class NoteBefore(Strict):
    """A passage that was looked up for one of the questions."""

    key: str
    title: str
    tier: Literal[1, 2, 3]
    passage: str  #: its begin, where it is long
    overruled_by: list[str]  #: keys of what says otherwise, and counts for more
    speaks_to_a_model: bool  #: it reads as an instruction to whoever reads it


class AskedTold(Strict):
    format: Annotated[int, Field(ge=1, le=1)]
    proposal: Digest
    asked: list[Before]  #: in the order in which the proposal names them
    notes: list[NoteBefore]  #: each once, what fitted best first
    missing: list[str]  #: sentences: what it names and nobody finds
