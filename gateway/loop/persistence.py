"""Keeps the disk at what was decided last, whatever order decisions and writes come in and whichever write fails.

What is granted (a deployment, a configuration that is kept, a model to watch by) is on the disk before it is done, so
that nobody is told what a power cut would undo: `write_ahead`. What is taken back is done first, and the disk follows:
`look`, once a period. Either way the disk is compared with the decision afterwards, and a write that failed is tried
again until it succeeds; that it failed is told.
"""

import asyncio
from collections.abc import Awaitable, Callable
from contextlib import suppress
from typing import TypeVar

from gateway.loop.aside import Aside
from gateway.loop.configurations import Configurations
from gateway.loop.experiment import Tell
from gateway.loop.kept import Durable, Store

T = TypeVar("T")

AGAIN_S = 1.0  #: after a write that failed
NOT_PERSISTED = "configuration-not-persisted"  #: kinds of event
PERSISTED = "configuration-persisted"


class NotPersisted(Exception):
    """The disk has refused what was to be on it before anything is done; the text says why."""


class Persistence:
    """Of one loop. `store` None: nothing outlives it."""

    def __init__(self, configurations: Configurations, store: Store | None, aside: Aside, tell: Tell | None) -> None:
        self._configurations = configurations
        self._store = store
        self._aside = aside
        self._tell = tell
        self._deciding = asyncio.Lock()  #: between a write ahead and what is decided on it nothing else is written
        self._agreed = configurations.changes  #: the change up to which the disk has been compared
        self._following: asyncio.Task[None] | None = None
        self._failed = ""  #: why the disk is behind; empty: no write has failed
        self._untold: list[tuple[str, str, dict[str, str]]] = []  #: kinds, texts and data of events

    @property
    def behind(self) -> bool:
        """Whether the disk is not known to have what was decided last."""
        return self._agreed != self._configurations.changes

    def look(self) -> None:
        """After each period: tell what has become of the disk, and bring it up to what was decided, aside."""
        untold, self._untold = self._untold, []
        for kind, text, data in untold:  # here, where an exception of whoever listens is a part's that fails
            if self._tell is not None:
                self._tell(kind, text, **data)
        self._begin_to_follow()

    def _begin_to_follow(self) -> None:
        if self._store is not None and self.behind and (self._following is None or self._following.done()):
            self._following = asyncio.create_task(self._follow())

    async def write_ahead(self, ahead: Callable[[], Durable], decide: Callable[[], Awaitable[T]]) -> T:
        """`ahead` on the disk, then `decide`, whose answer is returned. Raises NotPersisted.

        `ahead` is asked once nothing else is being written. Where it is decided otherwise, the disk follows.
        """
        async with self._deciding:
            if self._store is not None:
                await self._write_ahead(self._store, ahead())
            return await decide()

    async def _write_ahead(self, store: Store, durable: Durable) -> None:
        self._agreed = -1  # also where this is cut off: the disk is compared once more
        try:
            await self._aside.do(lambda: store.write(durable))
        except OSError as error:
            raise NotPersisted(f"nothing could be kept at {store.path}: {error.strerror or error}") from error

    async def caught_up(self, within_s: float) -> str:
        """Once the disk has what was decided last; after `within_s` why it has not, empty where it has."""
        self._begin_to_follow()
        if self._store is None or self._following is None:
            return ""
        with suppress(TimeoutError):
            async with asyncio.timeout(within_s):
                while self.behind:
                    self._begin_to_follow()
                    await asyncio.wait([self._following])
        return (self._failed or "the disk takes its time") if self.behind else ""

    async def _follow(self) -> None:
        """Until the disk has what was decided last."""
        store = self._store
        assert store is not None
        while self.behind:
            async with self._deciding:
                changes, durable = self._configurations.changes, self._configurations.durable
                try:
                    await self._aside.do(lambda durable=durable: store.settle(durable))
                except Exception as error:  # whatever it is, it is told and tried again
                    self._say_failed(f"{store.path}: {type(error).__name__}: {error}")
                else:
                    self._agreed = changes
                    self._say_persisted()
            if self._failed:
                await asyncio.sleep(AGAIN_S)

    def _say_failed(self, failed: str) -> None:
        if not self._failed:
            text = (
                "what was decided last is not on the disk, a loop that starts anew would not know it; free some space, "
                f"or let the disk be written; it is tried again every {AGAIN_S:g} s: {failed}"
            )
            self._untold.append((NOT_PERSISTED, text, {"error": failed}))
        self._failed = failed

    def _say_persisted(self) -> None:
        if self._failed:
            self._untold.append((PERSISTED, "what was decided last is on the disk", {}))
        self._failed = ""
