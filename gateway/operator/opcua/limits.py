"""What a client may have of the server at most, and asyncua's services held to it."""

from collections.abc import Callable
from math import isfinite
from typing import Any

from asyncua import ua as asyncua_ua
from asyncua.common.utils import ServiceError
from asyncua.server.address_space import ViewService
from asyncua.server.subscription_service import SubscriptionService

MAX_CHUNK = 65_535  #: bytes
MAX_CHUNKS = 4
MAX_MESSAGE = 262_144  #: bytes
MAX_READ = 1000  #: nodes of one request
MAX_BROWSE = 100
MAX_CALLS = 4  #: methods of one request, and requests with methods that one client may have running
MAX_HISTORIES = 60  #: nodes of one request
MAX_MONITORED = 1000  #: items of one subscription
MAX_QUEUE = 100  #: values of one item that wait to be published
MAX_UNACKNOWLEDGED = 100  #: messages of one subscription that are kept to be sent again
SUBSCRIPTIONS_EACH = 4  #: of the sessions that may be, on average
MORE_CONNECTIONS = 12  #: than sessions: for clients that look for the endpoints, or have not logged in yet
PENDING_MESSAGES = 64
LOGIN_S = 5.0  #: from a connection to a session
SESSION_TIMEOUT_MS = (5_000, 10_000)  #: a client that is killed costs so long and no longer
PUBLISHING_MS = (50.0, 60_000.0)  #: shortest and longest interval of a subscription

ua: Any = asyncua_ua  #: what it declares of its values and what they are differ

#: As the server tells its clients.
OPERATION_LIMITS = {
    "MaxNodesPerRead": MAX_READ,
    "MaxNodesPerBrowse": MAX_BROWSE,
    "MaxNodesPerTranslateBrowsePathsToNodeIds": MAX_BROWSE,
    "MaxNodesPerMethodCall": MAX_CALLS,
    "MaxNodesPerHistoryReadData": MAX_HISTORIES,
    "MaxMonitoredItemsPerCall": MAX_MONITORED,
}


def at_most(count: int, most: int) -> None:
    """Raises ServiceError."""
    if count > most:
        raise ServiceError(ua.StatusCodes.BadTooManyOperations)


class Subscriptions(SubscriptionService):
    """Subscriptions of bounded speed and number of items."""

    async def create_subscription(
        self,
        params: Any,
        callback: Callable[..., Any],
        session_id: Any,
        request_callback: Callable[..., Any] | None = None,
    ) -> Any:
        shortest, longest = PUBLISHING_MS
        if request_callback is not None:  # a client's
            wanted = float(params.RequestedPublishingInterval)
            params.RequestedPublishingInterval = min(max(wanted, shortest), longest) if isfinite(wanted) else longest
        return await super().create_subscription(params, callback, session_id, request_callback)

    async def create_monitored_items(self, params: Any) -> list[Any]:
        held = self.subscriptions.get(params.SubscriptionId)
        before = 0 if held is None else len(held.monitored_item_srv._monitored_items)  # noqa: SLF001
        if before + len(params.ItemsToCreate) > MAX_MONITORED:
            raise ServiceError(ua.StatusCodes.BadTooManyMonitoredItems)
        return await super().create_monitored_items(params)

    def modify_monitored_items(self, params: Any) -> list[Any]:
        at_most(len(params.ItemsToModify), MAX_MONITORED)
        for item in params.ItemsToModify:  # asyncua would take any length, and 0 for none at all
            item.RequestedParameters.QueueSize = min(max(item.RequestedParameters.QueueSize, 1), MAX_QUEUE)
        return super().modify_monitored_items(params)


class Views(ViewService):
    """Browsing of a bounded number of nodes in one request: each may have hundreds of references."""

    def browse(self, params: Any) -> list[Any]:
        at_most(len(params.NodesToBrowse), MAX_BROWSE)
        return super().browse(params)

    def translate_browsepaths_to_nodeids(self, browsepaths: list[Any]) -> list[Any]:
        at_most(len(browsepaths), MAX_BROWSE)
        return super().translate_browsepaths_to_nodeids(browsepaths)
