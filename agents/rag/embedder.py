"""What turns passages and questions into vectors of meaning, where there is one."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

Vectors = NDArray[np.float32]  #: a row each, of length 1


class EmbedderFailed(Exception):
    """No vectors; the text says why and what to do."""


@dataclass(frozen=True)
class EmbedderId:
    """Vectors of different embedders have nothing to do with each other, and are never compared."""

    name: str
    dimension: int
    sha256: str  #: of its weights

    def __str__(self) -> str:
        return f"{self.name} ({self.dimension} dimensions, weights {self.sha256[:12]})"


class Embedder(Protocol):
    @property
    def identity(self) -> EmbedderId: ...

    async def embed(self, texts: Sequence[str]) -> Vectors:
        """Shape (texts, dimension). Raises EmbedderFailed."""
        ...


def unit_rows(vectors: NDArray[Any], count: int, dimension: int) -> Vectors:
    """Each row at length 1. Raises EmbedderFailed where the shape is another, or a row has no direction."""
    if vectors.shape != (count, dimension):
        raise EmbedderFailed(f"the embedder gave vectors of shape {vectors.shape}; allowed: ({count}, {dimension})")
    lengths = np.linalg.norm(vectors, axis=1, keepdims=True)
    if not np.all(np.isfinite(lengths)) or np.any(lengths == 0.0):
        raise EmbedderFailed("the embedder gave a vector without a direction (zero, or not finite)")
    return (vectors / lengths).astype(np.float32)
