"""What each stage of a search found, to be looked at: words, passages, documents, their order, conflicts."""

from collections.abc import Sequence
from dataclasses import dataclass, field

from agents.rag.documents import TIERS, Document, Tier
from agents.rag.injection import Flag
from agents.rag.question_words import Concept
from gateway.core.questions import Decision


@dataclass(frozen=True)
class Asked:
    """`decision`: of the phase that asks; None: a person asks."""

    question: str
    decision: Decision | None = None
    tiers: Sequence[Tier] = TIERS
    most: int = 3  #: documents that are given back


@dataclass(frozen=True)
class FoundPassage:
    """`score`: of its words (BM25), or the cosine to the question; more is better."""

    chunk: int
    document: int
    score: float


@dataclass(frozen=True)
class FoundDocument:
    """A document by its title, keywords and best passages together; `chunk` is its best passage."""

    document: int
    score: float
    chunk: int


@dataclass(frozen=True)
class Ranked:
    """A document in the order of all that speaks for it; `lexical` and `embedding`: shares of the best score there."""

    document: Document
    chunk: int
    lexical: float
    lexical_rank: int | None  #: from 1; None: not found there
    embedding: float | None  #: None: there is no embedder
    embedding_rank: int | None
    factors: dict[str, float]  #: by what: tier, confidence, applies, serves
    score: float


@dataclass(frozen=True)
class Conflict:
    """Two documents that were found say different things; what stays is the winner's, both stay visible."""

    winner: str  #: key of a document
    loser: str
    rule: str  #: why the winner is
    winner_says: str
    loser_says: str


@dataclass(frozen=True)
class Passage:
    heading: str
    text: str
    flags: list[Flag]


@dataclass(frozen=True)
class Hit:
    """What is given to whoever asked. `overruled_by`: keys of documents that say otherwise and count for more."""

    document: Document
    passage: Passage
    score: float
    overruled_by: list[str]


@dataclass(frozen=True)
class Retrieval:
    """An answer with all its stages, in their order."""

    asked: Asked
    concepts: list[Concept]
    lexical: list[FoundPassage]
    embedding: list[FoundPassage]
    lexical_documents: list[FoundDocument]
    embedding_documents: list[FoundDocument]
    ranked: list[Ranked]
    conflicts: list[Conflict]
    hits: list[Hit]
    titles: dict[int, str] = field(default_factory=dict)  #: of documents, by number
