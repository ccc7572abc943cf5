"""The file of the index: its tables in SQLite, made whole and put in place at once, opened for reading only.

Whoever reads keeps the file that they have opened; whoever opens afterwards has the new one. A file is never changed,
so that a kill at any moment leaves the old one or the new one.
"""

import fcntl
import hashlib
import json
import os
from collections.abc import Generator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path

from agents.rag.chunks import Chunk, chunks_of
from agents.rag.database import Database, DatabaseError, begin_database, open_database
from agents.rag.documents import Document
from agents.rag.embedder import EmbedderId, Vectors
from agents.rag.injection import flags_in
from agents.rag.words import stems
from gateway.storage.sqlite_file import FileKind, Journal

APPLICATION_ID = 0x52324B4E  # "R2KN"
#: Tables of vectors: of documents, of questions that they answer, and of chunks.
HEADS, ASKED, PASSAGES = "head_vector", "asked_vector", "vector"

_TABLES = f"""
CREATE TABLE meta (key TEXT PRIMARY KEY NOT NULL, value TEXT NOT NULL);
CREATE TABLE document (
    id INTEGER PRIMARY KEY,
    tier INTEGER NOT NULL,
    content TEXT NOT NULL,          -- the document as JSON (agents/rag/documents.py)
    title_stems TEXT NOT NULL,      -- one space before and after each, as all stems here
    keyword_stems TEXT NOT NULL,
    asked_stems TEXT NOT NULL,      -- of the questions that it answers
    about_stems TEXT NOT NULL       -- of topic and applies_to
);
CREATE TABLE chunk (
    id INTEGER PRIMARY KEY,
    document INTEGER NOT NULL REFERENCES document,
    heading TEXT NOT NULL,
    text TEXT NOT NULL,
    stems TEXT NOT NULL,
    flags TEXT NOT NULL             -- JSON: what in it speaks to a language model (agents/rag/injection.py)
);
CREATE INDEX chunk_by_document ON chunk (document);
-- What is put in are stems already, so that the tokenizer only splits.
CREATE VIRTUAL TABLE word USING fts5(
    title, keywords, asked, text, content = '', tokenize = 'unicode61 remove_diacritics 0');
CREATE VIRTUAL TABLE word_count USING fts5vocab(word, row);
PRAGMA application_id = {APPLICATION_ID};
"""
_VECTORS = """
CREATE VIRTUAL TABLE {table} USING vec0(
    tier INTEGER PARTITION KEY, embedding FLOAT[{dimension}] DISTANCE_METRIC=cosine, +document INTEGER, +sha256 TEXT);
"""


class IndexRefused(Exception):
    """The index cannot be used as asked; the text says why and what to do."""


class AnothersFile(IndexRefused):
    """What lies there is no index of this program's, and is not made anew."""


KIND = FileKind(
    "index",
    APPLICATION_ID,
    {0: "", 1: _TABLES},  # one of an earlier schema is made anew from the documents, which is no loss
    IndexRefused,
    absent="there is no index at {path}: make it anew",
    damaged="To go on, make it anew",
    anothers=AnothersFile,
    journal=Journal.NONE,
)
SCHEMA = KIND.schema


def passages_of(documents: Sequence[Document]) -> list[list[Chunk]]:
    """By document; one without words has its title as its only passage."""
    return [chunks_of(one.text) or [Chunk("", one.title)] for one in documents]


def embedded_texts(documents: Sequence[Document], passages: Sequence[Sequence[Chunk]]) -> list[str]:
    """The head of every document, then the questions, then every passage with what it is about, in their order."""
    heads = [". ".join(filter(None, (one.title, ", ".join(one.keywords)))) for one in documents]
    asked = [question for document in documents for question in document.asked]
    chunked = [
        ". ".join(filter(None, (document.title, chunk.heading, chunk.text)))
        for document, chunks in zip(documents, passages, strict=True)
        for chunk in chunks
    ]
    return [*heads, *asked, *chunked]


def hash_of(text: str) -> str:
    return hashlib.sha256(text.encode()).hexdigest()


@dataclass(frozen=True)
class Content:
    """What an index is made of. `state` is kept for whoever asks whether it is up to date."""

    documents: Sequence[Document]
    passages: Sequence[Sequence[Chunk]]  #: by document
    state: str
    embedder: EmbedderId | None = None
    vectors: Vectors | None = None  #: of `embedded_texts`, in their order; with an embedder only


def write_index(path: Path, content: Content) -> None:
    """Make the file anew. One process at a time: the next waits. Raises IndexRefused."""
    part = path.with_name(f"{path.name}.{os.getpid()}.part")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with _only_writer(path):
            _require_replaceable(path)
            connection = begin_database(part, KIND)
            try:
                _fill(connection, content)
            finally:
                connection.close()
            _sync(part)
            part.replace(path)
            _sync(path.parent)
    except (DatabaseError, OSError) as error:
        with suppress(OSError):
            part.unlink(missing_ok=True)
        raise IndexRefused(
            f"the index {path} cannot be written: {error}. Name a folder that you may write, with space"
        ) from error


