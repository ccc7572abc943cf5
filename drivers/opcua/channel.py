"""The way between the link, in the loop, and the engine that holds the OPC UA client: a port with two sides.

`process.ProcessChannel` puts the engine into a process of its own, which is what a line runs on: whatever a server
sends, the loop is not slowed by it. `inprocess.EngineChannel` keeps it in the same event loop, for stepped time.
"""

import asyncio
from collections.abc import Callable
from typing import Protocol

from drivers.opcua.messages import Answer, Question


class Channel(Protocol):
    """One engine, started again when it ends. Nothing here waits, except `close`."""

    up: asyncio.Event  #: an engine is there and takes questions

    def start(self, on_answer: Callable[[Answer], None], on_lost: Callable[[str], None]) -> None:
        """Start the engine, once. `on_lost(why)` is told when it has ended. Raises OSError."""
        ...

    def tend(self, now_s: float) -> None:
        """Once a cycle: start an engine that has ended again, when its pause is over."""
        ...

    def ask(self, question: Question) -> bool:
        """Hand over a question. False when nobody takes it; there is no answer then."""
        ...

    def give_up(self, why: str) -> None:
        """End an engine that does not answer; `on_lost` is told."""
        ...

    async def close(self) -> None:
        """End the engine in order. Idempotent."""
        ...
