"""asyncua's server with its bounds drawn tight: two security policies, both signed and encrypted, trusted clients,
people with names, no discovery of others, nothing that can be written.
"""

import asyncio
from collections.abc import Callable
from pathlib import Path
from typing import Any

from asyncua import ua as asyncua_ua
from asyncua.common.connection import TransportLimits
from asyncua.common.utils import ServiceError
from asyncua.crypto.permission_rules import User, UserRole
from asyncua.crypto.security_policies import SecurityPolicyFactory
from asyncua.server.internal_server import InternalServer
from asyncua.server.internal_session import InternalSession
from asyncua.server.server import Server
from cryptography import x509
from cryptography.hazmat.primitives.serialization import load_pem_private_key

from gateway.files import MOST_BYTES, read_bytes
from gateway.operator.opcua import limits
from gateway.operator.opcua.decoder import bound_decoder
from gateway.operator.opcua.login import Logins
from gateway.operator.opcua.processor import OnlyProven, Processor
from gateway.operator.opcua.session import Session
from gateway.operator.opcua.sockets import Sockets
from gateway.operator.opcua.trust import CERTIFICATE, PRIVATE_KEY, NotUsable, TrustList, application_uri, first_of
from gateway.operator.places import share_of

PRODUCT = "urn:r2rgate"

ua: Any = asyncua_ua  #: what it declares of its values and what they are differ

POLICIES = [
    ua.SecurityPolicyType.Basic256Sha256_SignAndEncrypt,
    ua.SecurityPolicyType.Aes256Sha256RsaPss_SignAndEncrypt,
]
_NOBODY = User(role=UserRole.Anonymous)


class CannotServe(Exception):
    """The text says why, and what to do."""


class _Trusted(SecurityPolicyFactory):
    """A security policy for clients whose certificate is trusted, before anything they say is looked at."""

    def __init__(self, of: SecurityPolicyFactory, why_not: Callable[[bytes], str]) -> None:
        super().__init__(of.cls, of.mode, of.certificate, of.private_key)
        self._why_not = why_not

    def create(self, peer_certificate: bytes | None) -> Any:
        try:
            own = first_of(peer_certificate or b"")
        except NotUsable:
            own = b""
        if not own or self._why_not(own):
            raise ServiceError(ua.StatusCodes.BadSecurityChecksFailed)
        return super().create(own)


class Stack(InternalServer):
    """What stands behind the sockets."""

    def __init__(self, sessions_max: int, proving: OnlyProven, anonymous: bool) -> None:
        super().__init__(user_manager=proving)
        self.sessions_max = sessions_max
        self.allow_remote_admin = False
        self.supported_tokens = (ua.UserNameIdentityToken, *((ua.AnonymousIdentityToken,) if anonymous else ()))
        self.subscription_service = limits.Subscriptions(self.aspace, self)
        self.isession.subscription_service = self.subscription_service
        self.view_service = limits.Views(self.aspace)
        self.max_connections = sessions_max + limits.MORE_CONNECTIONS + limits.BEING_ENDED
        self.max_subscriptions = sessions_max * limits.SUBSCRIPTIONS_EACH
        self.min_session_timeout_ms, self.max_session_timeout_ms = map(float, limits.SESSION_TIMEOUT_MS)
        self.max_pending_activation_seconds = 0.0  # `Sockets.end_strangers` ends them, whatever they leave unread
        self.max_pending_messages_per_connection = limits.PENDING_MESSAGES
        self.max_unacked_messages_per_subscription = limits.MAX_UNACKNOWLEDGED
        self.max_monitored_item_queue_size = limits.MAX_QUEUE

    def create_session(self, name: str, user: User = _NOBODY, external: bool = False) -> InternalSession:
        if external and len(self._external_sessions) >= self.sessions_max:
            raise ServiceError(ua.StatusCodes.BadTooManySessions)
        return Session(self, self.aspace, self.subscription_service, name, user, external)


