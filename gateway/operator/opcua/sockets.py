"""The sockets of asyncua's server, bounded. Bytes that cannot be OPC UA close the connection they came on, and no
other.
"""

import asyncio
import socket
from collections.abc import Callable
from typing import Any, cast

from asyncua import ua as asyncua_ua
from asyncua.common.connection import TransportLimits
from asyncua.common.utils import Buffer, ServiceError
from asyncua.server.binary_server_asyncio import BinaryServer, OPCUAProtocol
from asyncua.server.internal_server import InternalServer
from asyncua.ua.ua_binary import uatcp_to_binary
from asyncua.ua.uaerrors import UaStatusCodeError

from gateway.operator.opcua import limits
from gateway.operator.opcua.limits import LEAST_CHUNK, MAX_CHUNK, MAX_CHUNKS, MAX_MESSAGE
from gateway.operator.opcua.processor import Processor, address_of
from gateway.operator.places import make_room, place_of

ua: Any = asyncua_ua  #: what it declares of its values and what they are differ

MakeProcessor = Callable[[asyncio.Transport, TransportLimits], Processor]


class Sockets(BinaryServer):
    """The listening socket and its connections."""

    def __init__(self, server: InternalServer, make: MakeProcessor, host: str, port: int) -> None:
        super().__init__(server, host, port, TransportLimits(MAX_CHUNK, MAX_CHUNK, MAX_CHUNKS, MAX_MESSAGE))
        self._make = make

    async def stop(self) -> None:
        if self._server is None:
            return
        cast(asyncio.Server, self._server).close()
        for client in self.clients:
            cast(asyncio.Transport, client.transport).abort()
        while self.clients:  # noqa: ASYNC110 (asyncua has no event for it)
            await asyncio.sleep(0)  # they are told of their end in the next turn of the loop
        await super().stop()

    def end_strangers(self) -> None:
        """Connections of those who are no users any more, those that have had no session for too long, and those that
        never finish closing, as their other side takes nothing of what was still to be sent: they would take places.
        """
        now_s = asyncio.get_running_loop().time()
        for one in self.clients:
            if isinstance(one, _Connection) and not one.is_open():
                one.end()
        for one in self._open():
            if one.services.is_logged_in():
                one.without_s = now_s
            if one.services.is_nobodys() or now_s - one.without_s > limits.LOGIN_S:
                one.end()

    def sessions_from(self, place: str) -> int:
        """Of connections that are open, also such as nobody has logged in to yet."""
        return sum(one.place == place and one.services.session is not None for one in self._open())

    def make_room(self, place: str) -> bool:
        """For a connection from there, which has no session yet. False: there is none."""
        waiting = [one for one in self._open() if not one.services.is_logged_in()]
        return make_room(place, waiting, limits.MORE_CONNECTIONS)

    def _open(self) -> list["_Connection"]:
        """In the order in which they came."""
        return [one for one in self.clients if isinstance(one, _Connection) and one.is_open()]

    def _make_protocol(self) -> OPCUAProtocol:
        connection = _Connection(self.iserver, self._policies, self.clients, self.closing_tasks, self.limits)
        connection.make, connection.make_room = self._make, self.make_room
        return connection


class _Connection(OPCUAProtocol):
    """One client. Refuses a message that says it is too large before it has come."""

    make: MakeProcessor
    make_room: Callable[[str], bool]
    services: Processor  #: of an open one
    place = ""  #: as `place_of`
    without_s = 0.0  #: since when it has had no session, as it was seen last

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        place = place_of(address_of(transport))
        if not self.make_room(place):
            cast(asyncio.Transport, transport).abort()
            return
        ours: socket.socket = transport.get_extra_info("socket")
        ours.setsockopt(socket.IPPROTO_TCP, socket.TCP_USER_TIMEOUT, limits.UNHEARD_MS)
        super().connection_made(transport)
        if self.transport is not None:  # otherwise there are too many already
            self.place, self.without_s = place, asyncio.get_running_loop().time()
            self.processor = self.services = self.make(self.transport, self.limits)
            self.services.set_policies(self.policies)

    def is_open(self) -> bool:
        return self.transport is not None and not self.transport.is_closing()

    def is_proven(self) -> bool:
        """Somebody has shown a trusted certificate."""
        return self.services.is_encrypted()

    def end(self) -> None:
        """At once, also where the other side reads nothing."""
        if self.transport is not None:
            self.transport.abort()

    def data_received(self, data: bytes) -> None:
        transport = self.transport
        if transport is None or transport.is_closing():
            return
        super().data_received(data)
        if len(self._buffer) >= 8 and int.from_bytes(self._buffer[4:8], "little") > MAX_CHUNK:
            self._refuse(ua.StatusCodes.BadTcpMessageTooLarge)  # announced; its end has not come yet

    def pause_writing(self) -> None:
        # A client that asks without reading its answers is not heard until it has read them.
        if self.transport is not None:
            self.transport.pause_reading()

    def resume_writing(self) -> None:
        if self.transport is not None:
            self.transport.resume_reading()

    async def _process_one_msg(self, header: Any, buf: Buffer) -> bool:
        await asyncio.sleep(0)  # the others' turn: a client may send many at once, and each takes its time
        if header.MessageType == ua.MessageType.Hello and _least_buffer(buf.copy()) < LEAST_CHUNK:
            self._refuse(ua.StatusCodes.BadTcpNotEnoughResources)
            return False
        try:
            return await super()._process_one_msg(header, buf)
        except (ServiceError, UaStatusCodeError) as error:
            self._refuse(error.code)
        except Exception:  # a broken chunk or header: nothing that follows can be understood
            self._refuse(ua.StatusCodes.BadSecurityChecksFailed)
        return False

    def _refuse(self, code: int) -> None:
        """Say why, and end it."""
        if self.transport is not None and not self.transport.is_closing():
            self.transport.write(uatcp_to_binary(ua.MessageType.Error, ua.ErrorMessage(ua.StatusCode(code))))
            self.transport.close()


def _least_buffer(hello: Buffer) -> int:
    """Bytes; 0 where it is cut off. Answers in pieces of a few bytes would keep the server busy for a second each."""
    said = hello.read(min(12, len(hello)))  # the protocol's version, then what the client receives and sends at most
    return min(int.from_bytes(said[4:8], "little"), int.from_bytes(said[8:12], "little"))
