"""A topic that is served over Zenoh: requests are refused at the door, or answered in the event loop.

The door is on Zenoh's thread, and whoever floods stays there: no more requests than `Topic.most_per_s`, nor than
MAX_IN_FLIGHT at once, reach the event loop, and none that is for several keys or too long. Each has a place for
`Topic.within_s`; then it is free, and what only reads is cut.
"""

import asyncio
from collections.abc import Callable
from contextlib import suppress
from typing import Any, NamedTuple

import zenoh

from gateway.core.topics import Topic
from gateway.mailbox.allowance import Allowance
from gateway.mailbox.places import MAX_OVERDUE
from gateway.mailbox.port import MAX_PAYLOAD, RequestHandler
from gateway.mailbox.zenoh_bridge import Bridge

MAX_IN_FLIGHT = 8  #: requests of one topic that are answered at the same time


class _Failure(NamedTuple):
    """An answer that is none."""

    text: str


class Served:
    def __init__(
        self, topic: Topic, key: str, handler: RequestHandler, bridge: Bridge, clock: Callable[[], float]
    ) -> None:
        self._topic = topic
        self._key = key
        self._handler = handler
        self._bridge = bridge
        self._clock = clock
        self._allowance = None if topic.most_per_s is None else Allowance(topic.most_per_s)
        self._in_flight = 0
        self._answering: set[asyncio.Task[None]] = set()
        self._handling: set[asyncio.Future[bytes]] = set()  #: more than have a place, where what acts goes on
        self._closed = False

    def take(self, query: zenoh.Query) -> None:
        """On a thread of Zenoh."""
        payload = query.payload
        if reason := self._why_not(str(query.key_expr), 0 if payload is None else len(payload)):
            self._bridge.count("refused")
            _send(query, _Failure(reason))
        elif not self._bridge.hand_over(self._begin, query, b"" if payload is None else bytes(payload)):
            self._done()
            _send(query, None)

    async def close(self) -> None:
        """What is being answered is not any more."""
        self._closed = True
        tasks: list[asyncio.Future[Any]] = [*self._answering, *self._handling]
        for task in tasks:
            task.cancel()
        await asyncio.gather(*tasks, return_exceptions=True)

    def _why_not(self, key: str, length: int) -> str:
        """Why a request is refused; empty: it is in flight now."""
        name = self._topic.name
        if key != self._key:
            return f"{key} is more than one key; allowed: {self._key}"
        if length > MAX_PAYLOAD:
            return f"{name}: {length} bytes of payload, at most {MAX_PAYLOAD} are allowed"
        with self._bridge.lock:
            if self._in_flight >= MAX_IN_FLIGHT:
                return f"{name}: more than {MAX_IN_FLIGHT} requests at once"
            if len(self._handling) >= MAX_OVERDUE:
                return f"{name}: {MAX_OVERDUE} requests before it have not come to their end"
            if self._allowance is not None and not self._allowance.take(self._clock()):
                return f"{name}: more than {self._topic.rate}; ask again later"
            self._in_flight += 1
        return ""

    def _begin(self, query: zenoh.Query, payload: bytes) -> None:
        if self._closed:  # the session ends, and all its requests with it
            return
        task = self._bridge.loop.create_task(self._answer(query, payload))
        self._answering.add(task)
        task.add_done_callback(self._answering.discard)

    async def _answer(self, query: zenoh.Query, payload: bytes) -> None:
        said: bytes | _Failure | None = None
        try:
            said = await self._said(payload)
        finally:
            self._bridge.senders.submit(_send, query, said).add_done_callback(lambda _: self._done())

    async def _said(self, payload: bytes) -> bytes | _Failure:
        name = self._topic.name
        handling = asyncio.ensure_future(self._handler(payload))
        self._handling.add(handling)
        handling.add_done_callback(self._handled)
        done, _ = await asyncio.wait((handling,), timeout=self._topic.within_s)
        if not done:
            if not self._topic.acts:
                handling.cancel()
            late = TimeoutError(f"no answer within {self._topic.within_s:g} s")
            self._bridge.failed(self._topic, late)
            return _Failure(f"{name}: {late}")
        try:
            answer = handling.result()
        except Exception as error:
            self._bridge.failed(self._topic, error)
            return _Failure(f"{name} failed: {type(error).__name__}: {error}")
        if len(answer) > MAX_PAYLOAD:
            return _Failure(f"{name}: answer of {len(answer)} bytes, at most {MAX_PAYLOAD} are allowed")
        return answer

    def _handled(self, handling: asyncio.Future[bytes]) -> None:
        self._handling.discard(handling)
        if not handling.cancelled():
            handling.exception()  # looked at, also where nobody waits for it any more

    def _done(self) -> None:
        with self._bridge.lock:
            self._in_flight -= 1


def _send(query: zenoh.Query, said: bytes | _Failure | None) -> None:
    """None: nothing, which ends the request all the same."""
    with suppress(zenoh.ZError), query:
        if isinstance(said, bytes):
            query.reply(query.key_expr, said)
        elif said is not None:
            query.reply_err(said.text.encode("utf-8", "replace")[:MAX_PAYLOAD])
