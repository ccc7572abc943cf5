"""The sockets of asyncua's server, bounded, and a way past the stack for the requests that come all the time.

What a peer sends can make the server neither large nor slow. Bytes that cannot be OPC UA close the connection they
came on, and no other.
"""

import asyncio
import struct
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

from sim_plant.faces.opcua_codec import parse_header

MAX_CHUNK = 65_535  #: bytes
MAX_CHUNKS = 4
MAX_MESSAGE = 262_144  #: bytes

ua: Any = asyncua_ua  #: what it declares of its values and what they are differ

_READ = ua.ObjectIds.ReadRequest_Encoding_DefaultBinary
_WRITE = ua.ObjectIds.WriteRequest_Encoding_DefaultBinary
#: Of a whole message without security: kind, size, channel, token, sequence number, request id, type of the service.
_MESSAGE = struct.Struct("<4s5IBBH")
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
    _busy = False  #: the stack is at a message

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        super().connection_made(transport)
        if self.transport is not None:  # otherwise there are too many already
            self.processor = _Processor(self.iserver, self.shortcut, self.transport, self.limits)
            self.processor.set_policies(self.policies)

    def data_received(self, data: bytes) -> None:
        transport = self.transport
        if transport is None or transport.is_closing():
            return
        if isinstance(self.processor, _Processor) and not (self._buffer or self._busy or self.messages.qsize()):
            try:
                data = self.processor.answer_at_once(data)
            except Exception:  # the line has failed: the event loop has been told, and will end it
                self._refuse()
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
        self._busy = True
        try:
            alive = await super()._process_one_msg(header, buf)
        except Exception:
            self._refuse()  # a broken chunk or header: nothing that follows can be understood
            raise
        finally:
            self._busy = False
        if not alive and header.MessageType != ua.MessageType.SecureClose:
            self._refuse()
        return alive

    def _refuse(self) -> None:
        self.shortcut.malformed += 1
        if self.transport is not None:
            self.transport.abort()


class _Processor(UaProcessor):
    """Lets the shortcut answer what it can, and offers a closed list of services for the rest."""

    def __init__(
        self, server: InternalServer, shortcut: Shortcut, transport: asyncio.Transport, limits: TransportLimits
    ) -> None:
        super().__init__(server, transport, limits)
        self._shortcut = shortcut

    def answer_at_once(self, data: bytes) -> bytes:
        """Answer what the shortcut can of the messages that begin `data`; the rest is for the stack."""
        answers: list[bytes] = []
        at = 0
        while end := self._answer(data, at, answers):
            at = end
        if answers:
            self._transport.write(b"".join(answers))
        return data[at:]

    def _answer(self, data: bytes, at: int, answers: list[bytes]) -> int:
        """Where the message at `at` ends, if it has been answered; otherwise 0, and nothing has happened."""
        session = self.session
        if len(data) - at < _MESSAGE.size or session is None or not session.is_activated():
            return 0
        kind, size, channel, token, sequence, request, encoding, namespace, service = _MESSAGE.unpack_from(data, at)
        if (kind, encoding, namespace) != (b"MSGF", 1, 0) or service not in (_READ, _WRITE):
            return 0
        if not self._is_next(channel, token, sequence):
            return 0
        end = at + size
        header = parse_header(data, at + _MESSAGE.size) if size <= MAX_CHUNK and end <= len(data) else None
        if header is None or header.end > end:
            return 0
        answer = self._shortcut.answer_read if service == _READ else self._shortcut.answer_write
        response = answer(data[header.end : end], header.handle)
        if response is None:
            return 0
        self._connection._peer_sequence_number = sequence  # noqa: SLF001
        self._shortcut.requests += 1
        session.touch()
        self.session_last_activity = time.monotonic()
        answers.append(self._connection.message_to_binary(response, request_id=request))
        return end

    def _is_next(self, channel: int, token: int, sequence: int) -> bool:
        """Whether a message is the next one on this channel. What is not, is for the stack to judge."""
        ours = self._connection
        known, last = ours.security_token, ours._peer_sequence_number  # noqa: SLF001
        in_order = last is not None and sequence == last + 1 and not ours._incoming_parts  # noqa: SLF001
        return in_order and (channel, token) == (known.ChannelId, known.TokenId)

    async def _process_message(self, typeid: Any, requesthdr: Any, seqhdr: Any, body: Buffer) -> bool:
        self._shortcut.requests += 1
        service = typeid.Identifier
        if typeid.NamespaceIndex or service not in _SERVICES or not self._connection.is_open():
            raise ServiceError(ua.StatusCodes.BadServiceUnsupported)
        if service == ua.ObjectIds.CreateSessionRequest_Encoding_DefaultBinary:
            await self._end_session()
        try:
            return await super()._process_message(typeid, requesthdr, seqhdr, body)
        except (ServiceError, UaStatusCodeError):
            raise
        except Exception as error:
            self._shortcut.malformed += 1
            raise ServiceError(ua.StatusCodes.BadDecodingError) from error

    def _should_close_session_on_transport_loss(self) -> bool:
        """Always: the sessions of clients that died would keep others out until they time out."""
        return self.session is not None

    async def _end_session(self) -> None:
        """A connection has one session: the stack would forget an earlier one without closing it."""
        if self._session_watchdog_task is not None:
            self._session_watchdog_task.cancel()
        if self.session is not None:
            await self.session.close_session(True)
