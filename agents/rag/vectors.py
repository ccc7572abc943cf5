"""Search by meaning: passages and heads of documents whose vectors are nearest to that of the question (sqlite-vec)."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from agents.rag.database import Database
from agents.rag.documents import Tier
from agents.rag.index_file import HEADS, PASSAGES
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
    """By the mean of head and best passage; what is not among the nearest counts as the farthest of those."""
    heads = dict(_nearest(connection, HEADS, vector, tiers))
    best: dict[int, FoundPassage] = {}
    for passage in passages:
        best.setdefault(passage.document, passage)
    least_head = min(heads.values(), default=0.0)
    least_passage = min((one.score for one in passages), default=0.0)
    first = _first_chunks(connection, [document for document in heads if document not in best])
    found = [
        FoundDocument(
            document,
            0.5 * heads.get(document, least_head) + 0.5 * (best[document].score if document in best else least_passage),
            best[document].chunk if document in best else first[document],
        )
        for document in {**best, **heads}
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


def _first_chunks(connection: Database, documents: Sequence[int]) -> dict[int, int]:
    numbers = ",".join(map(str, documents))
    rows = connection.execute(f"SELECT document, min(id) FROM chunk WHERE document IN ({numbers}) GROUP BY document")
    return dict(rows.fetchall())
