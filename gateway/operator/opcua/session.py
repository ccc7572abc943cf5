"""A client's session: whose it is, and what it may ask for. Nothing can be written, and each has its own alone."""

from collections.abc import Callable
from contextvars import ContextVar
from typing import Any

from asyncua import ua as asyncua_ua
from asyncua.common.utils import ServiceError
from asyncua.server.internal_session import InternalSession

from gateway.core.people import Person
from gateway.operator.opcua.limits import MAX_CALLS, MAX_HISTORIES, MAX_MONITORED, MAX_READ, at_most

ua: Any = asyncua_ua  #: what it declares of its values and what they are differ

#: Who calls the method that runs. asyncua tells its methods nothing of that.
CALLER: ContextVar[Person | None] = ContextVar("caller", default=None)

#: Which subscriptions are that session's, by their numbers.
OWNS: ContextVar[Callable[[int], bool]] = ContextVar("owns", default=lambda _: False)


def _nobody() -> Person | None:
    return None


class Session(InternalSession):
    logged_in: Callable[[], Person | None] = staticmethod(_nobody)  #: who has, as they are now

    @property
    def person(self) -> Person | None:
        """None: nobody has logged in yet, or who has is no user any more."""
        return self.logged_in()

    async def read(self, params: Any) -> list[Any]:
        at_most(len(params.NodesToRead), MAX_READ)
        return await super().read(params)

    async def write(self, params: Any) -> list[Any]:
        if not self.external:
            return await super().write(params)
        at_most(len(params.NodesToWrite), MAX_READ)
        return [ua.StatusCode(ua.StatusCodes.BadUserAccessDenied)] * len(params.NodesToWrite)

    async def call(self, params: list[Any]) -> list[Any]:
        at_most(len(params), MAX_CALLS)
        caller, owns = CALLER.set(self.person), OWNS.set(self._owns)
        try:
            return await super().call(params)
        finally:
            CALLER.reset(caller)
            OWNS.reset(owns)

    async def history_read(self, params: Any) -> list[Any]:
        at_most(len(params.NodesToRead), MAX_HISTORIES)
        return await super().history_read(params)

    async def create_monitored_items(self, params: Any) -> list[Any]:
        self._own(params.SubscriptionId)
        return await super().create_monitored_items(params)

    async def modify_monitored_items(self, params: Any) -> list[Any]:
        self._own(params.SubscriptionId)
        return await super().modify_monitored_items(params)

    async def delete_monitored_items(self, params: Any) -> list[Any]:
        self._own(params.SubscriptionId)
        at_most(len(params.MonitoredItemIds), MAX_MONITORED)
        return await super().delete_monitored_items(params)

    async def set_monitoring_mode(self, params: Any) -> list[Any]:
        self._own(params.SubscriptionId)
        at_most(len(params.MonitoredItemIds), MAX_MONITORED)
        return await super().set_monitoring_mode(params)

    async def set_publishing_mode(self, params: Any) -> list[Any]:
        for number in params.SubscriptionIds:
            self._own(number)
        return await super().set_publishing_mode(params)

    async def delete_subscriptions(self, ids: list[int]) -> list[Any]:
        for number in ids:
            self._own(number)
        return await super().delete_subscriptions(ids)

    def modify_subscription(self, params: Any) -> Any:
        self._own(params.SubscriptionId)
        return super().modify_subscription(params)

    def republish(self, params: Any) -> Any:
        self._own(params.SubscriptionId)
        return super().republish(params)

    def publish(self, acks: Any = None) -> Any:
        """What another session's subscription waits for cannot be acknowledged away."""
        return super().publish([ack for ack in acks or [] if self._owns(ack.SubscriptionId)])

    def _owns(self, number: int) -> bool:
        found = self.subscription_service.subscriptions.get(number)
        return found is not None and found.session_id == self.session_id

    def _own(self, number: int) -> None:
        """Raises ServiceError. asyncua lets every session at every subscription."""
        if not self._owns(number):
            raise ServiceError(ua.StatusCodes.BadSubscriptionIdInvalid)
