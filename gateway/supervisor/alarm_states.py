"""What becomes of each alarm: it comes, is seen, ends, is shelved. Pure; time is given.

inactive -> active, not acknowledged -> active, acknowledged -> inactive
                                     -> ended, not acknowledged -> inactive
A shelved alarm goes through the same states out of sight, and is back by itself.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field

from gateway.core.alarms import ALARMS, BY_NAME, LONGEST_SHELVED_S, Alarm

TOGETHER_S = 2.0  #: alarms that came within it have one cause, most likely
RESTORED_S = 60.0  #: what had been acknowledged before a restart, and comes within it, still is


@dataclass
class Live:
    """An alarm that is active, or has not been acknowledged. Times are monotonic."""

    text: str
    since_s: float
    first: str  #: of those that came together
    together: bool = False
    ended_s: float | None = None
    acknowledged_by: str = ""  #: empty: by nobody


@dataclass(frozen=True)
class Shelved:
    since_s: float
    until_s: float


@dataclass
class _Seen:
    """How a condition has been of late."""

    text: str = ""
    since_s: float | None = None  #: it holds; None: it does not
    last_s: float = 0.0  #: it held


@dataclass
class Kept:
    """What outlives the process."""

    acknowledged: dict[str, str] = field(default_factory=dict[str, str])  #: of active ones, by whom
    shelved_s: dict[str, float] = field(default_factory=dict[str, float])  #: how long still


class AlarmStates:
    def __init__(self, now_s: float, kept: Kept) -> None:
        self.live: dict[str, Live] = {}
        self.shelved: dict[str, Shelved] = {
            name: Shelved(now_s, now_s + min(left_s, LONGEST_SHELVED_S))
            for name, left_s in kept.shelved_s.items()
            if name in BY_NAME and left_s > 0.0
        }
        self._seen = {alarm.name: _Seen() for alarm in ALARMS}
        self._restored = dict(kept.acknowledged)
        self._restored_until_s = now_s + RESTORED_S

    def restore_shelved(self, name: str, left_s: float, now_s: float) -> None:
        """As it was before a restart, unless somebody has said otherwise since."""
        if name in BY_NAME and left_s > 0.0 and name not in self.shelved:
            self.shelve(name, left_s, now_s)

    def look(self, conditions: Mapping[str, str], now_s: float) -> list[tuple[str, str]]:
        """`conditions` that hold now, by alarm in words. Returns what has come or gone, with its text, for a record."""
        told = list[tuple[str, str]]()
        for alarm in ALARMS:
            self._see(alarm.name, conditions.get(alarm.name, ""), now_s)
            told += self._moved(alarm, now_s)
        self.shelved = {name: one for name, one in self.shelved.items() if one.until_s > now_s}
        if now_s > self._restored_until_s:
            self._restored.clear()
        return told

    def acknowledge(self, name: str, who: str) -> str:
        """Returns why it cannot be; empty: it is."""
        live = self.live.get(name)
        if live is None:
            return f"{name} is not active: there is nothing to acknowledge"
        if live.acknowledged_by:
            return f"{live.acknowledged_by} has acknowledged {name} already"
        live.acknowledged_by = who
        if live.ended_s is not None:
            del self.live[name]
        return ""

    def shelve(self, name: str, for_s: float, now_s: float) -> None:
        if for_s > 0.0:
            self.shelved[name] = Shelved(now_s, now_s + min(for_s, LONGEST_SHELVED_S))
        else:
            self.shelved.pop(name, None)

    def first_out(self, name: str) -> bool:
        live = self.live.get(name)
        return live is not None and live.together and live.first == name

    def kept(self, now_s: float) -> Kept:
        acknowledged = {name: one.acknowledged_by for name, one in self.live.items() if one.acknowledged_by}
        return Kept(
            {**self._restored, **acknowledged}, {name: one.until_s - now_s for name, one in self.shelved.items()}
        )

    def _see(self, name: str, text: str, now_s: float) -> None:
        seen = self._seen[name]
        if not text:
            seen.since_s = None
            return
        if seen.since_s is None:
            seen.since_s, seen.text = now_s, text  # the values with which it came
        seen.last_s = now_s

    def _moved(self, alarm: Alarm, now_s: float) -> list[tuple[str, str]]:
        seen, live = self._seen[alarm.name], self.live.get(alarm.name)
        active = live is not None and live.ended_s is None
        if not active and seen.since_s is not None and now_s - seen.since_s >= alarm.after_s:
            self._come(alarm, seen.text, seen.since_s)
            return [("alarm", f"{alarm.name}: {alarm.means}: {seen.text}")]
        if live is not None and active and seen.since_s is None and now_s - seen.last_s >= alarm.gone_s:
            live.ended_s = now_s
            if live.acknowledged_by:
                del self.live[alarm.name]
            return [("alarm-ended", f"{alarm.name}: {alarm.means}: no more")]
        return []

    def _come(self, alarm: Alarm, text: str, since_s: float) -> None:
        live = Live(text, since_s, alarm.name, acknowledged_by=self._restored.pop(alarm.name, ""))
        others = {name: one for name, one in self.live.items() if name != alarm.name}
        group = {name: one for name, one in others.items() if abs(self._began(one, others) - since_s) <= TOGETHER_S}
        if group:
            members = {**group, alarm.name: live}
            first = min(members, key=lambda name: (BY_NAME[name].follows, members[name].since_s, _ORDER[name]))
            for one in members.values():
                one.together, one.first = True, first
        self.live[alarm.name] = live

    def _began(self, one: Live, others: Mapping[str, Live]) -> float:
        """When the first of those that came with it did."""
        return others[one.first].since_s if one.first in others else one.since_s


_ORDER = {alarm.name: place for place, alarm in enumerate(ALARMS)}  #: causes stand before what they lead to