def open_index(path: Path) -> Database:
    """For reading. Raises IndexRefused where there is none that this program reads."""
    try:
        connection = open_database(path, KIND)
        if connection.execute("PRAGMA user_version").get != SCHEMA:
            connection.close()
            raise IndexRefused(f"{path} is an index of another version of this program: make it anew")
        connection.execute("PRAGMA mmap_size = 268435456")
    except DatabaseError as error:
        raise IndexRefused(f"{path} cannot be read ({error}): make it anew") from error
    return connection


def _require_replaceable(path: Path) -> None:
    """Raises AnothersFile. An index of ours that is damaged, or of another version, may be made anew."""
    try:
        open_database(path, KIND).close()
    except AnothersFile:
        raise
    except (IndexRefused, DatabaseError):
        pass


@contextmanager
def _only_writer(path: Path) -> Generator[None]:
    """What one that was killed has left is removed."""
    with path.with_name(path.name + ".lock").open("wb") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        for left in path.parent.glob(f"{path.name}.*.part"):
            left.unlink(missing_ok=True)
        yield


def _fill(connection: Database, content: Content) -> None:
    connection.execute("BEGIN")
    totals = [0, 0, 0, 0]
    number = 0
    for k, (document, chunks) in enumerate(zip(content.documents, content.passages, strict=True), start=1):
        head = _insert_document(connection, k, document)
        for chunk in chunks:
            number += 1
            words = _insert_chunk(connection, number, k, chunk, head)
            totals = [a + len(b) for a, b in zip(totals, (*head, words), strict=True)]
    connection.execute("INSERT INTO word (word) VALUES ('optimize')")
    meta = {
        "state": content.state,
        "documents": len(content.documents),
        "chunks": number,
        "mean_stems": [total / max(number, 1) for total in totals],
        "embedder": content.embedder and vars(content.embedder).copy(),
    }
    connection.executemany("INSERT INTO meta VALUES (?, ?)", [(key, json.dumps(value)) for key, value in meta.items()])
    if content.embedder is not None and content.vectors is not None:
        _fill_vectors(connection, content, content.embedder.dimension, content.vectors)
    connection.execute("COMMIT")


def _insert_document(connection: Database, number: int, document: Document) -> tuple[list[str], ...]:
    """The stems of its title, of its keywords with what it is about, and of the questions that it answers."""
    title, keywords = stems(document.title), stems(", ".join(document.keywords))
    about, asked = stems(f"{document.topic}. {document.applies_to}"), stems(" ".join(document.asked))
    row = (number, document.tier, document.model_dump_json(), *map(_spaced, (title, keywords, asked, about)))
    connection.execute("INSERT INTO document VALUES (?, ?, ?, ?, ?, ?, ?)", row)
    return title, keywords + about, asked


def _insert_chunk(
    connection: Database, number: int, document: int, chunk: Chunk, head: Sequence[list[str]]
) -> list[str]:
    """The stems of its text."""
    words = stems(f"{chunk.heading}. {chunk.text}")
    flags = json.dumps([[flag.kind, flag.passage] for flag in flags_in(f"{chunk.heading}\n{chunk.text}")])
    row = (number, document, chunk.heading, chunk.text, _spaced(words), flags)
    connection.execute("INSERT INTO chunk VALUES (?, ?, ?, ?, ?, ?)", row)
    texts = (" ".join(some) for some in (*head, words))
    connection.execute(
        "INSERT INTO word (rowid, title, keywords, asked, text) VALUES (?, ?, ?, ?, ?)", (number, *texts)
    )
    return words


def _fill_vectors(connection: Database, content: Content, dimension: int, vectors: Vectors) -> None:
    heads = list(enumerate(content.documents, start=1))
    asked = [each for each in heads for _ in each[1].asked]
    chunks = [each for each, some in zip(heads, content.passages, strict=True) for _ in some]
    texts = iter(zip(vectors, embedded_texts(content.documents, content.passages), strict=True))
    for table, of in ((HEADS, heads), (ASKED, asked), (PASSAGES, chunks)):
        connection.execute(_VECTORS.format(table=table, dimension=dimension))
        rows = [
            (k, document.tier, vector.tobytes(), number, hash_of(text))
            for k, ((number, document), (vector, text)) in enumerate(zip(of, texts, strict=False), start=1)
        ]
        connection.executemany(
            f"INSERT INTO {table} (rowid, tier, embedding, document, sha256) VALUES (?, ?, ?, ?, ?)", rows
        )


def _spaced(words: Sequence[str]) -> str:
    """So that a phrase is found as text: " it "."""
    return f" {' '.join(words)} "


def _sync(path: Path) -> None:
    descriptor = os.open(path, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)
