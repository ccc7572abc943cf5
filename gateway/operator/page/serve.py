"""The page on its address: plain on loopback, TLS elsewhere. It shares the event loop of the operator's process."""

import asyncio
import contextlib
import socket
import ssl
from collections.abc import Iterator
from pathlib import Path
from urllib.parse import SplitResult, urlsplit

import uvicorn
from starlette.applications import Starlette
from uvicorn.protocols.http.h11_impl import H11Protocol

from gateway.operator.page.asks import SAFE
from gateway.tasks.cleanup import finish

MOST_CONNECTIONS = 100
IDLE_S = 10.0  #: of a connection without a whole request
UNHEARD_MS = 15_000  #: that a browser takes nothing of what is sent: it is gone, and frees its place
CLOSING_S = 1  #: for answers that are on their way


class CannotServe(Exception):
    """The address cannot be listened on, or its certificate cannot be read; the text says why."""


class _Connection(H11Protocol):
    """Is closed when it brings no whole request: whoever opens many and says nothing takes no place from others."""

    @property
    def limit_concurrency(self) -> int | None:  # pyright: ignore[reportIncompatibleVariableOverride]
        """uvicorn asks once a request is read; what stops or holds the line has places of its own (`asks`)."""
        return None if self.scope["path"] in SAFE else self.config.limit_concurrency

    @limit_concurrency.setter
    def limit_concurrency(self, _: int | None) -> None:
        """As uvicorn sets it, from the same settings."""

    def connection_made(self, transport: asyncio.Transport) -> None:  # pyright: ignore[reportIncompatibleMethodOverride]
        super().connection_made(transport)
        ours: socket.socket = transport.get_extra_info("socket")
        ours.setsockopt(socket.IPPROTO_TCP, socket.TCP_USER_TIMEOUT, UNHEARD_MS)
        self.loop.call_later(IDLE_S, self._look, self.cycle)

    def _look(self, before: object) -> None:
        """`before`: the request that was the newest when it was looked at last."""
        if self.transport.is_closing():
            return
        if self.cycle is before and (self.cycle is None or self.cycle.response_complete):
            self.transport.close()
        else:
            self.loop.call_later(IDLE_S, self._look, self.cycle)


class _Server(uvicorn.Server):
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
        limit_concurrency=MOST_CONNECTIONS,
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
