"""From Zenoh's threads to the event loop's, and back.

Zenoh calls back on threads of its own. There a message is only looked at, counted and handed over, and never more than
the event loop takes. What may wait for the other side is sent from threads of this file.
"""

import asyncio
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from threading import Lock
from typing import Any, Literal

from gateway.core.topics import Topic
from gateway.mailbox.port import Counters

MOST_WAITING = 1024  #: messages handed to the event loop that it has not taken yet
SENDERS = 4  #: threads that send: one that waits for a stopped peer does not hold up the others


class Bridge:
    """Made in a running event loop, `close` it from another thread."""

    def __init__(self, counters: Counters) -> None:
        self.loop = asyncio.get_running_loop()
        self.senders = ThreadPoolExecutor(SENDERS, thread_name_prefix="bus")
        self.lock = Lock()  #: of the counters and of whatever both sides change
        self._counters = counters
        self._waiting = 0

    def hand_over(self, call: Callable[..., None], *arguments: Any) -> bool:
        """Have the event loop call it. False, and counted, where the event loop does not keep up or is closed."""
        with self.lock:
            if self._waiting >= MOST_WAITING:
                self._counters.dropped += 1
                return False
            self._waiting += 1
        return self.call(self._taken, call, arguments)

    def call(self, call: Callable[..., None], *arguments: Any) -> bool:
        """As `hand_over`, for what is bounded otherwise."""
        try:
            self.loop.call_soon_threadsafe(call, *arguments)
        except RuntimeError:  # it is closed
            return False
        return True

    def count(self, name: Literal["dropped", "malformed", "refused"]) -> None:
        with self.lock:
            setattr(self._counters, name, getattr(self._counters, name) + 1)

    def failed(self, topic: Topic, error: Exception) -> None:
        """A handler has. In the event loop's thread."""
        self._counters.handler_errors += 1
        self._counters.last_error = f"{topic.name}: {type(error).__name__}: {error}"

    def close(self) -> None:
        """Waits until what is being sent is sent, or given up."""
        self.senders.shutdown()

    def _taken(self, call: Callable[..., None], arguments: tuple[Any, ...]) -> None:
        with self.lock:
            self._waiting -= 1
        call(*arguments)
