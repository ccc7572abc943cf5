"""What others than the gateway have tried at the loop, and what lay in its folder: on record, and told for a while."""

from collections import deque
from collections.abc import Callable
from itertools import chain

from gateway.core.finding import Finding
from gateway.core.messages import Event
from gateway.supervisor.loop_records import LoopRecords
from gateway.supervisor.peers import GATEWAY

#: Kinds of events of the loop, and of the records that are made of them.
#: What matters most first.
KINDS = {"configuration-set-aside": "set-aside", "refused-at-the-door": "refused-at-loop"}
SHOWN_S = 600.0  #: for which an attempt stands in the status, and its alarm is active
MOST_SHOWN = 8


class Intrusions:
    """`hear` what the loop tells; `recent` is what a person must see."""

    def __init__(self, records: LoopRecords, clock: Callable[[], float]) -> None:
        self._records = records
        self._clock = clock
        #: Of each kind its own: whoever makes many of one hides none of another.
        self._seen: dict[str, deque[tuple[float, Finding]]] = {kind: deque(maxlen=MOST_SHOWN) for kind in KINDS}

    def hear(self, event: Event) -> None:
        """An event of the loop; most are of no concern here."""
        if (kind := KINDS.get(event.kind)) is None or not event.findings:
            return
        now_s = self._clock()
        for found in event.findings[:MOST_SHOWN]:
            self._seen[event.kind].append((now_s, found))
        found = [one.model_dump(mode="json") for one in event.findings[:MOST_SHOWN]]
        self._records.write(kind, GATEWAY, {"findings": found, "because": event.text[:400]})

    def recent(self) -> list[Finding]:
        """What matters most first, then the newest last; each once."""
        since_s = self._clock() - SHOWN_S
        found: list[Finding] = []
        for at_s, one in chain.from_iterable(self._seen.values()):
            if at_s >= since_s and one not in found:
                found.append(one)
        return found
