"""Documents in passages short enough to be found by what they say. Pure.

A passage ends with its section, or at the paragraph with which it would become too long. A paragraph that is too long
by itself is cut at the end of a sentence, and only there the next passage repeats the words before.
"""

import re
from collections.abc import Iterator
from dataclasses import dataclass

MOST_WORDS = 130  #: of a passage; an embedding model of 256 word pieces reads all of it
OVERLAP_WORDS = 20  #: repeated where a paragraph is cut
_HEADING = re.compile(r"^#{1,6}\s+(.*?)\s*#*\s*$", re.MULTILINE)
_PARAGRAPH = re.compile(r"\n\s*\n")
_SENTENCE_END = re.compile(r"[.;:!?]$")


@dataclass(frozen=True)
class Chunk:
    """A passage under a heading of its document; both empty: the document has none."""

    heading: str
    text: str


def chunks_of(text: str) -> list[Chunk]:
    """In the order of the text; without any words there are none."""
    return [
        Chunk(heading, passage) for heading, section in _sections(text) for passage in _packed(list(_pieces(section)))
    ]


def _sections(text: str) -> Iterator[tuple[str, str]]:
    pieces = _HEADING.split(text)
    yield "", pieces[0]
    yield from zip(pieces[1::2], pieces[2::2], strict=True)


def _pieces(section: str) -> Iterator[str]:
    """Its paragraphs, each short enough."""
    for paragraph in _PARAGRAPH.split(section):
        if len(paragraph.split()) <= MOST_WORDS:
            yield from [paragraph.strip()] if paragraph.strip() else []
        else:
            yield from _cut(paragraph.split())


def _cut(words: list[str]) -> Iterator[str]:
    start = 0
    while len(words) - start > MOST_WORDS:
        end = _end_of_sentence(words, start + MOST_WORDS // 2, start + MOST_WORDS)
        yield " ".join(words[start:end])
        start = end - OVERLAP_WORDS
    yield " ".join(words[start:])


def _end_of_sentence(words: list[str], least: int, most: int) -> int:
    """The last one between the two; without any, the most."""
    return next((end for end in range(most, least, -1) if _SENTENCE_END.search(words[end - 1])), most)


def _packed(pieces: list[str]) -> Iterator[str]:
    packed: list[str] = []
    words = 0
    for piece in pieces:
        count = len(piece.split())
        if packed and words + count > MOST_WORDS:
            yield "\n\n".join(packed)
            packed, words = [], 0
        packed.append(piece)
        words += count
    if packed:
        yield "\n\n".join(packed)
