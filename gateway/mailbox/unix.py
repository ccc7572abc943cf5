"""The mailbox between processes of one machine: AF_UNIX, SOCK_SEQPACKET, one envelope a datagram.

A party listens on a path, or dials others by path, or both. Whatever a peer does (flood, stall, die, send rubbish),
this side neither waits nor fails: sending is one non-blocking call into a bounded kernel buffer, reading has a budget,
and what cannot be handed over is dropped and counted. A request has a place for as long as its topic allows
(`places`). All methods belong to the thread of the event loop.
"""

import asyncio
import socket
import time
from collections import Counter, defaultdict
from collections.abc import Callable, Iterable
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from dataclasses import dataclass
from functools import partial
from itertools import count
from pathlib import Path

from gateway.core.topics import Topic
from gateway.mailbox.codec import Envelope, Kind, MalformedEnvelope, encode
from gateway.mailbox.connection import Connection, receive_buffer
from gateway.mailbox.crowd import who_makes_room
from gateway.mailbox.dial import dial, dial_patiently
from gateway.mailbox.listener import Listener, accepted_at_once, check_path
from gateway.mailbox.places import MAX_OVERDUE, most_at_once, safe_command, within_s
from gateway.mailbox.port import (
    ANSWERED,
    MAX_PAYLOAD,
    PEER,
    Counters,
    NotSent,
    PublishHandler,
    RemoteError,
    RequestHandler,
    Unreachable,
    no_answer,
    what_to_start,
)
from gateway.mailbox.turns import MAX_PER_WINDOW, Turns
from gateway.mailbox.who_serves import ServedByStranger

RECONNECT_S = 1.0  #: a publisher looks for a lost listener at most this often
MAX_CONNECTIONS = 32
DIALLERS = 4  #: threads in which a place in a backlog is waited for


PATIENCE_S = 1.0  #: of a request, for a place among those who wait to be taken


class Crowded(NotSent):
    """So many wait to be taken that there is no place to wait."""


@dataclass(slots=True, eq=False)
class _Request:
    """One that has a place."""

    connection: Connection
    envelope: Envelope
    topic: Topic
    place: str  #: that it has, of its peer
    within_s: float
    is_over: bool = False  #: its time: the place is free, and who asked has been told
    task: "asyncio.Task[None] | None" = None


