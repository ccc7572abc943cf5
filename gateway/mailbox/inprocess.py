"""The mailbox between parties of one process: stepped time and tests. Publishing calls the handlers at once."""

import asyncio
from collections import defaultdict

from gateway.core.topics import Topic
from gateway.mailbox.port import (
    MAX_PAYLOAD,
    Counters,
    NotSent,
    PublishHandler,
    RemoteError,
    RequestHandler,
    Unreachable,
    no_answer,
    what_to_start,
)


class Hub:
    """Where the parties of one process meet."""

    def __init__(self) -> None:
        self.subscribers: defaultdict[str, list[tuple[object, PublishHandler]]] = defaultdict(list)
        self.servers: dict[str, tuple[object, RequestHandler]] = {}


class InProcessMailbox:
    """One party at a hub. A handler's exception is counted and never reaches the publisher, as over a wire."""

    def __init__(self, hub: Hub) -> None:
        self._hub = hub
        self.counters = Counters()

    def publish(self, topic: Topic, payload: bytes) -> bool:
        subscribers = self._hub.subscribers.get(topic.name)
        if not subscribers or len(payload) > MAX_PAYLOAD:
            self.counters.dropped += 1
            return False
        for _, handler in subscribers:
            try:
                handler(payload)
            except Exception as error:
                self._failed(topic, error)
        return True

    def subscribe(self, topic: Topic, handler: PublishHandler) -> None:
        self._hub.subscribers[topic.name].append((self, handler))

    def serve(self, topic: Topic, handler: RequestHandler) -> None:
        """Answer the requests of a topic. Raises ValueError where it has a handler already."""
        if topic.name in self._hub.servers:
            raise ValueError(f"{topic.name} is served already")
        self._hub.servers[topic.name] = (self, handler)

    async def request(self, topic: Topic, payload: bytes, timeout_s: float) -> bytes:
        server = self._hub.servers.get(topic.name)
        if server is None:
            raise NotSent(what_to_start(topic))
        _check_length(topic, "request", payload)
        task = asyncio.ensure_future(server[1](payload))
        done, _ = await asyncio.wait((task,), timeout=timeout_s)
        if not done:
            task.cancel()
            raise Unreachable(no_answer(topic, timeout_s))
        if task.cancelled():
            raise Unreachable(f"{topic.name} was cancelled")
        error = task.exception()
        if error is not None:
            self._failed(topic, error)
            raise RemoteError(f"{topic.name} failed: {type(error).__name__}: {error}") from error
        _check_length(topic, "answer", task.result())
        return task.result()

    async def close(self) -> None:
        """Leave the hub. Idempotent."""
        for name, subscribers in self._hub.subscribers.items():
            self._hub.subscribers[name] = [entry for entry in subscribers if entry[0] is not self]
        self._hub.servers = {name: entry for name, entry in self._hub.servers.items() if entry[0] is not self}

    def _failed(self, topic: Topic, error: BaseException) -> None:
        self.counters.handler_errors += 1
        self.counters.last_error = f"{topic.name}: {type(error).__name__}: {error}"


def _check_length(topic: Topic, what: str, payload: bytes) -> None:
    if len(payload) > MAX_PAYLOAD:
        raise RemoteError(f"{topic.name}: {what} of {len(payload)} bytes, at most {MAX_PAYLOAD} are allowed")
