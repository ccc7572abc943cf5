"""A search with all its stages as data: for machines, and for the record of what an agent was shown. Pure."""

from collections.abc import Sequence
from dataclasses import asdict
from typing import Any

from agents.rag.stages import FoundDocument, Retrieval


def as_data(found: Retrieval) -> dict[str, Any]:
    """All stages for machines, and for the record of what an agent was shown."""
    return {
        "asked": asdict(found.asked),
        "concepts": [
            {"said": " ".join(one.said), "weight": one.weight, "also": [" ".join(p) for p, _ in one.expanded]}
            for one in found.concepts
        ],
        "passages": {"lexical": len(found.lexical), "embedding": len(found.embedding)},
        "documents": {
            "lexical": _listed(found.lexical_documents, found.titles),
            "embedding": _listed(found.embedding_documents, found.titles),
        },
        "ranked": [
            {
                "key": one.document.key, "score": one.score, "lexical": one.lexical, "lexical_rank": one.lexical_rank,
                "embedding": one.embedding, "embedding_rank": one.embedding_rank, "factors": one.factors,
            }
            for one in found.ranked
        ],
        "conflicts": [asdict(one) for one in found.conflicts],
        "hits": [
            {
                **{key: getattr(one.document, key) for key in _TOLD},
                "score": one.score,
                "heading": one.passage.heading,
                "passage": one.passage.text,
                "speaks_to_a_model": [asdict(flag) for flag in one.passage.flags],
                "overruled_by": one.overruled_by,
            }
            for one in found.hits
        ],
    }  # fmt: skip


_TOLD = ("name", "origin", "title", "tier", "topic", "sources", "confidence", "applies_to", "date")


def _listed(found: Sequence[FoundDocument], titles: dict[int, str]) -> list[dict[str, Any]]:
    return [{"title": titles[one.document], "score": one.score} for one in found if one.document in titles]
