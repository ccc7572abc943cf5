"""By what the loop looks after the last known good while nothing is on trial: by the model in service, until it does.

A loop may refuse it for now (its disk is full, its computer too slow at that moment), and one that was started anew may
have left it out: it is told again, later each time, until it says that it watches.
"""

from collections.abc import Awaitable, Callable

from gateway.core.deployment import InService
from gateway.core.messages import Command, Reply, WatchGood
from gateway.supervisor.deployer_sides import NotKnown, Surroundings
from gateway.supervisor.lifecycle import Book
from gateway.supervisor.patience import Patience

Pair = tuple[str | None, str | None]  #: model and configuration


class GoodWatch:
    """`look` at what the loop says it runs, as often as it `is_due`; `taken` where it was told with a change."""

    def __init__(
        self,
        book: Book,
        surroundings: Surroundings,
        tell: Callable[[Command], Awaitable[Reply]],
        clock: Callable[[], float],
    ) -> None:
        self.unwatched = ""  #: why the loop does not watch by the model in service, as it was first said
        self._book = book
        self._surroundings = surroundings
        self._tell = tell
        self._patience = Patience(clock)
        self._wanted: Pair = None, None  #: that `_patience` is of
        self._taken: Pair | None = None  #: that the loop has taken from this process
        self._watched = False  #: the loop has said so last

    def is_due(self) -> bool:
        """Whether the loop must be asked what it runs, to be told by what it shall watch."""
        pair = self._book.model, self._book.last_known_good
        return pair[0] is not None and not self._is_so(pair) and (pair != self._wanted or self._patience.is_due())

    def taken(self, good: str) -> None:
        """The loop has been told with a change that was kept, and watches `good` by the model in service."""
        self._taken = self._book.model, good

    async def look(self, found: InService) -> None:
        """Tell the loop, where it does not watch by the model in service, and it is time. Raises Unreachable."""
        pair = self._book.model, found.last_known_good
        self._watched = found.watched
        if pair != self._wanted:
            self._wanted, self.unwatched = pair, ""
            self._patience.begin_anew()
        if pair[0] is None:
            return
        if self._is_so(pair):
            self.unwatched = ""
            self._patience.succeeded()
        elif self._patience.is_due():
            self._patience.failed()  # until the loop says that it watches
            because = await self._refusal(found)
            if not because:
                self._taken, self._watched, self.unwatched = pair, True, ""
            elif not self.unwatched:
                self.unwatched = f"the loop does not watch by the model in service: {because}; it is told again"

    def _is_so(self, pair: Pair) -> bool:
        return self._watched and pair == self._taken

    async def _refusal(self, found: InService) -> str:
        """Empty: it has taken it. Raises Unreachable."""
        try:
            watch = await self._surroundings.recovery(found.last_known_good, found.region, self._book)
        except NotKnown as error:
            return str(error)
        if watch is None:
            return "no model is in service"
        reply = await self._tell(WatchGood(watch=watch))
        return "" if reply.ok else "; ".join([reply.text, *reply.reasons])
