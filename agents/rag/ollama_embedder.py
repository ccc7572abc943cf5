"""An embedding model that Ollama serves."""

from collections.abc import Sequence
from types import TracebackType
from typing import Any, Self

import httpx
import numpy as np
import ollama
from pydantic import ValidationError

from agents.rag.embedder import EmbedderFailed, EmbedderId, Vectors, unit_rows

ANSWER_MAX_S = 120.0  #: the first call may have to load the model
#: What its client lets through where the server is away, slow, or no Ollama.
_ERRORS = (ollama.ResponseError, ConnectionError, httpx.HTTPError, ValidationError, ValueError, TypeError)


class OllamaEmbedder:
    """Made by `begin`; an asynchronous context manager, which closes its connection."""

    def __init__(self, client: ollama.AsyncClient, identity: EmbedderId) -> None:
        self._client = client
        self._identity = identity

    @classmethod
    async def begin(cls, model: str, url: str, answer_max_s: float = ANSWER_MAX_S) -> Self:
        """Asks the server for the digest of the weights, and how long their vectors are. Raises EmbedderFailed."""
        client = ollama.AsyncClient(host=url, timeout=httpx.Timeout(answer_max_s), trust_env=False)
        try:
            digest = await _digest(client, model, url)
            vectors = await _vectors(client, model, ["dimension"])
        except BaseException:  # also where it is no longer waited for
            await _close(client)
            raise
        return cls(client, EmbedderId(f"ollama:{model}", vectors.shape[1], digest))

    async def __aenter__(self) -> Self:
        return self

    async def __aexit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        await _close(self._client)

    @property
    def identity(self) -> EmbedderId:
        return self._identity

    async def embed(self, texts: Sequence[str]) -> Vectors:
        model = self._identity.name.removeprefix("ollama:")
        return unit_rows(await _vectors(self._client, model, texts), len(texts), self._identity.dimension)


async def _digest(client: ollama.AsyncClient, model: str, url: str) -> str:
    try:
        models = (await client.list()).models
    except _ERRORS as error:
        raise EmbedderFailed(f"Ollama at {url} does not answer: {error}. Start it, or search by words") from error
    names = {one.model: one.digest for one in models}
    digest = names.get(model) or names.get(f"{model}:latest")
    if not digest:
        there = ", ".join(sorted(filter(None, names))) or "none"
        raise EmbedderFailed(f"Ollama at {url} has no model {model}: ollama pull {model} fetches it; it has {there}")
    return digest


async def _vectors(client: ollama.AsyncClient, model: str, texts: Sequence[str]) -> np.ndarray[Any, Any]:
    """Shape (texts, dimension), of any length."""
    try:
        answer = await client.embed(model=model, input=list(texts))
        vectors = np.array(answer.embeddings, dtype=np.float32)
    except _ERRORS as error:
        raise EmbedderFailed(f"Ollama's model {model} gives no vectors: {error}") from error
    if vectors.ndim != 2 or vectors.shape[0] != len(texts) or not vectors.shape[1]:
        raise EmbedderFailed(f"Ollama's model {model} gave vectors of shape {vectors.shape} for {len(texts)} texts")
    return vectors


async def _close(client: ollama.AsyncClient) -> None:
    await client.close()
