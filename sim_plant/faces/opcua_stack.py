"""asyncua's server with its bounds drawn tight: one endpoint without security, anonymous sessions, no methods, no
history, no registration, subscriptions of bounded speed and size.
"""

import functools
import gc
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from datetime import UTC, datetime
from math import isfinite
from pathlib import Path
from typing import Any, cast

from asyncua import ua as asyncua_ua
from asyncua.common.utils import ServiceError
from asyncua.crypto.permission_rules import User, UserRole
from asyncua.crypto.security_policies import SecurityPolicyFactory, SecurityPolicyNone
from asyncua.server.address_space import AddressSpace, AttributeValue, NodeData, NodeManagementService, ViewService
from asyncua.server.internal_server import InternalServer
from asyncua.server.internal_session import InternalSession
from asyncua.server.subscription_service import SubscriptionService
from asyncua.server.user_managers import UserManager

from sim_plant.faces.opcua_codec import MAX_NODES
from sim_plant.faces.opcua_decoder import bound_decoder
from sim_plant.faces.opcua_sockets import Shortcut, Sockets

MAX_CONNECTIONS = 32
MAX_SUBSCRIPTIONS = 32
MAX_MONITORED = 1000  #: items of one subscription
MAX_BROWSE = 100  #: nodes of one request
SESSION_TIMEOUT_MS = 10_000
PUBLISHING_MS = (50.0, 60_000.0)  #: shortest and longest interval of a subscription

ua: Any = asyncua_ua  #: what it declares of its values and what they are differ

_NOBODY = User(role=UserRole.Anonymous)
_OPERATION_LIMITS = {
    "MaxNodesPerRead": MAX_NODES,
    "MaxNodesPerWrite": MAX_NODES,
    "MaxNodesPerBrowse": MAX_BROWSE,
    "MaxNodesPerTranslateBrowsePathsToNodeIds": MAX_BROWSE,
    "MaxMonitoredItemsPerCall": MAX_MONITORED,
}
_PRODUCT = "urn:r2rgate:sim"
_TRANSPORT = "http://opcfoundation.org/UA-Profile/Transport/uatcp-uasc-uabinary"
_PENDING_MESSAGES = 64


@contextmanager
def _uncollected() -> Iterator[None]:
    """While hundreds of thousands of objects are made that stay: looking through them costs more than making them."""
    collecting = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        if collecting:
            gc.enable()


@functools.cache
def _standard_nodes() -> AddressSpace:
    """The nodes of the OPC UA standard: a second of work, so they are made once and copied for each server."""
    from asyncua.server.standard_address_space import standard_address_space  # noqa: PLC0415

    nodes = AddressSpace()
    with _uncollected():
        standard_address_space.fill_address_space(NodeManagementService(nodes))
    return nodes


def prepare() -> None:
    """Do what the first server of a process would have to wait for, about a second."""
    bound_decoder()
    _standard_nodes()


class _Anonymous(UserManager):
    def get_user(
        self,
        iserver: InternalServer,
        username: str | None = None,
        password: str | None = None,
        certificate: Any = None,
    ) -> User | None:
        return User(role=UserRole.User)


class _Subscriptions(SubscriptionService):
    """Subscriptions of bounded speed and number of items."""

    def __init__(self, aspace: AddressSpace, iserver: InternalServer) -> None:
        super().__init__(aspace, iserver)
        self._items: dict[int, int] = {}

    async def create_subscription(
        self,
        params: Any,
        callback: Callable[..., Any],
        session_id: Any,
        request_callback: Callable[..., Any] | None = None,
    ) -> Any:
        shortest, longest = PUBLISHING_MS
        wanted = float(params.RequestedPublishingInterval)
        params.RequestedPublishingInterval = min(max(wanted, shortest), longest) if isfinite(wanted) else longest
        result = await super().create_subscription(params, callback, session_id, request_callback)
        self._items = {key: count for key, count in self._items.items() if key in self.subscriptions}
        return result

    async def create_monitored_items(self, params: Any) -> list[Any]:
        before = self._items.get(params.SubscriptionId, 0)
        if before + len(params.ItemsToCreate) > MAX_MONITORED:
            raise ServiceError(ua.StatusCodes.BadTooManyMonitoredItems)
        results = await super().create_monitored_items(params)
        self._items[params.SubscriptionId] = before + sum(result.StatusCode.is_good() for result in results)
        return results

    def delete_monitored_items(self, params: Any) -> list[Any]:
        results = super().delete_monitored_items(params)
        if params.SubscriptionId in self._items:
            self._items[params.SubscriptionId] -= sum(result.is_good() for result in results)
        return results


class _Views(ViewService):
    """Browsing of a bounded number of nodes in one request: each may have hundreds of references."""

    def browse(self, params: Any) -> list[Any]:
        _check_browse(len(params.NodesToBrowse))
        return super().browse(params)

    def translate_browsepaths_to_nodeids(self, browsepaths: list[Any]) -> list[Any]:
        _check_browse(len(browsepaths))
        return super().translate_browsepaths_to_nodeids(browsepaths)


def _check_browse(count: int) -> None:
    if count > MAX_BROWSE:
        raise ServiceError(ua.StatusCodes.BadTooManyOperations)


