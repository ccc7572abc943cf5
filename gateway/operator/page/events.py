"""Ten times a second, what the line does, to every browser that looks: server-sent events.

One text is made a tick, for all. A browser that does not take it in time gets the newest when it does: nothing queues
up. Where the gateway is away the page is told so, twice a second.
"""

import asyncio
import json
from collections.abc import AsyncIterator, Awaitable, Callable
from typing import Any

from starlette.exceptions import HTTPException
from starlette.requests import Request
from starlette.responses import StreamingResponse
from starlette.types import Receive, Scope, Send

from gateway.core.clean_text import clean_texts
from gateway.core.decisions import ProposalList
from gateway.core.status import GatewayStatus
from gateway.operator.line_side import LineSide
from gateway.operator.page.login import Visitor, address_of
from gateway.operator.page.tick import tick_of
from gateway.operator.places import make_room, place_of

MOST_BROWSERS = 20  #: a share of them from one place, where others want to look; who has logged in goes first
HEARTBEAT_S = 0.5


class Ticks:
    """Made of every status that comes, as long as somebody looks."""

    def __init__(self, side: LineSide) -> None:
        self.lookers: list[_Stream] = []
        self.ended = False
        self._side = side
        self._text = ""
        self._number = 0
        self._news = asyncio.Event()
        self._revision = 0  # of the proposals
        side.on_status.append(self._take)
        side.on_proposals.append(self._take_proposals)

    @property
    def number(self) -> int:
        """Of the newest."""
        return self._number

    @property
    def looking(self) -> int:
        return len(self.lookers)

    def end(self) -> None:
        """The process ends: all streams do."""
        self.ended = True
        self._news.set()

    async def after(self, number: int) -> tuple[int, str]:
        """The newest event, once there is one that is not `number`; after a while that there is none."""
        if number == self._number:
            try:
                await asyncio.wait_for(self._news.wait(), HEARTBEAT_S)
            except TimeoutError:
                return number, _event("away", {"age_s": self._side.age_s, "trouble": self._side.trouble})
        return self._number, self._text

    def _take(self, status: GatewayStatus) -> None:
        if not self.looking:
            return
        self._text = _event("tick", tick_of(status, self._side.proposals, self._revision))
        self._number += 1
        self._news.set()
        self._news = asyncio.Event()  # those who waited have the old one

    def _take_proposals(self, _: ProposalList) -> None:
        self._revision += 1


class _Stream(StreamingResponse):
    """Counts who looks for exactly as long as the answer lasts, also where it never begins."""

    def __init__(self, ticks: Ticks, looks: Callable[[], Visitor | None], place: str, named: bool) -> None:
        super().__init__(_events(ticks, lambda: None if self._out else looks()), media_type="text/event-stream")
        self.place = place
        self._ticks = ticks
        self._named = named
        self._out = False

    def is_proven(self) -> bool:
        return self._named

    def end(self) -> None:
        """Another takes its place: it is told to load the page anew."""
        self._out = True
        self._ticks.lookers.remove(self)

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        self._ticks.lookers.append(self)
        try:
            await super().__call__(scope, receive, send)
        finally:
            if not self._out:
                self._ticks.lookers.remove(self)


async def _events(ticks: Ticks, looks: Callable[[], Visitor | None]) -> AsyncIterator[str]:
    yield "retry: 1000\n\n"
    number, visitor = ticks.number, looks()  # what was made before, for others, may be hours old
    while not ticks.ended:
        if (now := looks()) is None or now != visitor:  # they may more, less, or nothing: the page is loaded anew
            yield _event("anew", {})
            return
        number, text = await ticks.after(number)
        yield text


def stream(
    ticks: Ticks, visitor: Callable[[Request], Visitor], looks: Callable[[Request], Visitor | None]
) -> Callable[[Request], Awaitable[StreamingResponse]]:
    """The endpoint. `visitor` raises where nobody may look; `looks`: as whom, still."""

    async def events(request: Request) -> StreamingResponse:
        named, place = visitor(request).name is not None, place_of(address_of(request))
        # Whoever has no name puts nobody out: they would come and go in turns.
        if ticks.looking >= MOST_BROWSERS and not (named and make_room(place, ticks.lookers, MOST_BROWSERS)):
            raise HTTPException(503, f"{MOST_BROWSERS} pages are open already; close one", {"retry-after": "10"})
        return _Stream(ticks, lambda: looks(request), place, named)

    return events


def _event(kind: str, data: dict[str, Any]) -> str:
    return f"event: {kind}\ndata: {json.dumps(clean_texts(data), separators=(',', ':'), allow_nan=False)}\n\n"
