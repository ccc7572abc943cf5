"""The index of the documents, opened: what it is made of, and a search through all its stages."""

import json
from collections.abc import Generator, Iterable, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Self

import numpy as np

from agents.rag.conflicts import conflicts_among
from agents.rag.database import DatabaseError
from agents.rag.documents import Document
from agents.rag.embedder import Embedder, EmbedderId, Vectors
from agents.rag.index_file import ASKED, HEADS, PASSAGES, IndexRefused, open_index
from agents.rag.injection import Flag, flags_in
from agents.rag.lexical import Words
from agents.rag.question_words import concepts_of
from agents.rag.ranking import considered, ranked
from agents.rag.stages import Asked, Conflict, Hit, Passage, Ranked, Retrieval
from agents.rag.vectors import nearest_documents, nearest_passages

SHOWN = 10  #: passages whose documents are told by their titles
COMPARED = 8  #: of the best documents are looked at for conflicts


class Index:
    """`close` it, or use it as a context manager. Raises IndexRefused."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self._connection = open_index(path)
        with self._told():
            meta = {key: json.loads(value) for key, value in self._connection.execute("SELECT key, value FROM meta")}
        self.state: str = meta["state"]
        self.documents_count: int = meta["documents"]
        self.chunks_count: int = meta["chunks"]
        self.embedder: EmbedderId | None = EmbedderId(**meta["embedder"]) if meta["embedder"] else None
        self._words = Words(self._connection, self.chunks_count, meta["mean_stems"])

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        self._connection.close()

    async def ask(self, asked: Asked, embedder: Embedder | None = None) -> Retrieval:
        """With the embedder that the index was made with, or with none. Raises IndexRefused, EmbedderFailed."""
        if embedder is None:
            return self.retrieve(asked)
        self.require(embedder.identity)
        return self.retrieve(asked, await embedder.embed([asked.question]))

    def require(self, embedder: EmbedderId | None) -> None:
        """Raises IndexRefused where the index was made with another one."""
        if embedder != self.embedder:
            raise IndexRefused(
                f"{self.path} was made with {self.embedder or 'no embedder'}, not with {embedder or 'none'}: vectors "
                "of different embedders cannot be compared. Ask with the same, or make the index anew "
                "(r2rgate ask --reindex)"
            )

    def retrieve(self, asked: Asked, vectors: Vectors | None = None) -> Retrieval:
        """`vectors`: of the question, shape (1, dimension), by the index's own embedder; None: by words alone.

        Raises IndexRefused where the file is damaged.
        """
        with self._told():
            return self._retrieve(asked, vectors)

    def _retrieve(self, asked: Asked, vectors: Vectors | None) -> Retrieval:
        concepts = concepts_of(asked.question)
        lexical, lexical_documents = self._words.search(concepts, asked.tiers)
        near = [] if vectors is None else nearest_passages(self._connection, vectors[0], asked.tiers)
        near_documents = None if vectors is None else nearest_documents(self._connection, vectors[0], asked.tiers, near)
        shown = [one.document for one in (*lexical[:SHOWN], *near[:SHOWN])]
        documents = self._documents({*considered(lexical_documents, near_documents), *shown})
        order = ranked(asked, lexical_documents, near_documents, documents)
        conflicts = conflicts_among([(one.document, self._around(one.chunk)) for one in order[:COMPARED]])
        return Retrieval(
            asked=asked,
            concepts=concepts,
            lexical=lexical,
            embedding=near,
            lexical_documents=lexical_documents,
            embedding_documents=near_documents or [],
            ranked=order,
            conflicts=conflicts,
            hits=[self._hit(one, conflicts) for one in winners_first(order, conflicts)[: asked.most]],
            titles={number: document.title for number, document in documents.items()},
        )

    def documents(self) -> list[Document]:
        """All of them, as they were put in."""
        with self._told():
            rows = self._connection.execute("SELECT content FROM document ORDER BY id")
            return [Document.model_validate_json(content) for (content,) in rows]

    def vectors(self) -> dict[str, Vectors]:
        """By the hash of the text that was embedded."""
        if self.embedder is None:
            return {}
        with self._told():
            return {
                sha256: np.frombuffer(vector, dtype=np.float32)
                for table in (HEADS, ASKED, PASSAGES)
                for sha256, vector in self._connection.execute(f"SELECT sha256, embedding FROM {table}")
            }

    @contextmanager
    def _told(self) -> Generator[None]:
        try:
            yield
        except (DatabaseError, ValueError) as error:  # the latter: what is in a row is none of ours any more
            raise IndexRefused(f"{self.path} is damaged ({error}): delete it, and it is made anew") from error

    def _documents(self, numbers: Iterable[int]) -> dict[int, Document]:
        listed = ",".join(map(str, numbers))
        rows = self._connection.execute(f"SELECT id, content FROM document WHERE id IN ({listed})")
        return {number: Document.model_validate_json(content) for number, content in rows}

    def _around(self, chunk: int) -> str:
        """A passage with those before and after it."""
        rows = self._connection.execute(
            "SELECT chunk.text FROM chunk, chunk AS own WHERE own.id = ? AND chunk.document = own.document"
            " AND chunk.id BETWEEN own.id - 1 AND own.id + 1 ORDER BY chunk.id",
            (chunk,),
        )
        return "\n".join(text for (text,) in rows)

    def _hit(self, one: Ranked, conflicts: Sequence[Conflict]) -> Hit:
        row = self._connection.execute("SELECT heading, text, flags FROM chunk WHERE id = ?", (one.chunk,)).fetchone()
        heading, text, flags = row
        found = [*(Flag(kind, shown) for kind, shown in json.loads(flags)), *flags_in(one.document.title)]
        passage = Passage(heading, text, found)
        overruled = [conflict.winner for conflict in conflicts if conflict.loser == one.document.key]
        return Hit(one.document, passage, one.score, overruled)


def winners_first(order: Sequence[Ranked], conflicts: Sequence[Conflict]) -> list[Ranked]:
    """The order, with whoever counts more put before whom it overrules."""
    keys = [one.document.key for one in order]
    for conflict in conflicts:
        winner, loser = keys.index(conflict.winner), keys.index(conflict.loser)
        if winner > loser:
            keys.insert(loser, keys.pop(winner))
    by_key = {one.document.key: one for one in order}
    return [by_key[key] for key in keys]
