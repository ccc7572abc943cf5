"""One connected unix socket in an event loop: datagrams in within a budget, datagrams out without ever waiting."""

import asyncio
import errno
import os
import socket
import struct
from collections.abc import Callable
from pathlib import Path

from gateway.mailbox.codec import MAX_DATAGRAM, Envelope, MalformedEnvelope, decode
from gateway.mailbox.listener import new_socket
from gateway.mailbox.port import Counters, Peer, Unreachable

#: What may lie unread in the kernel for one peer. About 250 telemetry frames of six spans, and one longest message.
SEND_BUFFER = 262_144
#: Datagrams taken from one peer before everybody else in the event loop has a turn.
READ_BUDGET = 8
#: A peer that sends more than this in a window is not read until the window ends; its own sends fail meanwhile.
WINDOW_S = 0.1
MAX_PER_WINDOW = 400
_UCRED = struct.Struct("3i")  # pid, uid, gid: unix(7), SO_PEERCRED
#: The datagram is lost, the connection is not.
_DROPPED = frozenset((errno.EAGAIN, errno.ENOBUFS, errno.EMSGSIZE, errno.ENOMEM))


def dial(path: Path) -> socket.socket:
    """A socket connected to `path`. Never blocks; raises OSError (BlockingIOError where the backlog is full)."""
    connecting = new_socket()
    try:
        connecting.connect(os.fspath(path))
    except OSError:
        connecting.close()
        raise
    return connecting


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
        "_in_window",
        "_loop",
        "_receive",
        "_resume",
        "_socket",
        "_window_end_s",
        "in_flight",
        "open",
        "peer",
        "pending",
    )

    def __init__(
        self,
        connected: socket.socket,
        counters: Counters,
        receive: Callable[["Connection", Envelope], None],
        closed: Callable[["Connection"], None],
        buffer: memoryview,
    ) -> None:
        connected.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, SEND_BUFFER)
        pid, uid, _ = _UCRED.unpack(connected.getsockopt(socket.SOL_SOCKET, socket.SO_PEERCRED, _UCRED.size))
        self.peer = Peer(uid, pid)
        self.pending: dict[int, asyncio.Future[bytes]] = {}  #: requests that wait for an answer from this peer
        self.in_flight = 0  #: requests of this peer that are being answered
        self.open = True
        self._socket = connected
        self._counters = counters
        self._receive = receive
        self._closed = closed
        self._buffer = buffer
        self._in_window = 0
        self._window_end_s = 0.0
        self._resume: asyncio.TimerHandle | None = None
        self._loop = asyncio.get_running_loop()
        self._loop.add_reader(connected, self._readable)

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
        if self._resume is not None:
            self._resume.cancel()
        self._loop.remove_reader(self._socket)
        self._socket.close()
        for future in self.pending.values():
            if not future.done():
                future.set_exception(Unreachable("the other side closed the connection before it answered"))
        self._closed(self)

    def _readable(self) -> None:
        for _ in range(READ_BUDGET):
            try:
                length = self._socket.recv_into(self._buffer)
            except BlockingIOError:
                return
            except OSError:
                length = 0
            if length == 0:
                self.close()
                return
            self._take(bytes(self._buffer[:length]))
            if not self.open or self._too_many():
                return

    def _take(self, datagram: bytes) -> None:
        try:
            envelope = decode(datagram)
        except MalformedEnvelope as error:
            self._counters.malformed += 1
            self._counters.last_error = f"malformed datagram from process {self.peer.pid}: {error}"
            return
        self._receive(self, envelope)

    def _too_many(self) -> bool:
        now_s = self._loop.time()
        if now_s >= self._window_end_s:
            self._window_end_s = now_s + WINDOW_S
            self._in_window = 0
        self._in_window += 1
        if self._in_window < MAX_PER_WINDOW:
            return False
        self._loop.remove_reader(self._socket)
        self._resume = self._loop.call_at(self._window_end_s, self._loop.add_reader, self._socket, self._readable)
        return True
