"""Whether the language model answers that the line's file names. Asks the server of itself; loads and asks nothing."""

from typing import TYPE_CHECKING

from gateway.cli.doctor_check import Check
from gateway.core.line import Agents

if TYPE_CHECKING:
    from agents.language_model.replies import Served

GROUP = "language model"
_GB = 1e9
_MEANWHILE = "until then the rules decide"


async def language_model(settings: Agents) -> list[Check]:
    """One check where no model is asked for or none answers; else those of the model."""
    if settings.llm == "off":
        return [Check(GROUP, "agents.llm", "", "OK", "off: the rules decide")]
    from agents.language_model.client import LanguageModel
    from agents.language_model.no_answer import NoAnswer

    try:
        async with LanguageModel(settings) as model:
            return judged(settings, await model.look())
    except NoAnswer as error:
        subject, wanted = ("model", settings.model) if error.kind == "no-model" else ("server", settings.url)
        todo = f"start it (`ollama serve`) or set agents.url; {_MEANWHILE}"
        todo = f"get it, or set agents.model to one that is there; {_MEANWHILE}" if subject == "model" else todo
        return [Check(GROUP, subject, "", "warning", error.text, wanted, todo)]


def judged(settings: Agents, served: "Served") -> list[Check]:
    """The server's version; the model's weights, whether they are in memory, and how much they can read."""
    size = "" if served.size_bytes is None else f", {served.size_bytes / _GB:.1f} GB"
    model = f"{served.model}, digest {served.digest[:12] or 'not told'}{size}"
    return [
        Check(GROUP, "server", "", "OK", f"Ollama {served.version} at {settings.url}"),
        Check(GROUP, "model", "", "OK", model, settings.model),
        Check(GROUP, "in memory", "", "OK", _in_memory(settings, served)),
        _context(settings, served),
    ]


def _in_memory(settings: Agents, served: "Served") -> str:
    if served.loaded_context_tokens is None:
        return f"not loaded: the first question waits for it, at most {settings.load_max_s:g} s"
    if served.loaded_context_tokens in (0, settings.context_tokens):
        return "loaded"
    other = f"loaded with a context of {served.loaded_context_tokens} tokens"
    return f"{other}: the first question loads it anew, at most {settings.load_max_s:g} s"


def _context(settings: Agents, served: "Served") -> Check:
    wanted = f"at least agents.context_tokens, {settings.context_tokens} tokens"
    has = served.trained_context_tokens
    if has is None:
        return Check(GROUP, "context", "", "warning", "the server does not say how much the model can read", wanted)
    if has >= settings.context_tokens:
        return Check(GROUP, "context", "", "OK", f"{has} tokens", wanted)
    todo = f"set agents.context_tokens to {has} or less; {_MEANWHILE}"
    return Check(GROUP, "context", "", "warning", f"{has} tokens", wanted, todo)
