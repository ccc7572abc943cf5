"""A language model behind Ollama: looked at, loaded, asked. Whatever goes wrong is a NoAnswer.

Every request names the size of the context, since what is longer than the server's own choice is cut without a word,
and bounds the answer. A request has a format or tools, never both: here no request has tools.
"""

import asyncio
import time
from collections.abc import AsyncIterator, Callable, Sequence
from dataclasses import replace
from types import TracebackType
from typing import Any, Self

import httpx
import ollama

from agents.language_model.bounded import BoundedTransport
from agents.language_model.budget import Budget
from agents.language_model.no_answer import NoAnswer, told_as_no_answer
from agents.language_model.replies import Collected, Reply, Said, Served, listed_model, loaded_context, served
from agents.language_model.tokens import TEMPLATE_TOKENS, most_tokens
from gateway.core.line import Agents

CONNECT_MAX_S = 5.0
LOOK_MAX_S = 10.0  #: for all that the server says of itself
STAYS_LOADED = -1  #: keep_alive: for ever; to load a model again takes a minute

Heard = Callable[[str], None]  #: is told each piece of an answer as it comes
Transport = httpx.AsyncBaseTransport


class LanguageModel:
    """The model of `settings`. `close` it, or use it as an asynchronous context manager.

    `clock` (s) is only subtracted from itself; time-outs are the event loop's. `transport` carries the requests.
    """

    def __init__(
        self, settings: Agents, clock: Callable[[], float] = time.monotonic, transport: Transport | None = None
    ) -> None:
        self.settings = settings
        self._clock = clock
        longest_s = max(settings.load_max_s, settings.answer_max_s)
        common: dict[str, Any] = {
            "timeout": httpx.Timeout(longest_s, connect=CONNECT_MAX_S),
            "trust_env": False,  # no proxy of whoever started this
            "follow_redirects": False,
            "headers": {"accept-encoding": "identity"},
            "transport": BoundedTransport(transport or httpx.AsyncHTTPTransport(trust_env=False)),
        }
        self._ollama = ollama.AsyncClient(settings.url, **common)
        self._chat: Any = self._ollama.chat  # pyright: ignore[reportUnknownMemberType]
        self._http = httpx.AsyncClient(base_url=settings.url, **common)

    async def __aenter__(self) -> Self:
        return self

    async def __aexit__(self, kind: type[BaseException] | None, error: Any, trace: TracebackType | None) -> None:
        await self.close()

    async def close(self) -> None:
        await self._ollama.close()
        await self._http.aclose()

    def now_s(self) -> float:
        return self._clock()

    async def look(self) -> Served:
        """What the server says of itself and of the model, without loading it. Raises NoAnswer."""
        with told_as_no_answer(self.settings.url):
            async with asyncio.timeout(LOOK_MAX_S):
                response = await self._http.get("/api/version")
                if response.is_error:
                    raise ollama.ResponseError(response.text, response.status_code)
                version = str(response.json()["version"])
                listed = listed_model(self.settings, await self._ollama.list())
                loaded = await self._ollama.ps()
                return served(self.settings, version, listed, loaded, await self._ollama.show(self.settings.model))

    async def ready(self) -> Served:
        """The model, loaded with the whole context; loads it where it is not. Raises NoAnswer."""
        found = await self.look()
        if found.loaded_context_tokens == self.settings.context_tokens:
            return found
        found = replace(found, loaded_context_tokens=None)  # it may be in memory with another context
        found.check_context(self.settings)
        with told_as_no_answer(self.settings.url):
            async with asyncio.timeout(self.settings.load_max_s):
                await self._chat(self.settings.model, [], options=self._options(), keep_alive=STAYS_LOADED)
                loaded = loaded_context(self.settings.model, await self._ollama.ps())
        found = replace(found, loaded_context_tokens=loaded)
        found.check_context(self.settings)
        return found

    async def chat(
        self,
        messages: Sequence[Said],
        within_s: float,
        budget: Budget,
        answer_format: dict[str, Any] | None = None,
        think: bool | None = False,
        heard: Heard | None = None,
    ) -> Reply:
        """One answer to `messages`, streamed, within `within_s` from now. Raises NoAnswer.

        `answer_format`: a JSON schema that the engine holds the answer to, where it can. `think`: None leaves it to the
        model, which then thinks where it can.
        """
        budget.check()
        self._check_fits(messages)
        began_s, collected = self._clock(), Collected()
        try:
            with told_as_no_answer(self.settings.url, lambda: collected.text):
                async with asyncio.timeout(max(within_s, 0.0)):
                    stream: AsyncIterator[ollama.ChatResponse] = await self._chat(
                        self.settings.model,
                        messages=[{"role": said.role, "content": said.content} for said in messages],
                        stream=True,
                        think=think,
                        format=answer_format,
                        options=self._options(),
                        keep_alive=STAYS_LOADED,
                    )
                    async for part in stream:
                        piece = collected.add(part)
                        if piece and heard is not None:
                            heard(piece)
            return collected.reply(messages, self.settings, self._clock() - began_s)
        finally:
            budget.spend(collected.tokens(messages))

    def _check_fits(self, messages: Sequence[Said]) -> None:
        asked = sum(most_tokens(said.content) + TEMPLATE_TOKENS for said in messages)
        room = self.settings.context_tokens - self.settings.answer_tokens
        if asked > room:
            text = f"the question may have {asked} tokens (estimated); allowed: {room}, which is agents.context_tokens "
            raise NoAnswer("too-long", f"{text}({self.settings.context_tokens}) less agents.answer_tokens")

    def _options(self) -> dict[str, Any]:
        return {
            "num_ctx": self.settings.context_tokens,
            "num_predict": self.settings.answer_tokens,
            "temperature": self.settings.temperature,
            "seed": self.settings.seed,
        }
