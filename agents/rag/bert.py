"""A BERT encoder in NumPy (Devlin et al., BERT, 2019): one text at a time, so that nothing is padded. Pure."""

import json
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.special import erf

Array = NDArray[np.float32]
EPSILON = 1e-12  #: of the normalisations
_TYPES = {"F32": np.float32, "I64": np.int64}


def tensors_in(content: bytes) -> dict[str, NDArray[Any]]:
    """Those of a safetensors file, by name. Raises ValueError."""
    length = int.from_bytes(content[:8], "little")
    try:
        head: dict[str, Any] = json.loads(content[8 : 8 + length])
        head.pop("__metadata__", None)
        return {
            name: np.frombuffer(
                content[8 + length + one["data_offsets"][0] : 8 + length + one["data_offsets"][1]],
                dtype=_TYPES[one["dtype"]],
            ).reshape(one["shape"])
            for name, one in head.items()
        }
    except (KeyError, TypeError, UnicodeDecodeError) as error:
        raise ValueError(f"no safetensors: {error}") from error


class Bert:
    """`weights` by the names that BERT gives them."""

    def __init__(self, weights: Mapping[str, NDArray[Any]], heads: int) -> None:
        self._weights = weights
        self._heads = heads
        names = (name.split(".") for name in weights if name.startswith("encoder.layer."))
        self._layers = 1 + max(int(parts[2]) for parts in names)

    def states(self, numbers: Sequence[int]) -> Array:
        """The last layer's, shape (pieces, width)."""
        weights = self._weights
        x = weights["embeddings.word_embeddings.weight"][list(numbers)]
        x = x + weights["embeddings.position_embeddings.weight"][: len(numbers)]
        x = x + weights["embeddings.token_type_embeddings.weight"][0]
        x = self._normalised(x, "embeddings.LayerNorm")
        for layer in range(self._layers):
            x = self._layer(x, f"encoder.layer.{layer}")
        return x

    def _layer(self, x: Array, name: str) -> Array:
        attended = self._linear(self._attention(x, f"{name}.attention.self"), f"{name}.attention.output.dense")
        x = self._normalised(x + attended, f"{name}.attention.output.LayerNorm")
        inner = self._linear(x, f"{name}.intermediate.dense")
        inner *= 0.5 * (1.0 + erf(inner / np.float32(np.sqrt(2.0))))  # GELU
        return self._normalised(x + self._linear(inner, f"{name}.output.dense"), f"{name}.output.LayerNorm")

    def _attention(self, x: Array, name: str) -> Array:
        count, width = x.shape
        size = width // self._heads
        query, key, value = (
            self._linear(x, f"{name}.{part}").reshape(count, self._heads, size).transpose(1, 0, 2)
            for part in ("query", "key", "value")
        )
        scores = query @ key.transpose(0, 2, 1) / np.float32(np.sqrt(size))
        shares = np.exp(scores - scores.max(axis=-1, keepdims=True))
        shares /= shares.sum(axis=-1, keepdims=True)
        return (shares @ value).transpose(1, 0, 2).reshape(count, width)

    def _linear(self, x: Array, name: str) -> Array:
        return x @ self._weights[f"{name}.weight"].T + self._weights[f"{name}.bias"]

    def _normalised(self, x: Array, name: str) -> Array:
        centred = x - x.mean(axis=-1, keepdims=True)
        spread = np.sqrt((centred * centred).mean(axis=-1, keepdims=True) + np.float32(EPSILON))
        return centred / spread * self._weights[f"{name}.weight"] + self._weights[f"{name}.bias"]
