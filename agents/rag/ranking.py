"""The order of documents by all that speaks for them. Pure.

Scores by words and by meaning are made comparable as shares of the best of their list - of cosines, which are never
near zero, as shares of the way from the last to the best - and added; on the tuning questions that finds more than
reciprocal ranks do (docs/knowledge.md). What is known of a document beside that - whose it is, how sure, for what and
for whom it was written - turns the sum by some per cent: enough between two that say the same, too little to lift what
does not answer.
"""

from collections.abc import Mapping, Sequence

from agents.rag.documents import Document
from agents.rag.stages import Asked, FoundDocument, Ranked
from agents.rag.words import left_out, stems

LEXICAL_SHARE = 0.6  #: of the sum, where there is an embedder as well
MOST_RANKED = 30  #: of a list
TIER = {1: 1.0, 2: 1.02, 3: 1.08}  #: what is known of this line counts more than what is known of lines
SERVES, SERVES_OTHERS = 1.1, 0.95  #: where a decision asks: written for it, or for others


def ranked(
    asked: Asked,
    lexical: Sequence[FoundDocument],
    embedding: Sequence[FoundDocument] | None,
    documents: Mapping[int, Document],
) -> list[Ranked]:
    """The best first, of those `considered`. `embedding` None: there is no embedder."""
    by_words = _shares(lexical, 0.0)
    by_meaning = _shares(embedding, embedding[-1].score) if embedding else {}
    words = frozenset(stems(asked.question)) - left_out()
    found: list[Ranked] = []
    for number in considered(lexical, embedding):
        document = documents[number]
        word_rank, word_chunk, word_share = by_words.get(number, (None, None, 0.0))
        near_rank, near_chunk, near_share = by_meaning.get(number, (None, None, 0.0))
        share = word_share if embedding is None else LEXICAL_SHARE * word_share + (1 - LEXICAL_SHARE) * near_share
        factors = _factors(document, asked, words)
        score = share
        for factor in factors.values():
            score *= factor
        chunk = near_chunk if word_chunk is None or near_share > word_share else word_chunk
        assert chunk is not None  # it was found by one of the two
        found.append(
            Ranked(
                document=document,
                chunk=chunk,
                lexical=word_share,
                lexical_rank=word_rank,
                embedding=None if embedding is None else near_share,
                embedding_rank=near_rank,
                factors=factors,
                score=score,
            )
        )
    return sorted(found, key=lambda one: -one.score)


def considered(lexical: Sequence[FoundDocument], embedding: Sequence[FoundDocument] | None) -> list[int]:
    """The documents that are ordered: the best of either list."""
    return list(dict.fromkeys(one.document for one in (*lexical[:MOST_RANKED], *(embedding or [])[:MOST_RANKED])))


def _shares(found: Sequence[FoundDocument], nothing: float) -> dict[int, tuple[int, int, float]]:
    """By document: rank, best passage, and how far its score is on the way from `nothing` to the best."""
    way = found[0].score - nothing if found else 0.0
    return {
        one.document: (rank, one.chunk, (one.score - nothing) / way if way > 0.0 else 1.0)
        for rank, one in enumerate(found, start=1)
    }


def _factors(document: Document, asked: Asked, words: frozenset[str]) -> dict[str, float]:
    about = frozenset(stems(f"{document.topic} {document.applies_to}"))
    factors = {
        "tier": TIER[document.tier],
        "confidence": 0.9 + 0.1 * document.confidence,
        "applies": 1.0 + 0.05 * len(words & about) / max(len(words), 1),
    }
    if asked.decision is not None and document.serves:
        factors["serves"] = SERVES if asked.decision in document.serves else SERVES_OTHERS
    return factors
