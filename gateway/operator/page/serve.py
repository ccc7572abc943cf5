"""The page on its address: plain on loopback, TLS elsewhere. It shares the event loop of the operator's process.

Connections are counted from the moment they are accepted, before any handshake, by where they come from: whoever opens
many without a session, and whatever they say or leave unsaid, takes neither places nor descriptors from others.
"""

import asyncio
import contextlib
import socket
import ssl
from collections.abc import Iterator
from pathlib import Path
from typing import Any
from urllib.parse import SplitResult, urlsplit

import uvicorn
from starlette.applications import Starlette
from uvicorn.protocols.http.h11_impl import H11Protocol

from gateway.operator.places import make_room, place_of
from gateway.tasks.cleanup import finish

MOST_CONNECTIONS = 100
IDLE_S = 10.0  #: of a connection without a whole request
HANDSHAKE_S = 5.0  #: for the whole of it
WAITING = 1024  #: connections, in the kernel, to be accepted
ACCEPT_AGAIN_S = 0.1  #: where there is nothing to accept with, as while there are no descriptors
UNHEARD_MS = 15_000  #: that a browser takes nothing of what is sent: it is gone, and frees its place
CLOSING_S = 1  #: for answers that are on their way


class CannotServe(Exception):
    """The address cannot be listened on, or its certificate cannot be read; the text says why."""


class _Connection(H11Protocol):
    """HTTP. Is closed when it brings no whole request."""

    guest: "_Guest"

    def connection_made(self, transport: asyncio.Transport) -> None:  # pyright: ignore[reportIncompatibleMethodOverride]
        super().connection_made(transport)
        self.guest.transport = transport
        self.loop.call_later(IDLE_S, self._look, self.cycle)

    def connection_lost(self, exc: Exception | None) -> None:
        super().connection_lost(exc)
        self.guest.leave()

    def _look(self, before: object) -> None:
        """`before`: the request that was the newest when it was looked at last."""
        if self.transport.is_closing():
            return
        if self.cycle is before and (self.cycle is None or self.cycle.response_complete):
            self.transport.close()
        else:
            self.loop.call_later(IDLE_S, self._look, self.cycle)


class _Guest:
    """A connection from its acceptance to its end, whether it has come through its handshake or not."""

    def __init__(self, server: "_Server", ours: socket.socket, place: str) -> None:
        self.place = place
        self.transport: asyncio.Transport | None = None  #: once HTTP is spoken over it
        self._server = server
        self._ours = ours
        self._has_session = False
        self._begins = asyncio.get_running_loop().create_task(self._begin())

    def is_proven(self) -> bool:
        return self._has_session

    def end(self) -> None:
        """At once, whatever its other side does not say or take."""
        self.leave()
        if self.transport is not None:
            self.transport.abort()
        else:
            with contextlib.suppress(OSError):
                self._ours.shutdown(socket.SHUT_RDWR)  # the handshake fails by it

    def leave(self) -> None:
        self._server.guests.pop(self, None)

    async def _begin(self) -> None:
        tls: dict[str, Any] = {}
        if self._server.config.ssl is not None:
            tls = {"ssl": self._server.config.ssl, "ssl_handshake_timeout": HANDSHAKE_S,
                   "ssl_shutdown_timeout": CLOSING_S}  # fmt: skip
        try:
            await asyncio.get_running_loop().connect_accepted_socket(self._speak, self._ours, **tls)
        except OSError:
            pass  # it is gone, or there was no handshake, or none in time: asyncio has closed it
        finally:
            if self.transport is None:
                self.leave()

    def _speak(self) -> _Connection:
        connection = _Connection(self._server.config, self._server.server_state, {"proven": self._proven})
        connection.guest = self
        return connection

    def _proven(self) -> None:
        self._has_session = True


