"""One connected unix socket in an event loop: datagrams in within a budget, datagrams out without ever waiting."""

import asyncio
import errno
import socket
from collections import Counter
from collections.abc import Callable

from gateway.mailbox.codec import MAX_DATAGRAM, Envelope, MalformedEnvelope, decode
from gateway.mailbox.port import Counters, Unreachable
from gateway.mailbox.turns import Turns
from gateway.mailbox.who_serves import peer_of

#: What may lie unread in the kernel for one peer. About 250 telemetry frames of six spans, and one longest message.
SEND_BUFFER = 262_144
#: Datagrams taken from one peer before everybody else in the event loop has a turn.
READ_BUDGET = 8
_LOOK = socket.MSG_PEEK | socket.MSG_TRUNC  #: how long the next datagram is, of which nothing is taken
#: The datagram is lost, the connection is not.
_DROPPED = frozenset((errno.EAGAIN, errno.ENOBUFS, errno.EMSGSIZE, errno.ENOMEM))


def receive_buffer() -> memoryview:
    """Room for one datagram of any connection in this thread. One octet more tells one that is too long."""
    return memoryview(bytearray(MAX_DATAGRAM + 1))


class Connection:
    """Owns a connected, non-blocking socket until `close`. `receive` gets every well-formed envelope.

    `buffer`: see `receive_buffer`; what is received is copied out of it at once, so that all may share one.
    """

    __slots__ = (
        "_buffer",
        "_closed",
        "_counters",
        "_loop",
        "_receive",
        "_socket",
        "_turns",
        "heard_s",
        "open",
        "peer",
        "pending",
        "places",
    )

    def __init__(
        self,
        connected: socket.socket,
        counters: Counters,
        receive: Callable[["Connection", Envelope], None],
        closed: Callable[["Connection"], None],
        buffer: memoryview,
        turns: Turns,
    ) -> None:
        connected.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, SEND_BUFFER)
        self.peer = peer_of(connected)
        self.pending: dict[int, asyncio.Future[bytes]] = {}  #: requests that wait for an answer from this peer
        self.places: Counter[str] = Counter()  #: that requests of this peer have, by topic and command
        self.open = True
        self._socket = connected
        self._counters = counters
        self._receive = receive
        self._closed = closed
        self._buffer = buffer
        self._turns = turns
        turns.come(self.pid)
        self._loop = asyncio.get_running_loop()
        self.heard_s = self._loop.time()
        self._loop.add_reader(connected, self._readable)

    @property
    def in_flight(self) -> int:
        """Requests of this peer that are being answered."""
        return self.places.total()

    @property
    def pid(self) -> int:
        """Of the process at the other end."""
        return self.peer.pid

    def send(self, datagram: bytes) -> bool:
        """Hand `datagram` to the kernel. False, and counted, when there is no room or nobody there."""
        if self.open:
            try:
                self._socket.send(datagram, socket.MSG_NOSIGNAL)
                return True
            except OSError as error:
                if error.errno not in _DROPPED:
                    self.close()
        self._counters.dropped += 1
        return False

    def close(self) -> None:
        """Idempotent. Whoever waits for an answer gets Unreachable."""
        if not self.open:
            return
        self.open = False
        self._turns.go(self.pid)
        self._loop.remove_reader(self._socket)
        self._socket.close()
        for future in self.pending.values():
            if not future.done():
                future.set_exception(Unreachable("the other side closed the connection before it answered"))
        self._closed(self)

    def _readable(self) -> None:
        for _ in range(READ_BUDGET):
            try:
                length = self._socket.recv_into(self._buffer, 1, _LOOK)
                if length and not self._turns.is_on(self.pid, length):
                    self._loop.remove_reader(self._socket)
                    self._turns.wait(self.pid, length, self._go_on)
                    return
                length = self._socket.recv_into(self._buffer)
            except BlockingIOError:
                return
            except OSError:
                length = 0
            if length == 0:
                self.close()
                return
            self._turns.took(self.pid, length)
            self.heard_s = self._loop.time()
            self._take(bytes(self._buffer[:length]))
            if not self.open:
                return

    def _go_on(self) -> None:
        if self.open:
            self._loop.add_reader(self._socket, self._readable)
            self._readable()

    def _take(self, datagram: bytes) -> None:
        try:
            envelope = decode(datagram)
        except MalformedEnvelope as error:
            self._counters.malformed += 1
            self._counters.last_error = f"malformed datagram from process {self.peer.pid}: {error}"
            return
        self._receive(self, envelope)
