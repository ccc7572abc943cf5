"""The one way in which processes talk. Transports: in-process (tests, stepped time) and unix socket; Zenoh later."""

from collections.abc import Awaitable, Callable
from typing import Protocol

from gateway.core.topics import Topic

PublishHandler = Callable[[bytes], None]
RequestHandler = Callable[[bytes], Awaitable[bytes]]

MAX_PAYLOAD = 65536  #: bytes; longer messages are refused on both sides


class Unreachable(Exception):
    """The other side is not there, or did not answer in time. The text says what to start."""


class Mailbox(Protocol):
    def publish(self, topic: Topic, payload: bytes) -> bool:
        """Hand a message to whoever listens. Never blocks; False when it was dropped (nobody there, buffer full)."""
        ...

    def subscribe(self, topic: Topic, handler: PublishHandler) -> None:
        """Call `handler` for every message of a publish topic."""
        ...

    def serve(self, topic: Topic, handler: RequestHandler) -> None:
        """Answer the requests of a topic. One handler a topic."""
        ...

    async def request(self, topic: Topic, payload: bytes, timeout_s: float) -> bytes:
        """Ask and wait for the answer. Raises Unreachable."""
        ...

    async def close(self) -> None: ...
