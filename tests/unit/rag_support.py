"""For tests of the knowledge: documents, an embedder that counts words, a library in a folder."""

import asyncio
import hashlib
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from agents.rag.documents import Document
from agents.rag.embedder import EmbedderId, Vectors, unit_rows
from agents.rag.index import Index
from agents.rag.index_file import Content, embedded_texts, passages_of, write_index
from agents.rag.words import stems

DIMENSION = 64


def document(name: str = "one", text: str = "Tension falls.", **fields: Any) -> Document:
    return Document.model_validate(
        {"origin": "note", "name": name, "title": name.replace("-", " "), "tier": 2, "text": text} | fields
    )


class WordCounter:
    """A vector whose entries count the stems that fall on them; `embedded` is every text that it was asked for."""

    def __init__(self, name: str = "counter") -> None:
        self.identity = EmbedderId(name, DIMENSION, "1" * 64)
        self.embedded: list[str] = []

    async def embed(self, texts: Sequence[str]) -> Vectors:
        self.embedded += texts
        vectors = np.full((len(texts), DIMENSION), 1e-3)
        for row, text in zip(vectors, texts, strict=True):
            for stem in stems(text):
                row[int(hashlib.sha256(stem.encode()).hexdigest(), 16) % DIMENSION] += 1.0
        return unit_rows(vectors, len(texts), DIMENSION)


def index_of(path: Path, documents: Sequence[Document], embedder: WordCounter | None = None, state: str = "") -> Index:
    passages = passages_of(documents)
    content = Content(documents, passages, state)
    if embedder is not None:
        vectors = asyncio.run(embedder.embed(embedded_texts(documents, passages)))
        content = Content(documents, passages, state, embedder.identity, vectors)
    write_index(path, content)
    return Index(path)
