"""The sockets of asyncua's server, bounded, and a way past the stack for the requests that come all the time.

What a peer sends can make the server neither large nor slow. Bytes that cannot be OPC UA close the connection they
came on, and no other.
"""

import asyncio
import time
from typing import Any, Protocol, cast

from asyncua import ua as asyncua_ua
from asyncua.common.connection import TransportLimits
from asyncua.common.utils import Buffer, ServiceError
from asyncua.server.binary_server_asyncio import BinaryServer, OPCUAProtocol
from asyncua.server.internal_server import InternalServer
from asyncua.server.uaprocessor import UaProcessor
from asyncua.ua.ua_binary import uatcp_to_binary
from asyncua.ua.uaerrors import UaStatusCodeError

MAX_CHUNK = 65_535  #: bytes
MAX_CHUNKS = 4
MAX_MESSAGE = 262_144  #: bytes

ua: Any = asyncua_ua  #: what it declares of its values and what they are differ

_READ = ua.ObjectIds.ReadRequest_Encoding_DefaultBinary
_WRITE = ua.ObjectIds.WriteRequest_Encoding_DefaultBinary
_SERVICES = frozenset(
    getattr(ua.ObjectIds, f"{name}Request_Encoding_DefaultBinary")
    for name in (
        *("FindServers", "GetEndpoints", "CreateSession", "ActivateSession", "CloseSession", "CloseSecureChannel"),
        *("Read", "Write", "Browse", "TranslateBrowsePathsToNodeIds", "RegisterNodes", "UnregisterNodes"),
        *("CreateSubscription", "ModifySubscription", "DeleteSubscriptions"),
        *("CreateMonitoredItems", "ModifyMonitoredItems", "DeleteMonitoredItems", "SetMonitoringMode"),
        *("SetPublishingMode", "Publish", "Republish"),
    )
)


class Shortcut(Protocol):
    """Whoever answers Read and Write without the stack, and counts."""

    requests: int
    malformed: int

    def answer_read(self, body: bytes, handle: int) -> bytes | None:
        """The response to a ReadRequest, given its bytes behind the header. None: the stack must."""
        ...

    def answer_write(self, body: bytes, handle: int) -> bytes | None:
        """As `answer_read`, for a WriteRequest."""
        ...


class Sockets(BinaryServer):
    """The listening socket and its connections."""

    def __init__(self, server: InternalServer, shortcut: Shortcut, host: str, port: int) -> None:
        super().__init__(server, host, port, TransportLimits(MAX_CHUNK, MAX_CHUNK, MAX_CHUNKS, MAX_MESSAGE))
        self._shortcut = shortcut

    async def listen(self) -> int:
        """Returns the port. Raises OSError."""
        await self.start()
        return cast(asyncio.Server, self._server).sockets[0].getsockname()[1]

    async def stop(self) -> None:
        cast(asyncio.Server, self._server).close()
        for client in self.clients:
            cast(asyncio.Transport, client.transport).abort()
        while self.clients:  # noqa: ASYNC110 (asyncua has no event for it)
            await asyncio.sleep(0)  # they are told of their end in the next turn of the loop
        await super().stop()

    def _make_protocol(self) -> OPCUAProtocol:
        connection = _Connection(self.iserver, self._policies, self.clients, self.closing_tasks, self.limits)
        connection.shortcut = self._shortcut
        return connection


class _Connection(OPCUAProtocol):
    """One client. Refuses a message that says it is too large before it has come."""

    shortcut: Shortcut

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        super().connection_made(transport)
        if self.transport is not None:  # otherwise there are too many already
            self.processor = _Processor(self.iserver, self.shortcut, self.transport, self.limits)
            self.processor.set_policies(self.policies)

    def data_received(self, data: bytes) -> None:
        transport = self.transport
        if transport is None or transport.is_closing():
            return
        super().data_received(data)
        announced = int.from_bytes(self._buffer[4:8], "little")  # of the message whose end has not come yet
        if transport.is_closing():
            self._refuse()
        elif announced > MAX_CHUNK:
            told = ua.ErrorMessage(ua.StatusCode(ua.StatusCodes.BadTcpMessageTooLarge))
            transport.write(uatcp_to_binary(ua.MessageType.Error, told))
            self._refuse()

    def pause_writing(self) -> None:
        # A client that asks without reading its answers is not heard until it has read them.
        if self.transport is not None:
            self.transport.pause_reading()

    def resume_writing(self) -> None:
        if self.transport is not None:
            self.transport.resume_reading()

    async def _process_one_msg(self, header: Any, buf: Buffer) -> bool:
        try:
            alive = await super()._process_one_msg(header, buf)
        except Exception:
            self._refuse()  # a broken chunk or header: nothing that follows can be understood
            raise
        if not alive and header.MessageType != ua.MessageType.SecureClose:
            self._refuse()
        return alive

    def _refuse(self) -> None:
        self.shortcut.malformed += 1
        if self.transport is not None:
            self.transport.abort()


class _Processor(UaProcessor):
    """Offers a closed list of services, and lets the shortcut answer what it can."""

    def __init__(
        self, server: InternalServer, shortcut: Shortcut, transport: asyncio.Transport, limits: TransportLimits
    ) -> None:
        super().__init__(server, transport, limits)
        self._shortcut = shortcut

    async def _process_message(self, typeid: Any, requesthdr: Any, seqhdr: Any, body: Buffer) -> bool:
        self._shortcut.requests += 1
        service = typeid.Identifier
        if typeid.NamespaceIndex or service not in _SERVICES or not self._connection.is_open():
            raise ServiceError(ua.StatusCodes.BadServiceUnsupported)
        if service in (_READ, _WRITE) and self._answered(service, requesthdr, seqhdr, body):
            return True
        if service == ua.ObjectIds.CreateSessionRequest_Encoding_DefaultBinary:
            await self._end_session()
        try:
            return await super()._process_message(typeid, requesthdr, seqhdr, body)
        except (ServiceError, UaStatusCodeError):
            raise
        except Exception as error:
            self._shortcut.malformed += 1
            raise ServiceError(ua.StatusCodes.BadDecodingError) from error

    def _answered(self, service: int, requesthdr: Any, seqhdr: Any, body: Buffer) -> bool:
        session = self.session
        if session is None or not session.is_activated():
            return False
        answer = self._shortcut.answer_read if service == _READ else self._shortcut.answer_write
        response = answer(body.copy().read(len(body)), requesthdr.RequestHandle)
        if response is None:
            return False
        session.touch()
        self.session_last_activity = time.monotonic()
        self._transport.write(self._connection.message_to_binary(response, request_id=seqhdr.RequestId))
        return True

    def _should_close_session_on_transport_loss(self) -> bool:
        """Always: the sessions of clients that died would keep others out until they time out."""
        return self.session is not None

    async def _end_session(self) -> None:
        """A connection has one session: the stack would forget an earlier one without closing it."""
        if self._session_watchdog_task is not None:
            self._session_watchdog_task.cancel()
        if self.session is not None:
            await self.session.close_session(True)
