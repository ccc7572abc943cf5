"""What a client may have of the server at most, and asyncua's services held to it."""

from collections.abc import Callable
from math import isfinite
from typing import Any

from asyncua import ua as asyncua_ua
from asyncua.common.utils import ServiceError
from asyncua.server.address_space import ViewService
from asyncua.server.internal_subscription import InternalSubscription
from asyncua.server.subscription_service import SubscriptionService

from gateway.operator.opcua.filters import Items

LEAST_CHUNK, MAX_CHUNK = 8192, 65_535  #: bytes; the least that a client must be able to take (OPC 10000-6, 7.1.2.3)
MAX_CHUNKS = 4
MAX_MESSAGE = MAX_CHUNKS * MAX_CHUNK  #: bytes
MAX_READ = 1000  #: nodes of one request
MAX_BROWSE = 100
MAX_CALLS = 4  #: methods of one request, and requests with methods that one client may have running
MAX_URGENT = 8  #: stops that one client may have running, and holds, whatever else it has called
MAX_HISTORIES = 20  #: nodes of one request
MAX_HISTORY_READS = 2  #: requests that one client may have running
MAX_HISTORY_POINTS = 5000  #: of one request, of all its nodes: they have to fit into an answer
MAX_MONITORED = 1000  #: items of all subscriptions of a session
MAX_EVENT_ITEMS = 10  #: among them: an event is made anew for each
MAX_QUEUE = 100  #: values of one item that wait to be published
MAX_UNACKNOWLEDGED = 20  #: messages of one subscription that are kept to be sent again
SUBSCRIPTIONS_EACH = 4  #: of a session
MORE_CONNECTIONS = 12  #: than sessions: for clients that look for the endpoints, or have not logged in yet
BEING_ENDED = 128  #: connections that count until the event loop has come round to their end
PENDING_MESSAGES = 64
LOGIN_S = 5.0  #: from a connection to a session
UNHEARD_MS = 15_000  #: that a client takes nothing of what is sent: it is gone, and frees its place
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
    """Subscriptions of bounded speed, number and number of items, none of which can harm another."""

    async def create_subscription(
        self,
        params: Any,
        callback: Callable[..., Any],
        session_id: Any,
        request_callback: Callable[..., Any] | None = None,
    ) -> Any:
        shortest, longest = PUBLISHING_MS
        if request_callback is not None:  # a client's
            if len(self._of(session_id)) >= SUBSCRIPTIONS_EACH:
                raise ServiceError(ua.StatusCodes.BadTooManySubscriptions)
            wanted = float(params.RequestedPublishingInterval)
            params.RequestedPublishingInterval = min(max(wanted, shortest), longest) if isfinite(wanted) else longest
        result = await super().create_subscription(params, callback, session_id, request_callback)
        made = self.subscriptions[result.SubscriptionId]
        made.monitored_item_srv = Items(made, self.aspace)
        return result

    async def create_monitored_items(self, params: Any) -> list[Any]:
        wanted = params.ItemsToCreate = params.ItemsToCreate or []
        events = sum(one.ItemToMonitor.AttributeId == ua.AttributeIds.EventNotifier for one in wanted)
        held = self.subscriptions.get(params.SubscriptionId)
        others = [one.monitored_item_srv for one in self._of(held.session_id)] if held is not None else []
        items = [one for one in others if isinstance(one, Items)]
        if (
            sum(one.items() for one in items) + len(wanted) > MAX_MONITORED
            or sum(one.event_items() for one in items) + events > MAX_EVENT_ITEMS
        ):
            raise ServiceError(ua.StatusCodes.BadTooManyMonitoredItems)
        return await super().create_monitored_items(params)

    def modify_monitored_items(self, params: Any) -> list[Any]:
        at_most(len(params.ItemsToModify), MAX_MONITORED)
        for item in params.ItemsToModify:  # asyncua would take any length, and 0 for none at all
            item.RequestedParameters.QueueSize = min(max(item.RequestedParameters.QueueSize, 1), MAX_QUEUE)
        return super().modify_monitored_items(params)

    async def trigger_event(self, event: Any, subscription_id: int | None = None) -> None:
        """A subscription that cannot be told is ended; the others, and who tells, go on."""
        for number in list(self.subscriptions) if subscription_id is None else [subscription_id]:
            try:
                await self.subscriptions[number].monitored_item_srv.trigger_event(event)  # asyncua keeps conditions
            except Exception:  # whatever asyncua makes of what that client has asked for
                await self.delete_subscriptions([number])

    def _of(self, session_id: Any) -> list[InternalSubscription]:
        return [one for one in self.subscriptions.values() if one.session_id == session_id]


class Views(ViewService):
    """Browsing of a bounded number of nodes in one request: each may have hundreds of references."""

    def browse(self, params: Any) -> list[Any]:
        at_most(len(params.NodesToBrowse), MAX_BROWSE)
        return super().browse(params)

    def translate_browsepaths_to_nodeids(self, browsepaths: list[Any]) -> list[Any]:
        at_most(len(browsepaths), MAX_BROWSE)
        return super().translate_browsepaths_to_nodeids(browsepaths)
