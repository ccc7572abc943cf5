"""The one way in which processes talk. Transports: in-process (tests, stepped time), unix socket, Zenoh (agents)."""

from collections.abc import Awaitable, Callable
from contextvars import ContextVar
from dataclasses import dataclass
from typing import Protocol

from gateway.core.topics import Topic

PublishHandler = Callable[[bytes], None]
RequestHandler = Callable[[bytes], Awaitable[bytes]]

#: Bytes; longer messages are refused on both sides. The kernel takes so much as one datagram: it allows twice
#: `net.core.wmem_max`, which is 212,992 where nobody has changed it.
MAX_PAYLOAD = 262_144


class Unreachable(Exception):
    """The other side is not there, or did not answer in time. The text says what to start."""


class NotSent(Unreachable):
    """Nothing was handed over, so nothing of what was asked is done. Any other `Unreachable` does not say so."""


class RemoteError(Unreachable):
    """The other side is there, but its handler failed or there is none. The text is what it said."""


@dataclass(frozen=True, slots=True)
class Peer:
    """Who is at the other end, as the kernel tells it; nothing the peer says of itself."""

    uid: int
    pid: int


#: The peer that asks or publishes, readable inside a handler; None where the transport cannot tell (in-process).
PEER: ContextVar[Peer | None] = ContextVar("peer", default=None)


#: Who has answered the last request of this task; None where the transport cannot tell (in-process, Zenoh).
ANSWERED: ContextVar[Peer | None] = ContextVar("answered", default=None)


@dataclass(slots=True)
class Counters:
    """What a mailbox has lived through. Only ever counted up."""

    dropped: int = 0  #: messages not handed over: nobody there, buffer full, too long
    malformed: int = 0  #: datagrams received that are no envelope
    late_answers: int = 0  #: answers to a request that had been given up
    refused: int = 0  #: requests and connections turned away because there were too many at once
    handler_errors: int = 0  #: exceptions out of handlers
    connects: int = 0
    last_error: str = ""


def no_answer(topic: Topic, timeout_s: float) -> str:
    """The sentence for a request that was sent and not answered in time."""
    return f"{topic.name} did not answer within {timeout_s:g} s; what was asked may have been done all the same"


def what_to_start(topic: Topic) -> str:
    """The sentence for an unreachable topic; the first part of a topic's name is the process that serves it.

    What agents ask begins with `ask`, and the gateway serves it.
    """
    process = topic.name.partition("/")[0].replace("ask", "gateway")
    return f"{process} not running: start it with `r2rgate {process} LINE.toml`"


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
