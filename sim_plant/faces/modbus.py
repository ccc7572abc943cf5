"""The Modbus TCP face: one listening socket, several units behind it, every request answered in its order."""

import asyncio
import logging
from collections.abc import Callable, Mapping
from typing import cast

from sim_plant.faces.modbus_codec import (
    TARGET_SILENT,
    Frame,
    NotModbus,
    Registers,
    answer,
    encode_frame,
    exception_answer,
    take_frames,
)

MAX_CONNECTIONS = 32

log = logging.getLogger(__name__)


class ModbusFace:
    """Serves `units` (unit identifier to registers). `clock` gives the time that the units live in, seconds.

    A request to a unit that is not there is answered with exception 11. Bytes that cannot be Modbus TCP close
    the connection they came on, and no other.
    """

    def __init__(self, units: Mapping[int, Registers], clock: Callable[[], float]) -> None:
        self.units = dict(units)
        self.clock = clock
        self.requests = 0
        self.malformed = 0  #: connections closed because of what came in on them
        self.refused = 0  #: connections closed because there were MAX_CONNECTIONS already
        self.connections: set[_Connection] = set()
        self._server: asyncio.Server | None = None

    async def open(self, host: str, port: int) -> int:
        """Listen on `host`; port 0 takes a free one. Returns the port. Raises OSError when it is taken."""
        loop = asyncio.get_running_loop()
        self._server = await loop.create_server(lambda: _Connection(self), host, port)
        return self._server.sockets[0].getsockname()[1]

    async def close(self) -> None:
        """Stop listening and drop every connection. Idempotent."""
        if self._server is None:
            return
        server, self._server = self._server, None
        server.close()
        for connection in self.connections:
            connection.abort()
        await asyncio.gather(*(connection.lost for connection in self.connections))
        await server.wait_closed()

    def answer(self, frame: Frame) -> bytes:
        """The bytes that answer one request."""
        self.requests += 1
        registers = self.units.get(frame.unit)
        if registers is None:
            pdu = exception_answer(frame.pdu[0], TARGET_SILENT)
        else:
            pdu = answer(frame.pdu, registers, self.clock())
        return encode_frame(Frame(frame.transaction, frame.unit, pdu))


class _Connection(asyncio.Protocol):
    """One client. Holds the beginning of a request until the rest comes."""

    def __init__(self, face: ModbusFace) -> None:
        self._face = face
        self._buffer = bytearray()
        self._transport: asyncio.Transport | None = None
        self.lost: asyncio.Future[None] = asyncio.get_running_loop().create_future()

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        self._transport = cast(asyncio.Transport, transport)
        if len(self._face.connections) >= MAX_CONNECTIONS:
            self._face.refused += 1
            self.abort()
        else:
            self._face.connections.add(self)

    def data_received(self, data: bytes) -> None:
        transport = self._transport
        if transport is None or transport.is_closing():
            return
        self._buffer += data
        try:
            frames = take_frames(self._buffer)
        except NotModbus as error:
            self._face.malformed += 1
            log.warning("Modbus: closing %s: %s", transport.get_extra_info("peername"), error)
            self.abort()
            return
        for frame in frames:
            transport.write(self._face.answer(frame))

    def pause_writing(self) -> None:
        # A client that asks without reading its answers is not heard until it has read them.
        if self._transport is not None:
            self._transport.pause_reading()

    def resume_writing(self) -> None:
        if self._transport is not None:
            self._transport.resume_reading()

    def connection_lost(self, exc: Exception | None) -> None:
        self._face.connections.discard(self)
        self._transport = None
        self.lost.set_result(None)

    def abort(self) -> None:
        if self._transport is not None:
            self._transport.abort()
