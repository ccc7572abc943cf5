"""What an Ollama server answers to each request, without the wire: paths, fields, states and errors as the real one.

Written from the API's documentation and server (docs/api.md, api/types.go and server/routes.go of ollama/ollama).
"""

import asyncio
import hashlib
import json
import random
from collections.abc import AsyncIterator, Awaitable, Callable, Mapping, Sequence
from dataclasses import dataclass, field
from datetime import UTC, datetime
from typing import Any

from tests.stand_in.counting import count_tokens, pieces
from tests.stand_in.embedding import embed
from tests.stand_in.spoken import Persona, Spoken

VERSION = "0.12.3"
MODEL = "qwen3:4b"
TRAINED_CONTEXT = 40_960
FOR_EVER = "2318-01-01T00:00:00Z"
_DETAILS = {
    "parent_model": "",
    "format": "gguf",
    "family": "qwen3",
    "families": ["qwen3"],
    "parameter_size": "4.0B",
    "quantization_level": "Q4_K_M",
}
_NDJSON = "application/x-ndjson"
_JSON = "application/json; charset=utf-8"


class HangUp(Exception):
    """The connection ends here, in the middle of what is being said."""


@dataclass(frozen=True)
class Response:
    """`parts` may wait, and raise HangUp."""

    status: int
    content_type: str
    parts: AsyncIterator[bytes]


@dataclass
class Engine:
    """`most_context`: what it gives a model at most, whatever is asked. `pace`: times every delay; 0: none."""

    persona: Persona
    seed: int = 0
    models: Sequence[str] = (MODEL,)
    pace: float = 1.0
    load_s: float = 0.0
    most_context: int = TRAINED_CONTEXT
    sleep: Callable[[float], Awaitable[None]] = asyncio.sleep
    requests: list[tuple[str, dict[str, Any]]] = field(default_factory=list)  #: path and body, of all that came
    loaded: dict[str, int] = field(default_factory=dict)  #: model, tokens of context

    def handle(self, method: str, path: str, body: bytes) -> Response:
        try:
            asked = json.loads(body) if body else {}
        except ValueError as error:
            return _error(400, str(error))
        self.requests.append((path, asked))
        routes: dict[tuple[str, str], Callable[[dict[str, Any]], Response]] = {
            ("GET", "/api/version"): lambda _: _whole({"version": VERSION}),
            ("GET", "/api/tags"): lambda _: _whole({"models": [self._listed(name) for name in self.models]}),
            ("GET", "/api/ps"): lambda _: _whole({"models": [self._running(name) for name in self.loaded]}),
            ("POST", "/api/show"): self._show,
            ("POST", "/api/chat"): self._chat,
            ("POST", "/api/embed"): self._embed,
        }
        route = routes.get((method, path))
        if route is None:
            return Response(404, "text/plain", _one(b"404 page not found"))
        if method == "POST" and full_name(asked.get("model", "")) not in map(full_name, self.models):
            return _error(404, f"model '{asked.get('model')}' not found")
        return route(asked)

    def _listed(self, name: str) -> dict[str, Any]:
        full = full_name(name)
        modified = "2026-07-01T08:06:48.639712648Z"
        size = 2_497_293_931
        return {
            "name": full, "model": full, "modified_at": modified, "size": size, "digest": digest(full),
            "details": _DETAILS,
        }  # fmt: skip

    def _running(self, name: str) -> dict[str, Any]:
        running = {key: value for key, value in self._listed(name).items() if key != "modified_at"}
        return running | {"expires_at": FOR_EVER, "size_vram": 0, "context_length": self.loaded[name]}

    def _show(self, asked: dict[str, Any]) -> Response:
        info = {"general.architecture": "qwen3", "qwen3.context_length": TRAINED_CONTEXT}
        shown = {"modelfile": "", "template": "{{ .Prompt }}", "details": _DETAILS, "model_info": info}
        return _whole(shown | {"capabilities": ["completion", "tools", "thinking"]})

    def _embed(self, asked: dict[str, Any]) -> Response:
        given = asked.get("input", "")
        texts = [given] if isinstance(given, str) else list(given)
        vectors = [embed(text, asked.get("dimensions")) for text in texts]
        counted = sum(map(count_tokens, texts))
        return _whole({"model": asked["model"], "embeddings": vectors, "total_duration": 14143917,
                       "load_duration": 1019500, "prompt_eval_count": counted})  # fmt: skip

    def _chat(self, asked: dict[str, Any]) -> Response:
        messages: list[dict[str, Any]] = asked.get("messages") or []
        options: dict[str, Any] = asked.get("options") or {}
        model, streamed = str(asked["model"]), asked.get("stream", True)
        if not messages:
            return Response(200, _JSON, self._load(model, options, asked.get("keep_alive")))
        seed = hashlib.sha256(json.dumps([self.seed, options.get("seed", 0), messages, asked.get("format")]).encode())
        said = self.persona(messages, asked.get("format"), random.Random(seed.digest()))
        if said.status != 200:
            return _error(said.status, said.text)
        lines = self._lines(model, messages, options, said)
        return Response(200, _NDJSON, lines) if streamed else Response(200, _JSON, _joined(lines))

    async def _load(self, model: str, options: Mapping[str, Any], keep_alive: object) -> AsyncIterator[bytes]:
        """Without messages a model is loaded, or with keep_alive 0 unloaded."""
        unload = keep_alive == 0
        if unload:
            self.loaded.pop(full_name(model), None)
        else:
            await self._in_memory(model, options)
        yield _line(_part(model, "") | {"done_reason": "unload" if unload else "load", "done": True})

    async def _in_memory(self, model: str, options: Mapping[str, Any]) -> int:
        context = min(int(options.get("num_ctx", 4096)), self.most_context)
        if self.loaded.get(full_name(model)) != context:
            await self.sleep(self.load_s * self.pace)
            self.loaded[full_name(model)] = context
        return context

    async def _lines(
        self, model: str, messages: Sequence[Mapping[str, Any]], options: Mapping[str, Any], said: Spoken
    ) -> AsyncIterator[bytes]:
        context = await self._in_memory(model, options)
        if said.raw is not None:
            yield said.raw
            return
        read = sum(count_tokens(message.get("content", "")) for message in messages)
        read = read if read < context else context // 2  # what does not fit is cut, without a word
        spoken = pieces(said.text)
        most = min(options.get("num_predict", -1) % 2**31, context - read)
        until = len(spoken) if said.after_tokens is None else min(said.after_tokens, len(spoken))
        if said.thinking:
            yield _line(_part(model, "", said.thinking) | {"done": False})
        for piece in spoken[: min(most, until)]:
            await self.sleep(said.token_s * self.pace)
            yield _line(_part(model, piece) | {"done": False})
        if said.end == "hang-up":
            raise HangUp
        if said.end == "hang":
            await asyncio.Event().wait()
        if said.end == "error":
            yield _line({"error": "an error was encountered while running the model"})
            return
        reason = "length" if said.end == "length" or most < until else "stop"
        counts = {"prompt_eval_count": max(int(read * said.read_share), 1), "eval_count": min(most, until) + 1}
        durations = {"total_duration": 4883583458, "load_duration": 1334875, "prompt_eval_duration": 342546000,
                     "eval_duration": 4535599000}  # fmt: skip
        yield _line(_part(model, "") | {"done_reason": reason, "done": True} | durations | counts)


