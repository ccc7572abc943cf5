"""The services of one connection: a closed list, on an encrypted channel, for a client that has proved who it is.

Without encryption only the endpoints are told: that is how clients find out what to encrypt with.
"""

import asyncio
import sys
from collections.abc import Callable
from functools import partial
from typing import Any

from asyncua import ua as asyncua_ua
from asyncua.common.connection import TransportLimits
from asyncua.common.utils import Buffer, ServiceError
from asyncua.crypto.permission_rules import User, UserRole
from asyncua.server.internal_server import InternalServer
from asyncua.server.uaprocessor import UaProcessor
from asyncua.server.user_managers import UserManager
from asyncua.ua.ua_binary import struct_from_binary
from asyncua.ua.uaerrors import UaStatusCodeError
from cryptography import x509

from gateway.operator.opcua.limits import MAX_CALLS, MAX_HISTORY_READS, MAX_URGENT, at_most
from gateway.operator.opcua.line_nodes import ROOT
from gateway.operator.opcua.login import Logins
from gateway.operator.opcua.session import Session
from gateway.operator.opcua.trust import application_uri, fingerprint
from gateway.operator.places import place_of

ua: Any = asyncua_ua  #: what it declares of its values and what they are differ


def _numbers(*names: str) -> frozenset[int]:
    return frozenset(getattr(ua.ObjectIds, f"{name}Request_Encoding_DefaultBinary") for name in names)


_OPEN = _numbers("FindServers", "GetEndpoints", "CloseSecureChannel")  #: to everybody
_SERVICES = _OPEN | _numbers(
    "CreateSession", "ActivateSession", "CloseSession", "Read", "Write", "Browse", "TranslateBrowsePathsToNodeIds",
    "RegisterNodes", "UnregisterNodes", "Call", "HistoryRead", "CreateSubscription", "ModifySubscription",
    "DeleteSubscriptions", "CreateMonitoredItems", "ModifyMonitoredItems", "DeleteMonitoredItems",
    "SetMonitoringMode", "SetPublishingMode", "Publish", "Republish",
)  # fmt: skip
(_CREATE,), (_ACTIVATE,), (_CALL,) = _numbers("CreateSession"), _numbers("ActivateSession"), _numbers("Call")
(_HISTORY,) = _numbers("HistoryRead")
URGENT = tuple(f"{ROOT}.{name}" for name in ("Stop", "Hold"))  #: what nothing else may keep waiting
_ANYBODY = User(role=UserRole.User)  #: what asyncua is told of whoever has logged in; roles are ours


class OnlyProven(UserManager):
    """asyncua's own lets everybody in, and who says to be `admin` as that. Here `Processor` has asked before."""

    proven = False  #: set for the one turn of the event loop in which a session is activated

    def get_user(
        self,
        iserver: InternalServer,
        username: str | None = None,
        password: str | None = None,
        certificate: Any = None,
    ) -> User | None:
        return _ANYBODY if self.proven else None


