"""The question what explains a change that was observed: its options are the failure modes of the notes that fit.

Pure but for the search. Detecting the change is not done here: whoever asks brings symptoms in words and figures.
"""

import re
from collections.abc import Awaitable, Callable, Sequence
from dataclasses import dataclass

from agents.rag.documents import Document
from agents.rag.notes import parts_of
from agents.rag.stages import Asked, Retrieval
from gateway.core.line import Line
from gateway.core.questions import Decision, Figure, Option, Question

DIAGNOSIS: Decision = "monitor.diagnosis"
NONE_OF_THEM = "none-of-them"
MOST_MODES = 6  #: that are offered
LOOKED_AT = 20  #: documents, of which failure modes are taken
CLEAR = 1.25  #: times the next one's score: a first mode that is a diagnosis by itself
MOST_SYMPTOMS = 16
MOST_ID = 60  #: letters of an option's name
LONGEST = 600  #: letters of a sentence in a question

Search = Callable[[Asked], Awaitable[Retrieval]]


@dataclass(frozen=True)
class Mode:
    """A failure mode that may explain what was observed. `share`: of the best one's score in the search, 0 to 1."""

    note: Document
    share: float

    @property
    def id(self) -> str:
        """As an option: a note that somebody has added may have any name."""
        return re.sub(r"[^a-z0-9]+", "-", self.note.name.lower()).strip("-")[:MOST_ID].strip("-") or "unnamed"


async def modes_for(search: Search, symptoms: Sequence[str], most: int = MOST_MODES) -> list[Mode]:
    """The likeliest first; none where no note has a word of the symptoms. Raises what the search raises."""
    found = await search(Asked(". ".join(symptoms), DIAGNOSIS, most=LOOKED_AT))
    ranked = [one for one in found.ranked if one.document.kind == "failure"][:most]
    return [Mode(one.document, one.score / ranked[0].score) for one in ranked]


def diagnosis_question(
    line: Line, symptoms: Sequence[str], figures: Sequence[Figure], modes: Sequence[Mode]
) -> Question:
    """What explains `symptoms`? `modes` as `modes_for` gives them. Raises ValueError without a symptom."""
    if not symptoms:
        raise ValueError("nothing was observed: there is nothing to explain")
    named: dict[str, Mode] = {}
    for one in modes:
        named.setdefault(one.id, one)  # of two with one name the better
    modes = list(named.values())
    usual, why = _usual(modes)
    told = [_sentence(f"observed: {one}") for one in symptoms[:MOST_SYMPTOMS]]
    return Question(
        format=1,
        decision=DIAGNOSIS,
        site=line.site,
        line=line.line,
        task="What explains what was observed on the line? A cause without a test that was made is one among several.",
        facts=[*told, *(fact for one in modes for fact in _facts(one))],
        figures=list(figures),
        options=[*map(_option, modes), _none_of_them()],
        usual=usual,
        why=why,
    )


def _usual(modes: Sequence[Mode]) -> tuple[str, str]:
    """What the rules choose: the first only where it is clearly before the next."""
    if not modes:
        return NONE_OF_THEM, "no failure mode that is known has anything of what was observed: a person looks at it"
    first = modes[0]
    second = modes[1].share if len(modes) > 1 else 0.0
    if first.share >= CLEAR * second:
        return first.id, f"of the failure modes that are known it fits best, by {_ahead(first.share, second)}"
    both = f"{first.id} and {modes[1].id}"
    return NONE_OF_THEM, f"{both} fit about as well: a test must tell them apart before anything is done"


def _ahead(first: float, second: float) -> str:
    return f"{first / second:.1f} times the next one" if second else "as the only one"


def _option(mode: Mode) -> Option:
    return Option(
        id=mode.id, title=mode.note.title[:LONGEST], figures=[Figure(name="fits, of the best", value=mode.share)]
    )


def _none_of_them() -> Option:
    return Option(id=NONE_OF_THEM, title="None of them by what is known now: a person looks at it, with the evidence")


def _facts(mode: Mode) -> list[str]:
    """What would be seen, and what tells it from others, as the note has them."""
    parts = parts_of(mode.note.text)
    return [
        _sentence(f"{mode.id}, {part.lower()}: {' '.join(parts[part].split())}")
        for part in ("Signature", "Test")
        if part in parts
    ]


def _sentence(text: str) -> str:
    return text if len(text) <= LONGEST else f"{text[: LONGEST - 4]} ..."
