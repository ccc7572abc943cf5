"""Rules about the table [agents]."""

from collections.abc import Iterator

from gateway.core.line import Line
from gateway.core.line_problem import Finding
from gateway.core.nearest import nearest

_KINDS = {"lexical": "lexical", "minilm": "minilm", "ollama": "ollama:MODEL"}


def embedder_is_known(line: Line) -> Iterator[Finding]:
    """By its name; whether it is there, the agents find out."""
    kind, _, model = line.agents.embedder.partition(":")
    if line.agents.embedder in ("lexical", "minilm") or (kind == "ollama" and model):
        return
    like = nearest(kind, _KINDS)
    nearest_words = f'"{_KINDS[like]}"' if like else ""
    yield Finding(("agents", "embedder"), "is no embedder", '"lexical", "minilm" or "ollama:MODEL"', nearest_words)