class Stack(InternalServer):
    """The server behind the sockets. `namespace` is the URI of the devices' namespace, `shortcut` answers for them."""

    def __init__(self, namespace: str, shortcut: Shortcut) -> None:
        super().__init__(user_manager=cast(Any, _Anonymous()))
        self.shortcut = shortcut
        self.namespace = namespace
        self.supported_tokens = (ua.AnonymousIdentityToken,)
        self.subscription_service = _Subscriptions(self.aspace, self)
        self.isession.subscription_service = self.subscription_service
        self.view_service = _Views(self.aspace)
        self.max_connections = MAX_CONNECTIONS
        self.max_subscriptions = MAX_SUBSCRIPTIONS
        self.max_session_timeout_ms = SESSION_TIMEOUT_MS
        self.max_pending_activation_seconds = 5.0
        self.max_pending_messages_per_connection = _PENDING_MESSAGES
        self.max_unacked_messages_per_subscription = 100
        self.max_monitored_item_queue_size = 100
        self.disabled_clock = True  # the time is told when it is asked for
        self._sockets: Sockets | None = None

    async def open(self, host: str, port: int) -> int:
        """Listen, after `init`. Returns the port; 0 takes a free one. Raises OSError; `close` is not needed then."""
        await self.start()
        _set(self.aspace, ua.ObjectIds.Server_ServerArray, [_PRODUCT], ua.VariantType.String)
        _set(self.aspace, ua.ObjectIds.Server_NamespaceArray, self._namespaces(), ua.VariantType.String)
        _set(self.aspace, ua.ObjectIds.Server_ServiceLevel, 255, ua.VariantType.Byte)
        for name, limit in _OPERATION_LIMITS.items():
            number = getattr(ua.ObjectIds, f"Server_ServerCapabilities_OperationLimits_{name}")
            _set(self.aspace, number, limit, ua.VariantType.UInt32)
        _tell_time(self.aspace)
        self._sockets = Sockets(self, self.shortcut, host, port)
        policy = SecurityPolicyFactory(SecurityPolicyNone, ua.MessageSecurityMode.None_)
        self._sockets.set_policies([policy])
        try:
            port = await self._sockets.listen()
        except OSError:
            self._sockets = None
            await self.stop()
            raise
        self.add_endpoint(_endpoint(f"opc.tcp://{f'[{host}]' if ':' in host else host}:{port}/"))
        return port

    async def close(self) -> None:
        """Drop every connection and session."""
        if self._sockets is not None:
            sockets, self._sockets = self._sockets, None
            await sockets.stop()
        for session in list(self._external_sessions.values()):
            await session.close_session(True)
        await self.stop()

    def _namespaces(self) -> list[str]:
        return ["http://opcfoundation.org/UA/", _PRODUCT, self.namespace]

    async def load_standard_address_space(self, shelf_file: Path | None = None) -> None:
        nodes = _standard_nodes()
        with _uncollected():
            for node_id in nodes.keys():  # noqa: SIM118 (an address space has keys, but cannot be iterated)
                self.aspace[node_id] = _copy(nodes[node_id])

    def create_session(self, name: str, user: User = _NOBODY, external: bool = False) -> InternalSession:
        if external and len(self._external_sessions) >= MAX_CONNECTIONS:
            raise ServiceError(ua.StatusCodes.BadTooManySessions)
        return super().create_session(name, user, external)


def _copy(node: NodeData) -> NodeData:
    """A node with its own attributes and references; their values are replaced, never changed."""
    copied = NodeData(node.nodeid)
    copied.attributes = {key: AttributeValue(cast(Any, held.value)) for key, held in node.attributes.items()}
    copied.references = list(node.references)
    return copied


def _set(nodes: AddressSpace, number: int, value: Any, kind: Any) -> None:
    held = nodes[ua.NodeId(number)].attributes[ua.AttributeIds.Value]
    held.value = ua.DataValue(ua.Variant(value, kind), SourceTimestamp=datetime.now(UTC))


def _tell_time(nodes: AddressSpace) -> None:
    """Let the server's clock be read when somebody asks."""
    started = datetime.now(UTC)

    def current_time(*_: Any) -> Any:
        now = datetime.now(UTC)
        return ua.DataValue(ua.Variant(now, ua.VariantType.DateTime), SourceTimestamp=now)

    def status(*_: Any) -> Any:
        now = datetime.now(UTC)
        told = ua.ServerStatusDataType(StartTime=started, CurrentTime=now, State=ua.ServerState.Running)
        told.BuildInfo.ProductUri = _PRODUCT
        return ua.DataValue(ua.Variant(told, ua.VariantType.ExtensionObject), SourceTimestamp=now)

    value = ua.AttributeIds.Value
    nodes.set_attribute_value_callback(ua.NodeId(ua.ObjectIds.Server_ServerStatus_CurrentTime), value, current_time)
    nodes.set_attribute_value_callback(ua.NodeId(ua.ObjectIds.Server_ServerStatus), value, status)


def _endpoint(url: str) -> Any:
    server = ua.ApplicationDescription(
        ApplicationUri=_PRODUCT,
        ProductUri=_PRODUCT,
        ApplicationName=ua.LocalizedText("simulated roll-to-roll line"),
        ApplicationType=ua.ApplicationType.Server,
        DiscoveryUrls=[url],
    )
    anonymous = ua.UserTokenPolicy(PolicyId="anonymous", TokenType=ua.UserTokenType.Anonymous)
    return ua.EndpointDescription(
        EndpointUrl=url,
        Server=server,
        SecurityMode=ua.MessageSecurityMode.None_,
        SecurityPolicyUri=SecurityPolicyNone.URI,
        UserIdentityTokens=[anonymous],
        TransportProfileUri=_TRANSPORT,
    )
