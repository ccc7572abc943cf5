"""What finds by meaning, by the name that a line's file or a command gives it."""

from agents.rag.embedder import Embedder, EmbedderFailed
from gateway.core.nearest import nearest

ALLOWED = "lexical, minilm, ollama:MODEL"


async def embedder_named(wanted: str, url: str) -> Embedder | None:
    """None: by words alone. `url`: of Ollama, which is asked only where it is named. Raises EmbedderFailed."""
    kind, _, model = wanted.partition(":")
    if wanted == "lexical":
        return None
    if wanted == "minilm":
        from agents.rag.minilm import MiniLm

        return MiniLm()
    if kind == "ollama" and model:
        from agents.rag.ollama_embedder import OllamaEmbedder

        return await OllamaEmbedder.begin(model, url)
    like = nearest(kind, ("lexical", "minilm", "ollama"))
    hint = f"; did you mean {like}{':MODEL' if like == 'ollama' else ''}?" if like else ""
    raise EmbedderFailed(f"{wanted} is no embedder; allowed: {ALLOWED}{hint}")
