"""All that is known, in a folder: the documents that people have added, and the index of them and the program's notes.

The index is made anew whenever something in it has changed; what it is made of are files, so that it may be deleted.
"""

import asyncio
import hashlib
import shutil
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path

import numpy as np

from agents.rag.chunks import Chunk
from agents.rag.documents import Document, Generated, Tier, consistent, of_generated, of_note
from agents.rag.embedder import Embedder, EmbedderId, Vectors
from agents.rag.index import Index
from agents.rag.index_file import (
    Content,
    IndexRefused,
    embedded_texts,
    hash_of,
    passages_of,
    write_index,
)
from agents.rag.notes import NoteRefused, parse_note
from agents.rag.read_files import FilesRead, Refused, read_files, stamp_of
from gateway.core.line_problem import printable
from gateway.files import NotText, read_text

NOTES = Path(__file__).parent.parent / "knowledge"
INDEX, ADDED = "index.sqlite", "documents"  #: in the folder
MOST_NOTE_BYTES = 1_000_000
BATCH = 32  #: texts that are embedded at a time


@dataclass(frozen=True)
class Opened:
    """`made`: the index was made anew; then `refused` and `left_out` say what is not in it, and why."""

    index: Index
    made: bool
    refused: list[Refused]
    left_out: list[str]


@cache
def program_notes() -> tuple[Document, ...]:
    """Those written for this program that can be read."""
    return notes_in(NOTES)[0]


def notes_in(folder: Path) -> tuple[tuple[Document, ...], list[Refused]]:
    """The notes one folder deep in `folder`, and those that are none, with why."""
    documents, refused = list[Document](), list[Refused]()
    for file in sorted(folder.glob("*/*.md")):
        name = printable(file.relative_to(folder).as_posix())
        try:
            documents.append(of_note(parse_note(file.stem, read_text(file, MOST_NOTE_BYTES))))
        except NoteRefused as error:
            refused.append(Refused(name, "; ".join(error.reasons)))
        except OSError as error:
            refused.append(Refused(name, f"cannot be read: {error.strerror}"))
        except NotText as error:
            refused.append(Refused(name, str(error)))
    return tuple(documents), refused


def add_files(folder: Path, paths: Sequence[Path], tier: Tier) -> FilesRead:
    """Copy what can be read into the folder; one of the same name is replaced. The copies are what is searched."""
    read = read_files(paths, tier)
    good = {document.name for document in read.documents}
    for path in paths:
        files = [path] if path.is_file() else [file for file in path.rglob("*") if file.is_file()]
        for file in files:
            name = file.name if path.is_file() else file.relative_to(path).as_posix()
            if name in good:
                copy = folder / ADDED / name
                copy.parent.mkdir(parents=True, exist_ok=True)
                shutil.copy2(file, copy)
    return read


async def open_library(
    folder: Path,
    tier: Tier,
    embedder: Embedder | None = None,
    generated: Sequence[Generated] | None = None,
    reindex: bool = False,
) -> Opened:
    """The index of the folder, made anew where something has changed, or `reindex` is asked for.

    `tier`: of added documents that do not say it themselves. `generated`: of this line; None: those of before stay.
    Raises IndexRefused, also where the index was made with another embedder; EmbedderFailed.
    """
    path = folder / INDEX
    identity = None if embedder is None else embedder.identity
    gathered = await asyncio.to_thread(_gathered, folder, tier, identity, generated, reindex)
    if isinstance(gathered, Opened):
        return gathered
    content = Content(gathered.documents, gathered.passages, gathered.state)
    if embedder is not None:
        texts = embedded_texts(gathered.documents, gathered.passages)
        embedded = await _embedded(texts, embedder, gathered.vectors)
        content = Content(gathered.documents, gathered.passages, gathered.state, embedder.identity, embedded)
    await asyncio.to_thread(write_index, path, content)
    return Opened(await asyncio.to_thread(Index, path), True, gathered.refused, gathered.left_out)


@dataclass(frozen=True)
class _Gathered:
    """What the next index is made of."""

    documents: list[Document]
    passages: list[list[Chunk]]
    state: str
    vectors: dict[str, Vectors]  #: known already, by text
    refused: list[Refused]
    left_out: list[str]


def _gathered(
    folder: Path, tier: Tier, embedder: EmbedderId | None, generated: Sequence[Generated] | None, reindex: bool
) -> Opened | _Gathered:
    """The index that is there, where it is up to date. It blocks. Raises IndexRefused."""
    state = _state(folder, tier)
    made_of = "" if generated is None else _hash(*(one.model_dump_json() for one in generated))
    before = _open_usable(folder / INDEX)
    if before is not None and not reindex:
        try:
            before.require(embedder)
        except IndexRefused:
            before.close()
            raise
        if before.state.startswith(state) and (generated is None or before.state == state + made_of):
            return Opened(before, False, [], [])
    kept, vectors = _kept(before, embedder)
    if generated is None and before is not None:
        made_of = before.state[len(state) :]
    known = {one.name: one for one in kept if one.origin == "file" and (one.tier == tier or one.topic)}
    read = read_files([folder / ADDED] if (folder / ADDED).is_dir() else [], tier, known)
    of_line = [one for one in kept if one.origin == "line"] if generated is None else list(map(of_generated, generated))
    whole = consistent([*program_notes(), *read.documents, *of_line])
    passages = passages_of(whole.documents)
    refused = [*notes_in(NOTES)[1], *read.refused]
    return _Gathered(whole.documents, passages, state + made_of, vectors, refused, whole.left_out)


def _open_usable(path: Path) -> Index | None:
    """None: there is none, or none that this version reads; it is made anew."""
    try:
        return Index(path)
    except IndexRefused:
        return None


def _kept(before: Index | None, embedder: EmbedderId | None) -> tuple[list[Document], dict[str, Vectors]]:
    """What the next index takes over from the one before: documents, and vectors of the same embedder by text."""
    if before is None:
        return [], {}
    with before:
        try:
            same = embedder is not None and before.embedder == embedder
            return before.documents(), before.vectors() if same else {}
        except IndexRefused:  # damaged within
            return [], {}


async def _embedded(texts: Sequence[str], embedder: Embedder, known: dict[str, Vectors]) -> Vectors:
    """Those that were embedded before are taken from there."""
    hashes = [hash_of(text) for text in texts]
    new = {one: text for one, text in zip(hashes, texts, strict=True) if one not in known}
    for start in range(0, len(new), BATCH):
        some = list(new.items())[start : start + BATCH]
        rows = await embedder.embed([text for _, text in some])
        known |= {one: row for (one, _), row in zip(some, rows, strict=True)}
    return np.stack([known[one] for one in hashes])


def _state(folder: Path, tier: Tier) -> str:
    """Of what the index is made of, without what is generated."""
    files = sorted(file for file in (folder / ADDED).rglob("*") if file.is_file())
    added = [f"{file.relative_to(folder)} {_stamp_there(file)}" for file in files]
    notes = [f"{file.name} {_stamp_there(file)}" for file in sorted(NOTES.glob("*/*.md"))]
    return _hash(str(tier), *notes, *added)


def _stamp_there(file: Path) -> str:
    """Of a file that cannot be looked at, or is gone meanwhile, always the same."""
    try:
        return stamp_of(file)
    except OSError:
        return "unreadable"


def _hash(*texts: str) -> str:
    return hashlib.sha256("\0".join(texts).encode()).hexdigest()
