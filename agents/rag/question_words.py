"""What a question asks for: its words, each with those of the field that stand for it (glossary.toml)."""

import tomllib
from collections import defaultdict
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cache
from pathlib import Path

from agents.rag.words import left_out, stems

AKIN = 0.6  #: of two words of a group of which neither is its first
EXPANDED = 0.4  #: weight of a word that stands for one of the question, against that word itself
PHRASE = 0.5  #: weight of a phrase of the glossary in a question, beside its single words
MOST_STEMS = 60  #: of a question; what is longer is asked by its first words
Phrase = tuple[str, ...]  #: stems that follow one another


@dataclass(frozen=True)
class Concept:
    """One thing that a question speaks of."""

    said: Phrase
    weight: float
    expanded: tuple[tuple[Phrase, float], ...]  #: what stands for it, with its weight against `said`

    @property
    def phrases(self) -> Iterator[tuple[Phrase, float]]:
        yield self.said, 1.0
        yield from self.expanded


def concepts_of(question: str) -> list[Concept]:
    """In the order of the question; empty where every word of it is left out."""
    words = stems(question)[:MOST_STEMS]
    known = _glossary()
    longest = max(map(len, known))
    found: dict[Phrase, Concept] = {}
    for length in range(1, longest + 1):
        for start in range(len(words) - length + 1):
            said = tuple(words[start : start + length])
            if said[0] not in left_out() if length == 1 else said in known:
                expanded = tuple((phrase, EXPANDED * likeness) for phrase, likeness in known.get(said, {}).items())
                found.setdefault(said, Concept(said, 1.0 if length == 1 else PHRASE, expanded))
    return list(found.values())


@cache
def _glossary() -> dict[Phrase, dict[Phrase, float]]:
    """By phrase, what stands for it and how well."""
    text = Path(__file__).with_name("glossary.toml").read_text(encoding="utf-8")
    groups: list[list[str]] = tomllib.loads(text)["groups"]
    known: dict[Phrase, dict[Phrase, float]] = defaultdict(dict)
    for group in groups:
        phrases = [tuple(stems(word)) for word in group]
        for a in phrases:
            for b in phrases:
                if a != b:
                    likeness = 1.0 if phrases[0] in (a, b) else AKIN
                    known[a][b] = max(known[a].get(b, 0.0), likeness)
    return dict(known)
