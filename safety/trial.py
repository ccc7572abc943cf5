"""When a change that is under watch may be kept, and when nobody has seen enough of it. Pure; time is an argument.

It is kept on looks that were good and no others: together they cover a third of probation, and the newest is one of
them. A look at too few samples counts neither for it nor against it. Once such looks have lasted for as long as
probation, all in all and not in a row, they take it back: what was in service before was tried on a line that could be
seen, and one that is hardly seen now and then must come to an end, too. Where the line moves, or stands without
running, nothing is missed: it stays on probation until there is something to see.
"""

from dataclasses import dataclass
from math import inf

from safety.probation import Look, Unseen

LOOKED_SHARE = 1.0 / 3.0  #: of probation: covered by good looks, at least
SILENT_S = 1.0  #: without telemetry for longer nothing of the line is seen
LONGEST_S = 1.0  #: from one look to the next, as far as it counts
MOST_NAMED = 3  #: of what was not seen; a line may have dozens of spans


@dataclass
class Trial:
    """Of one change, from when it is about to be put on the line. `look` a few times a second."""

    probation_s: float
    window_s: float  #: that a look covers

    looked_s: float = 0.0  #: covered by good looks
    blind_s: float = 0.0  #: in which the line could have been looked at, and too little was seen; all in all
    stood: bool = False  #: the line has, for long enough to be looked at
    blind: str = ""  #: why too little was seen with the newest look; empty: enough was
    _covered_until_s: float = -inf
    _looked_s: float | None = None  #: when it was looked last

    @property
    def needed_s(self) -> float:
        """What good looks must cover."""
        return max(self.window_s, LOOKED_SHARE * self.probation_s)

    def look(self, found: Look | None, newest_s: float | None, now_s: float) -> str:
        """Why the change must be taken back; empty: nothing speaks against it, as far as it was seen.

        `found`: None while the line does not stand. `newest_s`: of the newest telemetry, None before the first.
        """
        passed_s = 0.0 if self._looked_s is None else min(max(now_s - self._looked_s, 0.0), LONGEST_S)
        self._looked_s = now_s
        self.blind = _blind(found, newest_s, now_s)
        if found is not None:
            self.stood = True
            if found.against:
                return found.against
        if self.blind:
            self.blind_s += passed_s
        elif found is not None and newest_s is not None:
            self.looked_s += min(max(newest_s - self._covered_until_s, 0.0), self.window_s)
            self._covered_until_s = newest_s
        # Any other answer than that the bound was not reached takes it back.
        if not self.blind_s < self.probation_s:
            return f"too little was seen of it for {self.probation_s:g} s: {self.blind}"
        return ""

    def missing(self) -> str:
        """What it has not shown yet; empty: it may be kept."""
        looked = f"good looks at it cover {self.looked_s:.0f} s of {self.needed_s:.0f} s"
        if self.blind:
            return f"{self.blind}: this counts neither for it nor against it; {looked}"
        return "" if self.looked_s >= self.needed_s else looked


def _blind(found: Look | None, newest_s: float | None, now_s: float) -> str:
    if newest_s is None:
        return "no telemetry has come from the loop"
    if not now_s - newest_s <= SILENT_S:  # nor where either is no time at all
        return f"the newest telemetry is {now_s - newest_s:.1f} s old"
    return _named(found.unseen) if found is not None else ""


def _named(unseen: tuple[Unseen, ...]) -> str:
    """The first, and how many more; empty: nothing was unseen."""
    more = len(unseen) - MOST_NAMED
    return "; ".join([*map(str, unseen[:MOST_NAMED]), *([f"and {more} more"] if more > 0 else [])])