class Processor(UaProcessor):
    def __init__(
        self,
        server: InternalServer,
        logins: Logins,
        proving: OnlyProven,
        has_its_share: Callable[[str], bool],
        is_trusted: Callable[[bytes], bool],
        transport: asyncio.Transport,
        limits: TransportLimits,
    ) -> None:
        """`has_its_share`: of the sessions, by `place_of` the client; `is_trusted`: a certificate, as it is now."""
        super().__init__(server, transport, limits)
        self._logins = logins
        self._proving = proving
        self._has_its_share = has_its_share
        self._is_trusted = is_trusted
        self._calls: set[asyncio.Task[None]] = set()  #: without those that are urgent
        self._urgent: dict[str, set[asyncio.Task[None]]] = {name: set() for name in URGENT}
        self._histories: set[asyncio.Task[None]] = set()

    async def _process_message(self, typeid: Any, requesthdr: Any, seqhdr: Any, body: Buffer) -> bool:
        service = typeid.Identifier
        if typeid.NamespaceIndex or service not in _SERVICES or not self._connection.is_open():
            raise ServiceError(ua.StatusCodes.BadServiceUnsupported)
        if service not in _OPEN and not self.is_encrypted():
            raise ServiceError(ua.StatusCodes.BadSecurityModeRejected)
        if service not in _OPEN and service != _CREATE:
            self._check_token(requesthdr)
        if service == _CALL:
            urgent = _urgent(body)
            running = self._urgent[urgent] if urgent else self._calls
            at_most(len(running) + 1, MAX_URGENT if urgent else MAX_CALLS)
            self._begin(running, typeid, requesthdr, seqhdr, body)
            return True
        if service == _HISTORY:
            at_most(len(self._histories) + 1, MAX_HISTORY_READS)
            self._begin(self._histories, typeid, requesthdr, seqhdr, body)
            return True
        return await self._answer(typeid, requesthdr, seqhdr, body)

    async def _answer(self, typeid: Any, requesthdr: Any, seqhdr: Any, body: Buffer) -> bool:
        """Raises ServiceError and UaStatusCodeError, whatever happens."""
        try:
            if typeid.Identifier == _CREATE:
                await self._before_session(struct_from_binary(ua.CreateSessionParameters, body.copy()))
            if typeid.Identifier == _ACTIVATE:
                return await self._activate(typeid, requesthdr, seqhdr, body)
            return await super()._process_message(typeid, requesthdr, seqhdr, body)
        except (ServiceError, UaStatusCodeError):
            raise
        except Exception as error:
            raise ServiceError(ua.StatusCodes.BadDecodingError) from error

    def _begin(self, running: set[asyncio.Task[None]], typeid: Any, requesthdr: Any, seqhdr: Any, body: Buffer) -> None:
        """Beside the rest: it may take its time, and the client's subscriptions shall not wait for it."""
        task = asyncio.get_running_loop().create_task(self._beside(typeid, requesthdr, seqhdr, body))
        running.add(task)
        task.add_done_callback(running.discard)

    async def _beside(self, typeid: Any, requesthdr: Any, seqhdr: Any, body: Buffer) -> None:
        try:
            await self._answer(typeid, requesthdr, seqhdr, body)
        except (ServiceError, UaStatusCodeError) as error:
            response = ua.ServiceFault()
            response.ResponseHeader.ServiceResult = ua.StatusCode(error.code)
            self.send_response(requesthdr.RequestHandle, seqhdr, response)
        except Exception as error:  # a fault of this program: the client is answered all the same
            print(f"OPC UA: a request failed: {type(error).__name__}: {error}", file=sys.stderr, flush=True)
            response = ua.ServiceFault()
            response.ResponseHeader.ServiceResult = ua.StatusCode(ua.StatusCodes.BadInternalError)
            self.send_response(requesthdr.RequestHandle, seqhdr, response)

    def send_response(
        self, requesthandle: Any, seqhdr: Any, response: Any, msgtype: Any = ua.MessageType.SecureMessage
    ):
        if not self._transport.is_closing():
            super().send_response(requesthandle, seqhdr, response, msgtype)

    async def _before_session(self, params: Any) -> None:
        """The certificate is the channel's, and the client calls itself as its certificate does."""
        own = self._certificate()
        if params.ClientCertificate is not None and not params.ClientCertificate.startswith(own):
            raise ServiceError(ua.StatusCodes.BadCertificateInvalid)
        if params.ClientDescription.ApplicationUri != application_uri(x509.load_der_x509_certificate(own)):
            raise ServiceError(ua.StatusCodes.BadCertificateUriInvalid)
        await self._end_session()
        self.session = None
        if self._has_its_share(place_of(address_of(self._transport))):
            raise ServiceError(ua.StatusCodes.BadTooManySessions)

    async def _activate(self, typeid: Any, requesthdr: Any, seqhdr: Any, body: Buffer) -> bool:
        """First the person is asked for proof, then asyncua, which checks the client's signature."""
        session = self._session()
        params = struct_from_binary(ua.ActivateSessionParameters, body.copy())
        certificate = fingerprint(self._certificate())
        address = address_of(self._transport)
        person = await self._logins.person(self.iserver, session, params.UserIdentityToken, certificate, address)
        before = session.person
        alive = await self._with_proof(typeid, requesthdr, seqhdr, body)
        session.logged_in = partial(self._logins.now, person)
        if before is None or before.name != person.name:
            self._logins.came_in(person, address)
        return alive

    async def _with_proof(self, typeid: Any, requesthdr: Any, seqhdr: Any, body: Buffer) -> bool:
        self._proving.proven = True  # nothing is waited for until it is taken back: asyncua activates in one go
        try:
            return await super()._process_message(typeid, requesthdr, seqhdr, body)
        finally:
            self._proving.proven = False

    def is_logged_in(self) -> bool:
        return isinstance(self.session, Session) and self.session.is_activated()

    def is_nobodys(self) -> bool:
        """Whoever has logged in is no user any more, or from a client that is trusted no more."""
        if not isinstance(self.session, Session) or not self.session.is_activated():
            return False
        return self.session.person is None or not self._is_trusted(self._certificate())

    def _session(self) -> Session:
        """Raises ServiceError. A session lives and dies with its connection: nobody else can take it up."""
        if not isinstance(self.session, Session):
            raise ServiceError(ua.StatusCodes.BadSessionIdInvalid)
        return self.session

    def _check_token(self, requesthdr: Any) -> None:
        """asyncua takes whatever token comes for that of the connection's session."""
        if requesthdr.AuthenticationToken != self._session().auth_token:
            raise ServiceError(ua.StatusCodes.BadSessionIdInvalid)

    def is_encrypted(self) -> bool:
        return self._connection.security_policy.Mode == ua.MessageSecurityMode.SignAndEncrypt

    def _certificate(self) -> bytes:
        """Of the client, whose key has signed the channel."""
        return self._connection.security_policy.peer_certificate or b""

    def _should_close_session_on_transport_loss(self) -> bool:
        """Always: the sessions of clients that died would keep others out until they time out."""
        return self.session is not None

    async def _end_session(self) -> None:
        """A connection has one session: the stack would forget an earlier one without closing it."""
        if self._session_watchdog_task is not None:
            self._session_watchdog_task.cancel()
        if self.session is not None:
            await self.session.close_session(True)


def address_of(transport: asyncio.BaseTransport) -> str:
    """Of the other side in the network; empty where it is gone already."""
    name: Any = transport.get_extra_info("peername")
    return str(name[0]) if name else ""


def _urgent(body: Buffer) -> str:
    """The method of a request that does nothing but stop or hold the line; empty: another. Raises ServiceError."""
    try:
        calls = struct_from_binary(ua.CallParameters, body.copy()).MethodsToCall or ()
    except Exception as error:  # whatever asyncua makes of bytes that are no request
        raise ServiceError(ua.StatusCodes.BadDecodingError) from error
    called = {call.MethodId.Identifier for call in calls}
    return next((name for name in URGENT if name in called), "") if called <= set(URGENT) else ""
