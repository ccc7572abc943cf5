"""Vectors for texts, the same for the same text: hashed groups of three letters. They mean nothing."""

import hashlib
import math

DIMENSIONS = 384


def embed(text: str, dimensions: int | None = None) -> list[float]:
    """Of length 1."""
    vector = [0.0] * (dimensions or DIMENSIONS)
    padded = f"  {text.lower()} "
    for group in (padded[k : k + 3] for k in range(len(padded) - 2)):
        hashed = int.from_bytes(hashlib.sha256(group.encode()).digest()[:8])
        vector[hashed % len(vector)] += 1.0 if hashed >> 63 else -1.0
    length = math.sqrt(sum(value * value for value in vector)) or 1.0
    return [value / length for value in vector]