def full_name(model: str) -> str:
    return model if ":" in model else f"{model}:latest"


def digest(model: str) -> str:
    """Of the weights that the stand-in does not have: 64 hexadecimal digits by the name."""
    return hashlib.sha256(model.encode()).hexdigest()


def _part(model: str, content: str, thinking: str = "") -> dict[str, Any]:
    message = {"role": "assistant", "content": content} | ({"thinking": thinking} if thinking else {})
    return {"model": model, "created_at": datetime.now(UTC).isoformat().replace("+00:00", "Z"), "message": message}


def _line(document: Mapping[str, Any]) -> bytes:
    return json.dumps(document).encode() + b"\n"


def _whole(document: Mapping[str, Any]) -> Response:
    return Response(200, _JSON, _one(json.dumps(document).encode()))


def _error(status: int, text: str) -> Response:
    return Response(status, _JSON, _one(json.dumps({"error": text}).encode()))


async def _one(part: bytes) -> AsyncIterator[bytes]:
    yield part


async def _joined(lines: AsyncIterator[bytes]) -> AsyncIterator[bytes]:
    """The stream as one answer: the words of all its lines in the last one."""
    documents = [json.loads(line) async for line in lines]
    last = documents[-1]
    if "message" in last:
        last["message"]["content"] = "".join(one["message"]["content"] for one in documents)
    yield json.dumps(last).encode()
