"""What the agents look up: notes, documents of people, and what the gateway tells of the line, kept up to date.

The index that is there serves until the next one is whole. Where anything fails, what was known before still is.
"""

import asyncio
from collections.abc import Awaitable, Callable, Sequence
from contextlib import AbstractAsyncContextManager, AsyncExitStack, suppress
from pathlib import Path
from typing import Protocol, Self

from agents.line_on_bus import LineKnown, LineNotTold
from agents.rag.embedder import Embedder, EmbedderFailed, Vectors
from agents.rag.index import Index
from agents.rag.index_file import IndexRefused
from agents.rag.library import INDEX, open_library
from agents.rag.stages import Asked, Retrieval
from gateway.core.line_queries import Generated

LOOK_S = 10.0  #: from one look at the line to the next
FIRST_S = 5.0  #: for the line to tell, and for the embedder to be there, before agents answer without them
QUESTION_S = 5.0  #: for the embedder to read a question: an agent has other things to do with its time
_Failed = (IndexRefused, EmbedderFailed, OSError)
#: The embedder that is wanted; None: none is. Raises EmbedderFailed while it is not there.
Find = Callable[[], Awaitable[Embedder | None]]


class LineSide(Protocol):
    async def knowledge_since(self, revision: str | None) -> LineKnown | None:
        """None: it is still as it was at `revision`. Raises LineNotTold."""
        ...


class Knowledge:
    """`begin` it, then `keep_up` beside all else; `search` at any time. An asynchronous context manager."""

    def __init__(self, folder: Path, line: LineSide, find: Find, tell: Callable[[str], None]) -> None:
        self._folder = folder
        self._line = line
        self._find = find
        self._away = True  #: the embedder that is wanted has not been found yet
        self._embedder: Embedder | None = None  #: None: by words alone
        self._held = AsyncExitStack()
        self._tell = tell
        self._index: Index | None = None
        self._of_line: LineKnown | None = None  #: None: nobody has told; what was known of the line before stays
        self._told: dict[str, str] = {}  #: what stands in the way, by what it is

    async def __aenter__(self) -> Self:
        return self

    async def __aexit__(self, *_: object) -> None:
        if self._index is not None:
            self._index.close()
        await self._held.aclose()

    async def begin(self) -> None:
        """Until something can be looked up: by an embedder only where that costs no vectors."""
        with suppress(TimeoutError):
            async with asyncio.timeout(FIRST_S):
                await self.hear()
        try:
            async with asyncio.timeout(FIRST_S):
                await self._find_embedder()
        except TimeoutError:  # it is waited for beside the answers
            self._say("embedder", f"things are looked up by words: no embedder within {FIRST_S:g} s")
        if self._embedder is None and not self._away:
            await self.look()
            return
        try:
            self._index = await asyncio.to_thread(Index, self._folder / INDEX)
        except IndexRefused:  # there is none yet
            await self._make(None)

    async def keep_up(self) -> None:
        """For as long as the agents run."""
        while True:
            try:
                await self.hear()
                await self.look()
                self._say("looking", "")
            except Exception as error:  # whatever it is: the agents answer with what they have
                self._say("looking", f"what is known stays as it was: {type(error).__name__}: {error}")
            await asyncio.sleep(LOOK_S)

    async def look(self) -> None:
        """At what it is made of: another index where that has changed."""
        await self._find_embedder()
        await self._make(self._embedder)

    async def search(self, asked: Asked) -> Retrieval:
        """By meaning where the index has vectors of the embedder, else by words. Raises IndexRefused."""
        vectors = await self._vectors(asked.question)
        if self._index is None:
            raise IndexRefused(self._told.get("index", "nothing is indexed yet"))
        return self._index.retrieve(asked, vectors if self._comparable() else None)

    async def hear(self) -> None:
        """What is known of the line, where that has changed."""
        try:
            known = await self._line.knowledge_since(None if self._of_line is None else self._of_line.revision)
        except LineNotTold as error:
            self._say("line", f"what is known of the line is as it was: {error}")
            return
        self._say("line", "")
        if known is not None:
            self._of_line = known
            for text in known.left_out:
                self._tell(f"left out of what is known: {text}")

    async def _find_embedder(self) -> None:
        """Tried until it is there; from then on it is kept."""
        if not self._away:
            return
        try:
            found = await self._find()
        except EmbedderFailed as error:
            self._say("embedder", f"things are looked up by words: {error}")
            return
        if isinstance(found, AbstractAsyncContextManager):
            await self._held.enter_async_context(found)
        self._embedder, self._away = found, False
        self._say("embedder", "")

    async def _make(self, embedder: Embedder | None) -> None:
        generated = None if self._of_line is None else self._of_line.documents
        try:
            opened = await self._opened(embedder, generated)
        except _Failed as error:
            self._say("index", f"the index stays as it was: {error}" if self._index else f"nothing is indexed: {error}")
            return
        self._say("index", "")
        before, self._index = self._index, opened
        if before is None or before.state != opened.state or before.embedder != opened.embedder:
            self._tell(f"{opened.documents_count} documents are known{_by(embedder)}")
        if before is not None:
            before.close()

    async def _opened(self, embedder: Embedder | None, generated: Sequence[Generated] | None) -> Index:
        """Anew where the one that is there was made by another embedder: what they made is never mixed. While the one
        that is wanted is away, an index with vectors stays as it is: to make them again may take long."""
        try:
            return (await open_library(self._folder, 3, embedder, generated)).index
        except IndexRefused:
            if self._away:
                return await asyncio.to_thread(Index, self._folder / INDEX)
            return (await open_library(self._folder, 3, embedder, generated, reindex=True)).index

    async def _vectors(self, question: str) -> Vectors | None:
        if self._embedder is None or not self._comparable():
            return None
        try:
            async with asyncio.timeout(QUESTION_S):
                found = await self._embedder.embed([question])
        except TimeoutError:
            self._say("embedder", f"looked up by words: no vector within {QUESTION_S:g} s")
            return None
        except EmbedderFailed as error:
            self._say("embedder", f"looked up by words: {error}")
            return None
        self._say("embedder", "")
        return found

    def _comparable(self) -> bool:
        """Another index may take the place of this one while a question is embedded."""
        index, embedder = self._index, self._embedder
        return index is not None and embedder is not None and index.embedder == embedder.identity

    def _say(self, what: str, text: str) -> None:
        """Once, until it is another; empty: it is well."""
        if text and text != self._told.get(what):
            self._tell(text)
        self._told[what] = text


def _by(embedder: Embedder | None) -> str:
    return "" if embedder is None else f", with vectors of {embedder.identity.name}"
