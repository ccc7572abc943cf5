"""A TCP proxy that knows frames: it stands in front of a device and lets the faults of a wire act on what passes.

Without faults it is transparent, also for bytes that are no frames. It needs nothing of the simulated line: put it in
front of any Modbus TCP or OPC UA server.

    faults = WireFaults(MbapFrames())
    proxy = TcpProxy(faults, MODBUS_TCP, "127.0.0.1", 502)
    port = await proxy.open("127.0.0.1", 0)
    number = faults.begin(parse_fault("modbus-tcp mute"), None)
"""

import asyncio
from collections.abc import Callable
from dataclasses import dataclass
from math import inf
from typing import cast

from sim_plant.faults import mbap_frames, opcua_frames
from sim_plant.faults.frames import Direction
from sim_plant.faults.framing import DelayLine, Framer
from sim_plant.faults.wire_faults import WireFaults

MAX_CONNECTIONS = 64


@dataclass(frozen=True, slots=True)
class Framing:
    """How the frames of a protocol are found in a stream, and whose they are."""

    header: int  #: bytes that tell the size
    size_of: Callable[[bytes], int]
    address_of: Callable[[bytes], int]


MODBUS_TCP = Framing(mbap_frames.HEADER, mbap_frames.size_of, mbap_frames.unit_of)
OPC_UA = Framing(opcua_frames.HEADER, opcua_frames.size_of, lambda _: 0)


class TcpProxy:
    """Every connection to it becomes one to `host` and `port`; one that cannot be made is closed at once.

    It takes `faults.on_disconnect`. The delays of faults are shortened by `time_scale`.
    """

    def __init__(
        self, faults: WireFaults[bytes], framing: Framing, host: str, port: int, time_scale: float = 1.0
    ) -> None:
        self.faults = faults
        self.time_scale = time_scale
        self.framing = framing
        self._host = host
        self._port = port
        self._server: asyncio.Server | None = None
        self._links: set[_Link] = set()
        self._dialling: set[asyncio.Task[None]] = set()
        faults.on_disconnect = self._break_off

    async def open(self, host: str, port: int) -> int:
        """Listen; port 0 takes a free one. Returns the port. Raises OSError when it is taken."""
        loop = asyncio.get_running_loop()
        self._server = await loop.create_server(self._accept, host, port)
        return self._server.sockets[0].getsockname()[1]

    async def close(self) -> None:
        """Stop listening and drop every connection. Idempotent."""
        if self._server is None:
            return
        server, self._server = self._server, None
        server.close()
        for task in self._dialling:
            task.cancel()
        await asyncio.gather(*self._dialling, return_exceptions=True)
        ends = [end.lost for link in self._links for end in link.ends]
        self._break_off()
        if ends:
            await asyncio.wait(ends)
        await server.wait_closed()

    def _accept(self) -> "_End":
        link = _Link(self)
        self._links.add(link)
        return link.client

    def _break_off(self) -> None:
        for link in list(self._links):
            link.abort()

    def dial(self, link: "_Link") -> None:
        """Connect a client that has come to the device."""
        if self.faults.disconnected or self._server is None or len(self._links) > MAX_CONNECTIONS:
            link.abort()
            return
        task = asyncio.get_running_loop().create_task(self._connect(link))
        self._dialling.add(task)
        task.add_done_callback(self._dialling.discard)

    def forget(self, link: "_Link") -> None:
        self._links.discard(link)

    async def _connect(self, link: "_Link") -> None:
        try:
            await asyncio.get_running_loop().create_connection(lambda: link.device, self._host, self._port)
        except OSError:
            link.abort()


class _Link:
    """A client's connection and the one to the device for it."""

    def __init__(self, proxy: TcpProxy) -> None:
        self.proxy = proxy
        self.client = _End(self, Direction.TO_DEVICE)
        self.device = _End(self, Direction.FROM_DEVICE)
        self.ends: list[_End] = []  #: those that were ever connected
        self.client.other, self.device.other = self.device, self.client

    def connected(self, end: "_End") -> None:
        self.ends.append(end)
        if end is self.client:
            end.pause()  # until there is somebody to tell
            self.proxy.dial(self)
        elif self.client.transport is None:
            end.abort()
        else:
            self.client.resume()

    def abort(self) -> None:
        self.client.abort()
        self.device.abort()

    def closed(self) -> None:
        if self.client.transport is None and self.device.transport is None:
            self.proxy.forget(self)


class _End(asyncio.Protocol):
    """One connection. What comes in goes through the faults to the other end's `write`."""

    other: "_End"

    def __init__(self, link: _Link, direction: Direction) -> None:
        self.transport: asyncio.Transport | None = None
        self._link = link
        self._direction = direction  #: of what comes in here
        framing = link.proxy.framing
        self._framer = Framer(framing.header, framing.size_of)
        self._late: DelayLine[bytes] = DelayLine()  #: what came in here and is on its way
        self._timer: asyncio.TimerHandle | None = None
        self._ended = False  #: nothing more comes in
        self.drained = False  #: and all that came has been passed on
        self.lost: asyncio.Future[None] = asyncio.get_running_loop().create_future()

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        self.transport = cast(asyncio.Transport, transport)
        self._link.connected(self)

    def data_received(self, data: bytes) -> None:
        if not self._framer.framed:
            self._send(data)
            return
        proxy = self._link.proxy
        address_of = proxy.framing.address_of
        now_s = asyncio.get_running_loop().time()
        for frame in self._framer.feed(data):
            for delay_s, after in proxy.faults.pass_(self._direction, address_of(frame), frame):
                self._late.put(now_s + delay_s / proxy.time_scale, after)
        if not self._framer.framed:
            self._late.put(now_s, self._framer.rest())
        self._send_due()

    def eof_received(self) -> bool:
        self._ended = True
        if rest := self._framer.rest():
            self._late.put(asyncio.get_running_loop().time(), rest)
        self._send_due()
        return True  # the other direction goes on

    def pause_writing(self) -> None:
        # A peer that does not read is felt by the one who writes to it, as without a proxy.
        self.other.pause()

    def resume_writing(self) -> None:
        self.other.resume()

    def connection_lost(self, exc: Exception | None) -> None:
        self.transport = None
        if self._timer is not None:
            self._timer.cancel()
        self.lost.set_result(None)
        if exc is None:
            self.other.end()
        else:
            self.other.abort()
        self._link.closed()

    def pause(self) -> None:
        if self.transport is not None and not self.transport.is_closing():
            self.transport.pause_reading()

    def resume(self) -> None:
        if self.transport is not None and not self.transport.is_closing():
            self.transport.resume_reading()

    def end(self) -> None:
        """Close once everything is written."""
        if self.transport is not None:
            self.transport.close()

    def abort(self) -> None:
        if self.transport is not None:
            self.transport.abort()

    def _send(self, data: bytes) -> None:
        out = self.other.transport
        if out is not None and not out.is_closing():
            out.write(data)

    def _send_due(self) -> None:
        loop = asyncio.get_running_loop()
        for frame in self._late.take(loop.time()):
            self._send(frame)
        if self._timer is not None:
            self._timer.cancel()
            self._timer = None
        if self._late.due_s < inf:
            self._timer = loop.call_at(self._late.due_s, self._send_due)
        elif self._ended:
            self._pass_end_on()

    def _pass_end_on(self) -> None:
        """Nothing more will come from here: the other side is told, as a half-closed connection."""
        self.drained = True
        out = self.other.transport
        if out is not None and not out.is_closing():
            out.write_eof()
        if self.other.drained:
            self.end()
            self.other.end()
