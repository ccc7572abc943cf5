"""What others than the gateway have tried at the loop, and what lay in its folder: on record, and told for a while."""

import asyncio
from collections import deque
from collections.abc import Awaitable, Callable, Mapping
from itertools import chain
from typing import Any

from gateway.core.audit_record import Who
from gateway.core.finding import Finding
from gateway.core.messages import Event
from gateway.supervisor.audit_file import AuditUnavailable
from gateway.supervisor.bounded import Bounded, with_left_out
from gateway.supervisor.peers import GATEWAY

#: Kinds of events of the loop, and of the records that are made of them.
#: What matters most first.
KINDS = {"configuration-set-aside": "set-aside", "refused-at-the-door": "refused-at-loop"}
SHOWN_S = 600.0  #: for which an attempt stands in the status, and its alarm is active
MOST_SHOWN = 8


class Intrusions:
    """`hear` what the loop tells; `recent` is what a person must see."""

    def __init__(
        self,
        append: Callable[[str, Who, Mapping[str, Any]], Awaitable[object]],
        note: Callable[..., None],
        clock: Callable[[], float],
    ) -> None:
        self._append = append
        self._note = note
        self._clock = clock
        self._bounded = Bounded(clock)
        #: Of each kind its own: whoever makes many of one hides none of another.
        self._seen: dict[str, deque[tuple[float, Finding]]] = {kind: deque(maxlen=MOST_SHOWN) for kind in KINDS}
        self._recording: set[asyncio.Task[None]] = set()

    def hear(self, event: Event) -> None:
        """An event of the loop; most are of no concern here."""
        if (kind := KINDS.get(event.kind)) is None or not event.findings:
            return
        now_s = self._clock()
        for found in event.findings[:MOST_SHOWN]:
            self._seen[event.kind].append((now_s, found))
        if (left_out := self._bounded.left_out(kind)) is None:
            return
        found = [one.model_dump(mode="json") for one in event.findings[:MOST_SHOWN]]
        what = with_left_out({"findings": found, "because": event.text[:400]}, left_out)
        task = asyncio.get_running_loop().create_task(self._record(kind, what, left_out))
        self._recording.add(task)
        task.add_done_callback(self._recording.discard)

    def recent(self) -> list[Finding]:
        """What matters most first, then the newest last; each once."""
        since_s = self._clock() - SHOWN_S
        found: list[Finding] = []
        for at_s, one in chain.from_iterable(self._seen.values()):
            if at_s >= since_s and one not in found:
                found.append(one)
        return found

    async def close(self) -> None:
        await asyncio.gather(*self._recording, return_exceptions=True)

    async def _record(self, kind: str, what: Mapping[str, Any], left_out: int) -> None:
        try:
            await self._append(kind, GATEWAY, what)
        except AuditUnavailable as error:
            self._bounded.undo(kind, left_out + 1)
            self._note("gate", f"what was tried at the loop could not be recorded: {error}")