class UnixMailbox:
    def __init__(self, clock: Callable[[], float] = time.monotonic, most_per_window: int = MAX_PER_WINDOW) -> None:
        """`most_per_window`: see `Turns`."""
        self.counters = Counters()
        self._clock = clock
        self._most_per_window = most_per_window
        self._listeners: list[Listener] = []
        self._accepted: set[Connection] = set()
        self._routes: dict[str, Path] = {}
        self._dialled: dict[Path, Connection] = {}
        self._next_dial_s: dict[Path, float] = {}
        self._subscribers: defaultdict[str, list[PublishHandler]] = defaultdict(list)
        self._servers: dict[str, tuple[Topic, RequestHandler]] = {}
        self._answering: set[asyncio.Task[None]] = set()
        self._overdue: Counter[str] = Counter()  #: by topic that acts: begun, past their time and not at their end
        self._diallers: ThreadPoolExecutor | None = None  #: of its own: a stop waits behind no store
        self._ids = count(1)
        self._buffer = receive_buffer()
        self._turns: Turns | None = None  #: from the first connection on

    async def listen(self, path: Path) -> None:
        """Take connections on `path`. Raises PathTooLong, AlreadyRunning, CannotListen (see `listener`)."""
        listener = Listener(path)
        self._listeners.append(listener)
        self._heed(listener)

    def connect(self, topics: Iterable[Topic], path: Path) -> None:
        """Send `topics` to whoever listens on `path`; dialled when needed. Raises PathTooLong."""
        check_path(path)
        for topic in topics:
            self._routes[topic.name] = path

    def publish(self, topic: Topic, payload: bytes) -> bool:
        path = self._routes.get(topic.name)
        connection = None if path is None else self._dialled.get(path) or self._redial(path)
        if connection is None:
            self.counters.dropped += 1
            return False
        try:
            datagram = encode(Envelope(Kind.PUBLISH, topic.name, 0, payload))
        except MalformedEnvelope as error:
            self.counters.dropped += 1
            self.counters.last_error = str(error)
            return False
        return connection.send(datagram)

    def subscribe(self, topic: Topic, handler: PublishHandler) -> None:
        self._subscribers[topic.name].append(handler)

    def serve(self, topic: Topic, handler: RequestHandler) -> None:
        """Answer the requests of a topic. Raises ValueError where it has a handler already."""
        if topic.name in self._servers:
            raise ValueError(f"{topic.name} is served already")
        self._servers[topic.name] = topic, handler

    async def request(self, topic: Topic, payload: bytes, timeout_s: float) -> bytes:
        """Raises Unreachable, RemoteError where the other side is there but could not answer, and ServedByStranger."""
        number = next(self._ids)
        try:
            datagram = encode(Envelope(Kind.REQUEST, topic.name, number, payload))
        except MalformedEnvelope as error:
            raise RemoteError(str(error)) from error
        try:
            connection = self._send_request(topic, datagram)
        except Crowded:
            until_s = asyncio.get_running_loop().time() + timeout_s
            await self._dial_patiently(topic, min(timeout_s, PATIENCE_S))
            timeout_s = max(0.0, until_s - asyncio.get_running_loop().time())
            connection = self._send_request(topic, datagram)
        future = connection.pending[number] = asyncio.get_running_loop().create_future()
        try:
            async with asyncio.timeout(timeout_s):
                answer = await future
            ANSWERED.set(connection.peer)
            return answer
        except TimeoutError:
            raise Unreachable(no_answer(topic, timeout_s)) from None
        finally:
            del connection.pending[number]

    async def close(self) -> None:
        """Idempotent. Requests that still wait, on either side, end as unreachable."""
        loop = asyncio.get_running_loop()
        for listener in self._listeners:
            loop.remove_reader(listener.socket)
            listener.close()
        self._listeners.clear()
        if self._turns is not None:
            self._turns.close()
        if self._diallers is not None:
            self._diallers.shutdown(wait=False, cancel_futures=True)
        for task in self._answering:
            task.cancel()
        # Before anything is waited for, which may be cancelled.
        for connection in (*self._accepted, *self._dialled.values()):
            connection.close()
        await asyncio.gather(*self._answering, return_exceptions=True)

    def _heed(self, listener: Listener) -> None:
        if not listener.closed:
            asyncio.get_running_loop().add_reader(listener.socket, self._accept_some, listener)

    def _accept_some(self, listener: Listener) -> None:
        for accepted in accepted_at_once(listener.socket):
            self._accept(accepted)
            again_s = self._all_turns().accept()
            if again_s is not None:
                loop = asyncio.get_running_loop()
                loop.remove_reader(listener.socket)
                loop.call_at(again_s, self._heed, listener)
                return

    def _accept(self, accepted: socket.socket) -> None:
        if len(self._accepted) >= MAX_CONNECTIONS:
            self.counters.refused += 1
            who_makes_room(self._accepted).close()
        self._accepted.add(self._connection(accepted, self._accepted.discard))

    def _connection(self, connected: socket.socket, closed: Callable[[Connection], None]) -> Connection:
        return Connection(connected, self.counters, self._receive, closed, self._buffer, self._all_turns())

    def _all_turns(self) -> Turns:
        if self._turns is None:
            self._turns = Turns(self._most_per_window)
        return self._turns

    async def _dial_patiently(self, topic: Topic, within_s: float) -> None:
        """Until there is a place in the backlog, in a thread; where there is none in time, nothing is dialled."""
        path = self._routes[topic.name]
        if self._diallers is None:
            self._diallers = ThreadPoolExecutor(DIALLERS, "dial")
        dialling = asyncio.get_running_loop().run_in_executor(self._diallers, dial_patiently, path, within_s)
        with suppress(OSError):
            self._took(path, await dialling)

    def _dial(self, path: Path) -> Connection:
        return self._took(path, dial(path))

    def _took(self, path: Path, dialled: socket.socket) -> Connection:
        connection = self._connection(dialled, partial(self._lost, path))
        self._dialled[path] = connection
        self.counters.connects += 1
        return connection

    def _redial(self, path: Path) -> Connection | None:
        now_s = self._clock()
        if now_s < self._next_dial_s.get(path, now_s):
            return None
        self._next_dial_s[path] = now_s + RECONNECT_S
        try:
            return self._dial(path)
        except OSError as error:
            self.counters.last_error = f"{path}: {error.strerror}"
            return None
        except ServedByStranger as error:
            self.counters.last_error = str(error)
            return None

    def _lost(self, path: Path, connection: Connection) -> None:
        if self._dialled.get(path) is connection:
            del self._dialled[path]

    def _send_request(self, topic: Topic, datagram: bytes) -> Connection:
        path = self._routes.get(topic.name)
        if path is None:
            raise NotSent(f"{topic.name} is connected to no path")
        connection = self._dialled.get(path)
        if connection is not None:
            if connection.send(datagram):
                return connection
            if connection.open:
                raise NotSent(f"{topic.name}: its process has stopped reading")
            # The peer was restarted since the last message, which shows on sending: dial once more.
        try:
            connection = self._dial(path)
        except BlockingIOError:
            raise Crowded(f"{topic.name}: nobody takes connections on {path}, its process is stuck") from None
        except PermissionError:
            raise NotSent(f"{path} belongs to another user: run this as the one who started it") from None
        except OSError as error:
            raise NotSent(what_to_start(topic)) from error
        if not connection.send(datagram):
            raise NotSent(what_to_start(topic))
        return connection

    def _receive(self, connection: Connection, envelope: Envelope) -> None:
        if envelope.kind is Kind.PUBLISH:
            PEER.set(connection.peer)
            for handler in self._subscribers.get(envelope.topic, ()):
                try:
                    handler(envelope.payload)
                except Exception as error:
                    self._failed(envelope.topic, error)
        elif envelope.kind is Kind.REQUEST:
            self._take_request(connection, envelope)
        else:
            self._resolve(connection, envelope)

    def _take_request(self, connection: Connection, envelope: Envelope) -> None:
        served = self._servers.get(envelope.topic)
        if served is None:
            connection.send(_error(envelope, f"{envelope.topic} is not served here"))
            return
        topic, handler = served
        safe = safe_command(topic.name, envelope.payload)
        place, most = f"{topic.name} {safe}", most_at_once(safe)
        if connection.places[place] >= most:
            self._refuse(connection, envelope, f"more than {most} requests at once")
            return
        if not safe and self._overdue[topic.name] >= MAX_OVERDUE:
            self._refuse(connection, envelope, f"{MAX_OVERDUE} requests before it have not come to their end")
            return
        connection.places[place] += 1
        request = _Request(connection, envelope, topic, place, within_s(topic, safe))
        request.task = asyncio.get_running_loop().create_task(self._answer(request, handler))
        self._answering.add(request.task)
        request.task.add_done_callback(self._answering.discard)

    def _refuse(self, connection: Connection, envelope: Envelope, why: str) -> None:
        self.counters.refused += 1
        connection.send(_error(envelope, f"{envelope.topic}: {why}"))

    async def _answer(self, request: _Request, handler: RequestHandler) -> None:
        PEER.set(request.connection.peer)
        late = asyncio.get_running_loop().call_later(request.within_s, self._end_time, request)
        try:
            answer = await self._answer_to(request.envelope, handler)
            if not request.is_over:
                request.connection.send(answer)
        finally:
            late.cancel()
            if request.is_over:
                self._overdue[request.topic.name] -= request.topic.acts
            else:
                request.connection.places[request.place] -= 1

    def _end_time(self, request: _Request) -> None:
        """Free its place, and tell who asked. What acts comes to its end, what only reads is cut."""
        request.is_over = True
        request.connection.places[request.place] -= 1
        name, acts = request.topic.name, request.topic.acts
        then = "what was asked may be done all the same" if acts else "it is given up"
        text = f"no answer within {request.within_s:g} s; {then}"
        request.connection.send(_error(request.envelope, f"{name}: {text}"))
        self._failed(name, TimeoutError(text))
        self._overdue[name] += acts
        if not acts and request.task is not None:
            request.task.cancel()

    async def _answer_to(self, envelope: Envelope, handler: RequestHandler) -> bytes:
        try:
            payload = await handler(envelope.payload)
            return encode(Envelope(Kind.ANSWER, envelope.topic, envelope.id, payload))
        except MalformedEnvelope as error:
            return _error(envelope, str(error))
        except Exception as error:
            self._failed(envelope.topic, error)
            return _error(envelope, f"{envelope.topic} failed: {type(error).__name__}: {error}")

    def _resolve(self, connection: Connection, envelope: Envelope) -> None:
        future = connection.pending.get(envelope.id)
        if future is None or future.done():
            self.counters.late_answers += 1
        elif envelope.kind is Kind.ANSWER:
            future.set_result(envelope.payload)
        else:
            future.set_exception(RemoteError(envelope.payload.decode("utf-8", "replace")))

    def _failed(self, topic: str, error: Exception) -> None:
        self.counters.handler_errors += 1
        self.counters.last_error = f"{topic}: {type(error).__name__}: {error}"


def _error(envelope: Envelope, text: str) -> bytes:
    reason = text.encode("utf-8", "replace")[:MAX_PAYLOAD]
    return encode(Envelope(Kind.ERROR, envelope.topic, envelope.id, reason))