class OperatorServer(Server):
    """`init`, make nodes, `start`, `stop`."""

    def __init__(self, stack: Stack, logins: Logins, proving: OnlyProven, trust: TrustList, pki: Path) -> None:
        bound_decoder()
        super().__init__(iserver=stack)
        self._sessions_max = stack.sessions_max
        self._trust = trust
        self._logins = logins
        self._proving = proving
        self.application_type = ua.ApplicationType.Server
        self.name, self.manufacturer_name, self.product_uri = "r2rgate operator", "r2rgate", PRODUCT
        self._pki = pki
        self.set_security_policy(POLICIES)

    async def init(self, shelf_file: Path | None = None) -> None:
        await super().init(shelf_file)
        for name, limit in limits.OPERATION_LIMITS.items():
            number = getattr(ua.ObjectIds, f"Server_ServerCapabilities_OperationLimits_{name}")
            await self.get_node(ua.NodeId(number)).write_value(ua.Variant(limit, ua.VariantType.UInt32))

    async def start(self) -> None:
        """Reads the certificate, and listens. Raises CannotServe, and may be called again then.

        `stop` is needed all the same.
        """
        host, port = self.endpoint.hostname or "", self.endpoint.port or 0
        if self.bserver is None:
            await self.set_application_uri(_load(self.iserver, self._pki))
            await self._setup_server_nodes()
            policies = [_Trusted(policy, self._trust.why_not) for policy in self._policies]
            await self.iserver.start()
            self.bserver = Sockets(self.iserver, self._processor, host, port)
            self.bserver.set_policies(policies)
        try:
            await self.bserver.start()
        except OSError as error:
            raise CannotServe(
                f"the OPC UA server cannot listen on {host}:{port}: {error.strerror}; the line's file says where, as "
                "opc_ua of [operator]"
            ) from error

    @property
    def port(self) -> int:
        """On which it listens."""
        return 0 if self.bserver is None else self.bserver.port

    def end_strangers(self) -> None:
        """To be called now and then: who was removed from the users is put out, and who does not log in."""
        if isinstance(self.bserver, Sockets):
            self.bserver.end_strangers()

    async def stop(self) -> None:
        if self.iserver.time_task is not None:
            self.iserver.time_task.cancel()  # asyncua would wait for its next second
            self.iserver.time_task = None
        await super().stop()

    def _processor(self, transport: asyncio.Transport, bounds: TransportLimits) -> Processor:
        return Processor(
            self.iserver, self._logins, self._proving, self._has_its_share, self._trust.holds, transport, bounds
        )

    def _has_its_share(self, place: str) -> bool:
        """No more sessions are for clients of this place."""
        return isinstance(self.bserver, Sockets) and self.bserver.sessions_from(place) >= share_of(self._sessions_max)


def _load(stack: InternalServer, pki: Path) -> str:
    """The server's own certificate and key. Returns its ApplicationUri; raises CannotServe."""
    way_out = "`r2rgate pki init --line LINE.toml` makes what is missing"
    try:
        stack.certificate = x509.load_pem_x509_certificate(read_bytes(pki / CERTIFICATE, MOST_BYTES))
        stack.private_key = load_pem_private_key(read_bytes(pki / PRIVATE_KEY, MOST_BYTES), password=None)
        if stack.private_key.public_key() != stack.certificate.public_key():
            raise CannotServe(f"{pki / PRIVATE_KEY} is not the key of {pki / CERTIFICATE}: move both away; {way_out}")
        return application_uri(stack.certificate)
    except FileNotFoundError as error:
        raise CannotServe(f"there is no {error.filename}: {way_out}") from error
    except OSError as error:
        raise CannotServe(f"{error.filename} cannot be read: {error.strerror}") from error
    except (NotUsable, ValueError, TypeError) as error:
        raise CannotServe(f"the OPC UA server's certificate in {pki} cannot be used: {error}; {way_out}") from error


def make_server(
    url: str, sessions_max: int, logins: Logins, anonymous: bool, trust: TrustList, pki: Path
) -> OperatorServer:
    proving = OnlyProven()
    server = OperatorServer(Stack(sessions_max, proving, anonymous), logins, proving, trust, pki)
    server.set_endpoint(url)
    return server
