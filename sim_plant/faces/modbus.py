"""The Modbus TCP face: one listening socket, several units behind it, every request answered in its order."""

import asyncio
import logging
from collections.abc import Callable, Mapping
from typing import cast

from sim_plant.faces.kernel_stamp import ArrivalStamps, Stamp
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
from sim_plant.faults.frames import Direction
from sim_plant.faults.wire_faults import WireFaults

MAX_CONNECTIONS = 32
_BUFFER_BYTES = 4096  #: read at a time

log = logging.getLogger(__name__)


class ModbusFace:
    """Serves `units` (unit identifier to registers). `clock` gives the time that the units live in, seconds.

    `arrival` turns a stamp of the kernel into the time, on that same clock, at which a request came in; without it
    that is when the request is read. A request to a unit that is not there is answered with exception 11. Bytes that
    cannot be Modbus TCP close the connection they came on, and no other.
    """

    def __init__(
        self,
        units: Mapping[int, Registers],
        clock: Callable[[], float],
        arrival: Callable[[Stamp], float] | None = None,
        faults: WireFaults[bytes] | None = None,
        time_scale: float = 1.0,
    ) -> None:
        self.units = dict(units)
        self.clock = clock
        self.arrival = arrival
        self.faults = faults
        self.time_scale = time_scale
        if faults is not None:
            faults.on_disconnect = self.break_off
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
        if lost := [connection.lost for connection in self.connections]:
            await asyncio.wait(lost)
        await server.wait_closed()

    def break_off(self) -> None:
        """Drop every connection."""
        for connection in list(self.connections):
            connection.abort()

    def answer(self, frame: Frame, now_s: float) -> bytes:
        """The bytes that answer one request, which came at `now_s`."""
        self.requests += 1
        registers = self.units.get(frame.unit)
        if registers is None:
            pdu = exception_answer(frame.pdu[0], TARGET_SILENT)
        else:
            pdu = answer(frame.pdu, registers, now_s)
        return encode_frame(Frame(frame.transaction, frame.unit, pdu))


class _Connection(asyncio.BufferedProtocol):
    """One client. Holds the beginning of a request until the rest comes."""

    def __init__(self, face: ModbusFace) -> None:
        self._face = face
        self._incoming = bytearray(_BUFFER_BYTES)
        self._buffer = bytearray()
        self._transport: asyncio.Transport | None = None
        self._stamps: ArrivalStamps | None = None
        self._stamp: Stamp | None = None
        self.lost: asyncio.Future[None] = asyncio.get_running_loop().create_future()

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        self._transport = cast(asyncio.Transport, transport)
        if self._face.faults is not None and self._face.faults.disconnected:
            self.abort()
        elif len(self._face.connections) >= MAX_CONNECTIONS:
            self._face.refused += 1
            self.abort()
        else:
            self._face.connections.add(self)
            if self._face.arrival is not None:
                self._stamps = ArrivalStamps(transport.get_extra_info("socket"))

    def get_buffer(self, sizehint: int) -> bytearray:
        # Called when there is something to read: now its stamp can still be seen.
        self._stamp = None if self._stamps is None else self._stamps.next()
        return self._incoming

    def buffer_updated(self, nbytes: int) -> None:
        transport = self._transport
        if transport is None or transport.is_closing():
            return
        self._buffer += memoryview(self._incoming)[:nbytes]
        try:
            frames = take_frames(self._buffer)
        except NotModbus as error:
            self._face.malformed += 1
            log.warning("Modbus: closing %s: %s", transport.get_extra_info("peername"), error)
            self.abort()
            return
        if frames:
            now_s = self._arrived_s()
            for frame in frames:
                self._take(frame, now_s)

    def _take(self, frame: Frame, now_s: float) -> None:
        faults = self._face.faults
        if faults is None:
            self._write(self._face.answer(frame, now_s), 0.0)
            return

        def act(request: bytes, delay_s: float) -> None:
            try:
                (taken,) = take_frames(bytearray(request)) or (None,)
            except NotModbus:
                self.abort()
                return
            if taken is not None:
                answer = self._face.answer(taken, now_s + delay_s)
                faults.carry(Direction.FROM_DEVICE, frame.unit, answer, self._write, self._later)

        faults.carry(Direction.TO_DEVICE, frame.unit, encode_frame(frame), act, self._later, now_s)

    def _write(self, answer: bytes, delay_s: float) -> None:
        if self._transport is not None and not self._transport.is_closing():
            self._transport.write(answer)

    def _later(self, delay_s: float, call: Callable[[], object]) -> None:
        asyncio.get_running_loop().call_later(delay_s / self._face.time_scale, call)

    def _arrived_s(self) -> float:
        face = self._face
        return face.clock() if face.arrival is None or self._stamp is None else face.arrival(self._stamp)

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
        if self._stamps is not None:
            self._stamps.close()
        self.lost.set_result(None)

    def abort(self) -> None:
        if self._transport is not None:
            self._transport.abort()