class _Server(uvicorn.Server):
    """Accepts by itself."""

    def __init__(self, config: uvicorn.Config) -> None:
        super().__init__(config)
        self.guests: dict[_Guest, None] = {}  #: as they came
        self._accepting: asyncio.Task[None] | None = None

    async def startup(self, sockets: list[socket.socket] | None = None) -> None:
        self.servers, self.started = [], True
        assert sockets is not None  # `serve_on` gives one
        (listener,) = sockets
        listener.listen(WAITING)
        listener.setblocking(False)
        self._accepting = asyncio.get_running_loop().create_task(self._accept(listener))

    async def shutdown(self, sockets: list[socket.socket] | None = None) -> None:
        assert self._accepting is not None  # it has started
        self._accepting.cancel()
        await asyncio.wait([self._accepting])  # before its socket is closed
        for guest in list(self.guests):
            if guest.transport is None:
                guest.end()
        await super().shutdown(sockets)
        if not self._accepting.cancelled():
            self._accepting.result()  # why it ended by itself: raised

    async def _accept(self, listener: socket.socket) -> None:
        while True:
            try:
                ours, address = await asyncio.get_running_loop().sock_accept(listener)
                ours.setsockopt(socket.IPPROTO_TCP, socket.TCP_USER_TIMEOUT, UNHEARD_MS)
            except OSError:
                await asyncio.sleep(ACCEPT_AGAIN_S)
                continue
            place = place_of(address[0])
            if make_room(place, list(self.guests), MOST_CONNECTIONS):
                self.guests[_Guest(self, ours, place)] = None
            else:
                ours.close()
            await asyncio.sleep(0)  # the others' turn, also while they come without end

    async def on_tick(self, counter: int) -> bool:
        """Whether to end, which it does as well where nothing is accepted any more."""
        return await super().on_tick(counter) or self._accepting is None or self._accepting.done()

    @contextlib.contextmanager
    def capture_signals(self) -> Iterator[None]:
        """Signals belong to the process, which is more than a page."""
        yield


async def serve_page(app: Starlette, address: str, certificate: Path | None = None, key: Path | None = None) -> None:
    """Until it is cancelled. `address` as in the line's file; with https `certificate` and `key` are PEM files.

    Raises CannotServe.
    """
    tls = tls_of(certificate, key)
    await serve_on(app, listening(address), tls)


def tls_of(certificate: Path | None, key: Path | None) -> ssl.SSLContext | None:
    """As PEM files have it; None without any. Raises CannotServe."""
    if certificate is None:
        return None
    found = ssl.create_default_context(ssl.Purpose.CLIENT_AUTH)
    try:
        found.load_cert_chain(certificate, key)
    except OSError as error:  # ssl.SSLError is one
        raise CannotServe(f"the page's certificate {certificate} and key {key} cannot be used: {error}") from error
    return found


def listening(address: str) -> socket.socket:
    """Raises CannotServe."""
    parts = urlsplit(address)
    host, port = parts.hostname or "", port_of(parts)
    try:
        family = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM)[0][0]
        return socket.create_server((host, port), family=family, backlog=64)
    except OSError as error:
        raise CannotServe(f"the page cannot be at {address}: {error}") from error


def port_of(address: SplitResult) -> int:
    """Where none is said, the one of the scheme."""
    return (443 if address.scheme == "https" else 80) if address.port is None else address.port


async def _ended(serving: asyncio.Future[None]) -> None:
    await serving


async def serve_on(app: Starlette, listener: socket.socket, tls: ssl.SSLContext | None = None) -> None:
    """Until it is cancelled. `app` is one of `page_app`."""
    config = uvicorn.Config(
        app,
        lifespan="off",
        ws="none",
        loop="none",
        http=_Connection,
        log_config=None,
        access_log=False,
        server_header=False,
        proxy_headers=False,
        timeout_keep_alive=5,
        timeout_graceful_shutdown=CLOSING_S,
        h11_max_incomplete_event_size=16_384,
    )
    config.load()
    config.ssl = tls  # read before the address is taken: what cannot be served is not told as served
    server = _Server(config)
    serving = asyncio.ensure_future(server.serve(sockets=[listener]))
    try:
        await asyncio.shield(serving)
    except asyncio.CancelledError:
        app.state.end()
        server.should_exit = True
        await finish(_ended(serving))  # a second cancellation would leave browsers connected
        raise
    finally:
        listener.close()
