"""Search by meaning: passages and heads of documents whose vectors are nearest to that of the question (sqlite-vec)."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from agents.rag.database import Database
from agents.rag.documents import Tier
from agents.rag.index_file import ASKED, HEADS, PASSAGES
from agents.rag.stages import FoundDocument, FoundPassage

MOST_NEAR = 50  #: of passages, and of heads


def nearest_passages(connection: Database, vector: NDArray[np.float32], tiers: Sequence[Tier]) -> list[FoundPassage]:
    """The nearest first; scores are cosines."""
    near = _nearest(connection, PASSAGES, vector, tiers)
    numbers = ",".join(str(chunk) for chunk, _ in near)
    of: dict[int, int] = dict(connection.execute(f"SELECT id, document FROM chunk WHERE id IN ({numbers})").fetchall())
    return [FoundPassage(chunk, of[chunk], cosine) for chunk, cosine in near]


def nearest_documents(
    connection: Database, vector: NDArray[np.float32], tiers: Sequence[Tier], passages: Sequence[FoundPassage]
) -> list[FoundDocument]:
    """By the mean of head, best passage and nearest question that it answers, or of the two where it names none.

    What is not among the nearest counts as the farthest of those.
    """
    heads, asked = dict(_nearest(connection, HEADS, vector, tiers)), _asked(connection, vector, tiers)
    best: dict[int, FoundPassage] = {}
    for passage in passages:
        best.setdefault(passage.document, passage)
    near = {document: passage.score for document, passage in best.items()}
    every = list(dict.fromkeys((*best, *heads, *asked)))
    first = _first_chunks(connection, [document for document in every if document not in best])
    with_questions = _with_questions(connection, every)
    least = [min(of.values(), default=0.0) for of in (heads, near, asked)]

    def score(document: int) -> float:
        head, passage, question = (
            of.get(document, farthest) for of, farthest in zip((heads, near, asked), least, strict=True)
        )
        return (head + passage + question) / 3.0 if document in with_questions else 0.5 * (head + passage)

    found = [
        FoundDocument(document, score(document), best[document].chunk if document in best else first[document])
        for document in every
    ]
    return sorted(found, key=lambda one: -one.score)


def _nearest(
    connection: Database, table: str, vector: NDArray[np.float32], tiers: Sequence[Tier]
) -> list[tuple[int, float]]:
    """Number and cosine. A tier at a time: sqlite-vec looks for k in each partition, and gives them unsorted."""
    found: list[tuple[int, float]] = []
    for tier in tiers:
        rows = connection.execute(
            f"SELECT rowid, distance FROM {table} WHERE embedding MATCH ? AND k = {MOST_NEAR} AND tier = ?",
            (vector.tobytes(), tier),
        )
        found += [(number, 1.0 - distance) for number, distance in rows]
    return sorted(found, key=lambda pair: -pair[1])[:MOST_NEAR]


def _asked(connection: Database, vector: NDArray[np.float32], tiers: Sequence[Tier]) -> dict[int, float]:
    """By document, the cosine of the nearest question that it answers."""
    near = _nearest(connection, ASKED, vector, tiers)
    numbers = ",".join(str(number) for number, _ in near)
    of = dict(connection.execute(f"SELECT rowid, document FROM {ASKED} WHERE rowid IN ({numbers})").fetchall())
    found: dict[int, float] = {}
    for number, cosine in near:
        found.setdefault(of[number], cosine)
    return found


def _with_questions(connection: Database, documents: Sequence[int]) -> set[int]:
    """Those that say which questions they answer."""
    numbers = ",".join(map(str, documents))
    rows = connection.execute(f"SELECT id FROM document WHERE id IN ({numbers}) AND trim(asked_stems) != ''")
    return {number for (number,) in rows}


def _first_chunks(connection: Database, documents: Sequence[int]) -> dict[int, int]:
    numbers = ",".join(map(str, documents))
    rows = connection.execute(f"SELECT document, min(id) FROM chunk WHERE document IN ({numbers}) GROUP BY document")
    return dict(rows.fetchall())
