"""The ways in: OPC UA and the page. Where one cannot be opened the other goes on, and it is tried again."""

import asyncio
from collections.abc import Awaitable, Callable
from pathlib import Path
from socket import socket
from ssl import SSLContext

from starlette.applications import Starlette

from gateway.operator.opcua.server import CannotServe
from gateway.operator.opcua.service import OpcUa
from gateway.operator.page.serve import CannotServe as PageCannotServe
from gateway.operator.page.serve import listening, serve_on, tls_of

AGAIN_S = 10.0  #: between two attempts


class Way:
    """`open` once, then `keep` as a task. `trouble` says why it is shut; empty: it is open."""

    def __init__(
        self,
        name: str,
        begin: Callable[[], Awaitable[None]],
        serve: Callable[[], Awaitable[object]],
        tell: Callable[[str], None],
    ) -> None:
        """`begin` takes the address, `serve` goes on until it is cancelled; both raise CannotServe of either way."""
        self.trouble = "not opened yet"
        self.name = name
        self._begin = begin
        self._serve = serve
        self._tell = tell

    async def open(self) -> bool:
        """False: it cannot be now. What has not been told before is told."""
        try:
            await self._begin()
        except (CannotServe, PageCannotServe) as error:
            self._shut(str(error))
            return False
        self.trouble = ""
        return True

    async def keep(self) -> None:
        """Until it is cancelled."""
        while True:
            if self.trouble and await self.open():
                self._tell(f"{self.name} now")
            if not self.trouble:
                try:
                    await self._serve()
                    self._shut("it has ended")
                except (CannotServe, PageCannotServe) as error:
                    self._shut(str(error))
            await asyncio.sleep(AGAIN_S)

    def _shut(self, trouble: str) -> None:
        if trouble != self.trouble:
            self._tell(f"no {self.name}, it is tried again every {AGAIN_S:g} s: {trouble}")
        self.trouble = trouble


class OpcUaWay:
    """All nodes are made at the first attempt, before anybody is served; the certificate may come later."""

    def __init__(self, opcua: OpcUa, page_trouble: Callable[[], str]) -> None:
        self._opcua = opcua
        self._opcua.page_trouble = page_trouble

    async def begin(self) -> None:
        await self._opcua.start()

    async def serve(self) -> None:
        await self._opcua.run()

    async def stop(self) -> None:
        await self._opcua.stop()


class PageWay:
    def __init__(self, page: Starlette, address: str, certificate: Path | None, key: Path | None) -> None:
        self._page = page
        self._address = address
        self._files = certificate, key
        self._tls: SSLContext | None = None
        self._listener: socket | None = None

    async def begin(self) -> None:
        self._tls = tls_of(*self._files)
        self._listener = listening(self._address)

    async def serve(self) -> None:
        assert self._listener is not None  # it has begun
        await serve_on(self._page, self._listener, self._tls)

    async def stop(self) -> None:
        """What serves it has closed it; where nothing has, here."""
        if self._listener is not None:
            self._listener.close()
