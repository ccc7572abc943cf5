"""Documents that were found together and say different things: which of them counts. Pure.

Two are in conflict where the head of one says so (`replaces`, `contradicts`), or where a sentence of each gives, about
the same thing, one figure of the same kind, and the figures lie apart. Sentences are about the same thing where most
words of the shorter one are in the other; of documents that share neither topic nor words in title and keywords, most
of the longer one. What is known of this line counts before practice, practice before theory; in one
tier the newer before the older, then the surer one. The rule is coarse, and says on what it stands: it shows people and
models where to look, and takes nothing out of their sight.
"""

import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import combinations, product

from agents.rag.documents import Document
from agents.rag.stages import Conflict
from agents.rag.words import left_out, stems

APART = 1.5  #: between the nearest ends of two ranges
ALIKE = 0.75  #: of the words of one sentence that are in the other too
LEAST_SHARED, LEAST_SHARED_ELSEWHERE = 2, 3  #: words; the latter of documents that share nothing else
SHORTEST = 3  #: letters of a word; symbols say nothing by themselves
MOST_SENTENCE = 40  #: words; a longer one is about more than one thing

#: Units by what they measure, with the factor to one of them.
_UNITS: dict[str, tuple[str, float]] = {
    "N": ("force", 1.0), "kN": ("force", 1e3), "N/m": ("force over width", 1.0), "N/mm": ("force over width", 1e3),
    "Nm": ("torque", 1.0), "Nm/s": ("torque rate", 1.0), "MPa": ("stress", 1.0), "GPa": ("stress", 1e3),
    "m/s": ("speed", 1.0), "m/min": ("speed", 1 / 60), "mm/s": ("speed", 1e-3), "rad/s": ("angular speed", 1.0),
    "rpm": ("angular speed", 0.10472), "Hz": ("frequency", 1.0), "kHz": ("frequency", 1e3),
    "s": ("time", 1.0), "ms": ("time", 1e-3), "min": ("time", 60.0), "h": ("time", 3600.0), "µs": ("time", 1e-6),
    "m": ("length", 1.0), "mm": ("length", 1e-3), "cm": ("length", 1e-2), "µm": ("length", 1e-6),
    "kg": ("mass", 1.0), "g": ("mass", 1e-3), "°C": ("temperature", 1.0), "%": ("share", 1.0), "bar": ("pressure", 1.0),
    "°": ("angle", 1.0), "kW": ("power", 1e3), "W": ("power", 1.0),
}  # fmt: skip
_NUMBER = r"(?:\d{1,3}(?:,\d{3})+|\d+)(?:\.\d+)?"
_UNIT = "|".join(sorted(map(re.escape, _UNITS), key=len, reverse=True))
_FIGURE = re.compile(
    rf"(?<![\w.^/])(?P<low>{_NUMBER})(?:\s*(?:-|–|to|and|\.\.)\s*(?P<high>{_NUMBER}))?\s?(?P<unit>{_UNIT})(?![\w/²³^])"
)
_SENTENCE = re.compile(r"(?<=[.;!?])\s+|\n+")


@dataclass(frozen=True)
class Statement:
    """A sentence with one figure: `words` it is about, and from `low` to `high` of a `measure`."""

    text: str
    words: frozenset[str]
    measure: str
    low: float
    high: float


def statements_in(text: str) -> list[Statement]:
    """Of sentences with more than one figure none: it cannot be said which is of what."""
    return [one for sentence in _SENTENCE.split(text) for one in _statement(sentence.strip())]


def conflicts_among(found: Sequence[tuple[Document, str]]) -> list[Conflict]:
    """Among documents in the order in which they were found, each with what of its text is looked at."""
    read = [_Read(document, text) for document, text in found]
    return [conflict for a, b in combinations(read, 2) for conflict in _between(a, b)]


def counts_more(first: Document, second: Document) -> tuple[Document, Document, str]:
    """The one that counts, the other, and why. `first` was found before `second`."""
    for winner, loser in ((first, second), (second, first)):
        if loser.name in winner.replaces:
            return winner, loser, f"{winner.name} says that it replaces {loser.name}"
    if first.tier != second.tier:
        winner, loser = sorted((first, second), key=lambda one: -one.tier)
        return winner, loser, f"tier {winner.tier} counts before tier {loser.tier}"
    if first.date and second.date and first.date != second.date:
        winner, loser = sorted((first, second), key=lambda one: one.date, reverse=True)
        return winner, loser, f"the newer one, of {winner.date} against {loser.date}"
    if first.confidence != second.confidence:
        winner, loser = sorted((first, second), key=lambda one: -one.confidence)
        return winner, loser, f"the surer one, {winner.confidence:g} against {loser.confidence:g}"
    return first, second, "neither is newer or surer: the one that answers the question better"


class _Read:
    """A document with what is looked for in it, each found once and only where it is needed."""

    def __init__(self, document: Document, text: str) -> None:
        self.document = document
        self._text = text

    @cached_property
    def subject(self) -> frozenset[str]:
        return frozenset(stems(f"{self.document.title} {' '.join(self.document.keywords)}")) - left_out()

    @cached_property
    def statements(self) -> list[Statement]:
        return statements_in(self._text)


def _between(a: _Read, b: _Read) -> Iterator[Conflict]:
    first, second = a.document, b.document
    winner, loser, rule = counts_more(first, second)
    for one, other in ((first, second), (second, first)):
        if other.name in one.replaces or other.name in one.contradicts:
            said = "replaces" if other.name in one.replaces else "contradicts"
            text = f"its head says that it {said} {other.name}"
            yield Conflict(winner.key, loser.key, rule, *((text, "") if one is winner else ("", text)))
            return
    related = first.topic == second.topic != "" or len(a.subject & b.subject) >= LEAST_SHARED
    pairs = product(a.statements, b.statements)
    if apart := next(((x, y) for x, y in pairs if _say_different(x, y, related)), None):
        said_first, said_second = (one.text for one in apart)
        both = (said_first, said_second) if winner is first else (said_second, said_first)
        yield Conflict(winner.key, loser.key, rule, *both)


def _say_different(a: Statement, b: Statement, related: bool) -> bool:
    if a.measure != b.measure or not (a.low > APART * b.high or b.low > APART * a.high):
        return False
    shared, lengths = len(a.words & b.words), (len(a.words), len(b.words))
    if related:
        return shared >= max(LEAST_SHARED, ALIKE * min(lengths))
    return shared >= max(LEAST_SHARED_ELSEWHERE, ALIKE * max(lengths))


def _statement(sentence: str) -> Iterator[Statement]:
    figures = list(_FIGURE.finditer(sentence))
    if len(figures) != 1 or len(sentence.split()) > MOST_SENTENCE:
        return
    found = figures[0]
    measure, factor = _UNITS[found["unit"]]
    low, high = sorted(_value(found[end] or found["low"]) * factor for end in ("low", "high"))
    rest = f"{sentence[: found.start()]} {sentence[found.end() :]}"
    words = frozenset(word for word in stems(rest) if len(word) >= SHORTEST and word.isalpha()) - left_out()
    yield Statement(sentence, words, measure, low, high)


def _value(number: str) -> float:
    return float(number.replace(",", ""))
