"""What knowledge consists of: documents of three tiers, whoever wrote them. Pure.

Tier 1 is control theory and tier 2 practice, both written for this program; tier 3 is what is known of this line:
documents that its people have added, and those that the program makes of the line's own configuration and history.
"""

import hashlib
from dataclasses import dataclass
from typing import Literal, get_args

from agents.rag.notes import Note
from gateway.core.line import Strict
from gateway.core.line_queries import Generated
from gateway.core.questions import Decision

Tier = Literal[1, 2, 3]
TIERS: tuple[Tier, ...] = get_args(Tier)
Origin = Literal["note", "file", "line"]  #: written for this program, added by somebody, made of the line's own state
NOTES_CONFIDENCE = 0.9  #: of a note without a head that a person has added: they know their line
MADE_CONFIDENCE = 0.95  #: of what the program has made of what it measured


class Document(Strict):
    """`name` tells it from all others of its origin; a newer one of the same name and origin replaces it."""

    origin: Origin
    name: str
    title: str
    tier: Tier
    text: str  #: Markdown
    topic: str = ""
    applies_to: str = ""
    sources: list[str] = []
    keywords: list[str] = []
    asked: list[str] = []  #: questions that it answers, as people put them
    serves: list[Decision] = []  #: empty: nobody has said; it counts as serving none in particular
    confidence: float = NOTES_CONFIDENCE
    date: str = ""  #: ISO 8601; empty: not known
    stamp: str = ""  #: of the file, so that one that has not changed is not read again
    replaces: list[str] = []
    contradicts: list[str] = []
    #: A failure mode is matched by the monitoring agent.
    kind: Literal["note", "failure"] = "note"

    @property
    def key(self) -> str:
        return f"{self.origin}:{self.name}"

    @property
    def hash(self) -> str:
        """Of what it says, under whatever name (SHA-256)."""
        return hashlib.sha256("\0".join((str(self.tier), self.title, self.text)).encode()).hexdigest()


@dataclass(frozen=True)
class Consistent:
    """Documents of which no two are the same, and what was left out for that, in words."""

    documents: list[Document]
    left_out: list[str]


def of_note(note: Note, origin: Origin = "note") -> Document:
    head = note.head
    return Document(
        origin=origin,
        name=note.name,
        title=head.title,
        tier=head.tier,
        text=note.text,
        topic=head.topic,
        applies_to=head.applies_to,
        sources=head.sources,
        keywords=head.keywords,
        asked=head.asked,
        serves=head.serves,
        confidence=head.confidence,
        date=head.date or "",
        replaces=head.replaces,
        contradicts=head.contradicts,
        kind=head.kind,
    )


def of_generated(made: Generated) -> Document:
    return Document(
        origin="line",
        name=made.name,
        title=made.title,
        tier=3,
        text=made.text,
        topic="this line",
        sources=["the line's own records"],
        keywords=made.keywords,
        serves=made.serves,
        confidence=MADE_CONFIDENCE,
        date=made.date,
    )


def consistent(documents: list[Document]) -> Consistent:
    """Of documents of one name and origin the newest, without a date the last; of equal ones the first."""
    newest: dict[str, Document] = {}
    left_out: list[str] = []
    for one in documents:
        before = newest.get(one.key)
        if before is None or one.date >= before.date:
            newest[one.key] = one
        if before is not None:
            older = before if newest[one.key] is one else one
            left_out.append(f"{older.name}: a newer one of this name replaces it")
    seen: dict[str, Document] = {}
    for one in newest.values():
        if (twin := seen.setdefault(one.hash, one)) is not one:
            left_out.append(f"{one.name}: says the same as {twin.name}")
    return Consistent(list(seen.values()), left_out)
