"""The mailbox over Zenoh, for what may be on another machine: the agents. Never used by the loop.

Each name has site and line before it on the wire. All methods belong to the thread of the event loop.
"""

import asyncio
import time
from collections import defaultdict
from collections.abc import Callable
from contextlib import suppress

import zenoh

from gateway.core.topics import Topic
from gateway.mailbox.port import (
    MAX_PAYLOAD,
    Counters,
    PublishHandler,
    RemoteError,
    RequestHandler,
    Unreachable,
    no_answer,
    what_to_start,
)
from gateway.mailbox.zenoh_bridge import Bridge
from gateway.mailbox.zenoh_presence import Presence
from gateway.mailbox.zenoh_served import Served

SPARE_S = 1.0  #: after which Zenoh itself gives up a request whose time is over


class ZenohMailbox:
    """Over a session that it owns from now on. Made in a running event loop."""

    def __init__(
        self, session: zenoh.Session, site: str, line: str, clock: Callable[[], float] = time.monotonic
    ) -> None:
        self.counters = Counters(connects=1)
        self._session = session
        self._before = f"{site}/{line}/"
        self._clock = clock
        self._bridge = Bridge(self.counters)
        self._presence = Presence(session, self._bridge, self._gone)
        self._closed = False
        self._closing: asyncio.Task[None] | None = None
        self._publishers: dict[str, zenoh.Publisher] = {}
        self._served: dict[str, Served] = {}
        self._tokens: list[zenoh.LivelinessToken] = []  #: each as long as it is held
        self._pending: defaultdict[str, set[asyncio.Future[bytes]]] = defaultdict(set)

    def publish(self, topic: Topic, payload: bytes) -> bool:
        """True: somebody listens, and it was handed over. A message for one who does not keep up is dropped unseen."""
        try:
            publisher = self._publisher(topic)
            # The stub calls it a bool; it is an object that is always true.
            if len(payload) <= MAX_PAYLOAD and getattr(publisher.matching_status, "matching", False):
                publisher.put(payload)
                return True
        except zenoh.ZError as error:
            self.counters.last_error = f"{topic.name}: {error}"
        self._bridge.count("dropped")
        return False

    def subscribe(self, topic: Topic, handler: PublishHandler) -> None:
        def came(sample: zenoh.Sample) -> None:
            if len(sample.payload) > MAX_PAYLOAD:
                self._bridge.count("malformed")
            else:
                self._bridge.hand_over(self._deliver, topic, handler, bytes(sample.payload))

        self._session.declare_subscriber(self._key(topic), zenoh.handlers.Callback(came, indirect=False))

    def serve(self, topic: Topic, handler: RequestHandler) -> None:
        """Answer the requests of a topic, and be known as alive. Raises ValueError where it has a handler already."""
        if topic.name in self._served:
            raise ValueError(f"{topic.name} is served already")
        key = self._key(topic)
        served = self._served[topic.name] = Served(topic, key, handler, self._bridge, self._clock)
        # Complete: where two serve a topic, one of them is asked, not both.
        self._session.declare_queryable(key, zenoh.handlers.Callback(served.take, indirect=False), complete=True)
        self._tokens.append(self._session.liveliness().declare_token(key))

    def watch(self, topic: Topic, handler: Callable[[bool], None]) -> None:
        """Call `handler(True)` when somebody serves a topic, also from before, `handler(False)` when nobody does."""
        self._presence.watch(self._key(topic), handler)

    async def request(self, topic: Topic, payload: bytes, timeout_s: float) -> bytes:
        """Raises Unreachable, at once where nobody serves the topic; RemoteError where it could not be answered."""
        if len(payload) > MAX_PAYLOAD:
            raise RemoteError(f"{topic.name}: {len(payload)} bytes of payload, at most {MAX_PAYLOAD} are allowed")
        if self._closed:
            raise Unreachable(f"{topic.name}: this side has left the bus")
        key, loop = self._key(topic), self._bridge.loop
        future: asyncio.Future[bytes] = loop.create_future()
        self._pending[key].add(future)
        try:
            self._presence.watch(key)
            async with asyncio.timeout(timeout_s):
                await loop.run_in_executor(self._bridge.senders, self._ask, topic, payload, timeout_s, future)
                return await future
        except TimeoutError:
            raise Unreachable(no_answer(topic, timeout_s)) from None
        except zenoh.ZError as error:
            raise Unreachable(f"{topic.name}: {error}") from error
        finally:
            self._pending[key].discard(future)
            if not future.cancel() and not future.cancelled():
                future.exception()  # seen, also where the time was over in the same moment

    async def close(self) -> None:
        """Requests that still wait, on either side, end as unreachable.

        It goes on to its end where whoever waits is cancelled; called again, this waits for that end.
        """
        if self._closing is None:
            self._closed = True
            self._give_up(list(self._pending), "this side left the bus before there was an answer")
            self._closing = asyncio.get_running_loop().create_task(self._close())
        await asyncio.shield(self._closing)

    async def _close(self) -> None:
        for served in self._served.values():
            await served.close()
        # Elsewhere: it waits for callbacks, and those may wait for this thread's interpreter lock.
        await asyncio.to_thread(self._end)

    def _end(self) -> None:
        self._bridge.close()
        with suppress(zenoh.ZError):
            self._session.close()

    def _key(self, topic: Topic) -> str:
        return self._before + topic.name

    def _publisher(self, topic: Topic) -> zenoh.Publisher:
        if topic.name not in self._publishers:
            self._publishers[topic.name] = self._session.declare_publisher(
                self._key(topic), congestion_control=zenoh.CongestionControl.DROP
            )
        return self._publishers[topic.name]

    def _deliver(self, topic: Topic, handler: PublishHandler, payload: bytes) -> None:
        try:
            handler(payload)
        except Exception as error:
            self._bridge.failed(topic, error)

    def _ask(self, topic: Topic, payload: bytes, timeout_s: float, future: asyncio.Future[bytes]) -> None:
        """On a sender's thread. There comes an answer, or the end of all that might have answered."""

        def answered(reply: zenoh.Reply) -> None:
            self._bridge.call(self._resolve, future, _result(topic, reply))

        def over() -> None:
            nobody = Unreachable(f"nobody answers {topic.name}: {what_to_start(topic)}")
            self._bridge.call(self._resolve, future, nobody)

        self._session.get(
            self._key(topic),
            zenoh.handlers.Callback(answered, over, indirect=False),
            timeout=timeout_s + SPARE_S,
            congestion_control=zenoh.CongestionControl.BLOCK,  # until the transport gives up a peer that does not read
            payload=payload,
        )

    def _gone(self, key: str) -> None:
        """A request that has just missed who served it would wait for all its time."""
        self._give_up([key], f"{key}: who serves it went away before there was an answer")

    def _give_up(self, keys: list[str], why: str) -> None:
        for key in keys:
            for future in tuple(self._pending[key]):
                self._resolve(future, Unreachable(why))

    def _resolve(self, future: asyncio.Future[bytes], result: bytes | Unreachable) -> None:
        if future.done():
            self.counters.late_answers += isinstance(result, bytes) and future.cancelled()
        elif isinstance(result, bytes):
            future.set_result(result)
        else:
            future.set_exception(result)


def _result(topic: Topic, reply: zenoh.Reply) -> bytes | RemoteError:
    if reply.ok is None:
        text = b"" if reply.err is None else bytes(reply.err.payload)[:MAX_PAYLOAD]
        return RemoteError(text.decode("utf-8", "replace"))
    if len(reply.ok.payload) > MAX_PAYLOAD:
        length = len(reply.ok.payload)
        return RemoteError(f"{topic.name}: answer of {length} bytes, at most {MAX_PAYLOAD} are allowed")
    return bytes(reply.ok.payload)
