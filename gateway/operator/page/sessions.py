"""Who is logged in at the page, for how long, and how fast names and passwords may be tried. Pure: time is given."""

import secrets
from collections import Counter, OrderedDict
from collections.abc import Callable
from dataclasses import dataclass, field

from gateway.core.people import Role

IDLE_S = 3600.0  #: nothing said, and the page not loaded anew; looking on alone is nothing
MAY_IDLE = ("stop", "hold")  #: what a session that is idle may still say, where its role may
LONGEST_S = 12.0 * 3600.0  #: a shift, and the way there
MOST_SESSIONS = 64  #: the one that has been idle for longest goes first
MOST_EACH = 5  #: of one name; the oldest ends

FREE_TRIES = 3  #: that fail, before the next has to wait
LONGEST_WAIT_S = 60.0
FORGOTTEN_S = 900.0  #: after the last one that failed
MOST_PLACES = 1000  #: from which tries are remembered
MOST_COUNTED = 30  #: tries from one place


@dataclass
class Session:
    name: str
    role: Role
    token: str  #: in a header of every request that changes something: no other site's page can know it
    began_s: float
    seen_s: float
    looked_up_s: float  #: when it was made sure last that they have this role
    is_idle: bool = False  #: as it was seen last; it stays so


class Sessions:
    """By the random key that the browser keeps in a cookie."""

    def __init__(self, clock: Callable[[], float]) -> None:
        self._clock = clock
        self._by_key: OrderedDict[str, Session] = OrderedDict()  # the one used last at the end

    def begin(self, name: str, role: Role) -> str:
        """The key, 256 random bits."""
        key, now_s = secrets.token_urlsafe(32), self._clock()
        own = sorted((one.began_s, old) for old, one in self._by_key.items() if one.name == name)
        for _, old in own[: max(0, len(own) - MOST_EACH + 1)]:
            del self._by_key[old]
        self._by_key[key] = Session(name, role, secrets.token_urlsafe(32), now_s, now_s, now_s)
        while len(self._by_key) > MOST_SESSIONS:
            self._by_key.popitem(last=False)
        return key

    def find(self, key: str) -> Session | None:
        """None: there is none, or no longer. One that is idle is there until its longest time is over."""
        session = self._by_key.get(key)
        if session is None:
            return None
        now_s = self._clock()
        if now_s - session.began_s > LONGEST_S:
            del self._by_key[key]
            return None
        session.is_idle = session.is_idle or now_s - session.seen_s > IDLE_S
        return session

    def use(self, key: str) -> Session | None:
        """As `find`; from now on it is not idle, unless it has become so already."""
        session = self.find(key)
        if session is not None and not session.is_idle:
            session.seen_s = self._clock()
            self._by_key.move_to_end(key)
        return session

    def end(self, key: str) -> None:
        self._by_key.pop(key, None)


@dataclass
class _Failures:
    last_s: float
    by_name: Counter[str] = field(default_factory=Counter[str])


class Tries:
    """Of names and passwords, by where they come from. Who fails waits, each time twice as long, whatever the name.

    A password that is right clears the tries of its own name: who has one learns no other's the faster by it.
    """

    def __init__(self, clock: Callable[[], float]) -> None:
        self._clock = clock
        self._failed: OrderedDict[str, _Failures] = OrderedDict()

    def wait_s(self, place: str) -> float:
        """0: the next may be made now."""
        failures = self._failed.get(place)
        if failures is None or (count := failures.by_name.total()) < FREE_TRIES:
            return 0.0
        wait_s = min(LONGEST_WAIT_S, 2.0 ** (count - FREE_TRIES))
        return max(0.0, failures.last_s + wait_s - self._clock())

    def failed(self, place: str, name: str) -> None:
        found, now_s = self._failed.pop(place, None), self._clock()
        if found is None or now_s - found.last_s > FORGOTTEN_S:
            found = _Failures(now_s)
        if found.by_name.total() < MOST_COUNTED:
            found.by_name[name] += 1
        found.last_s = now_s
        self._failed[place] = found
        while len(self._failed) > MOST_PLACES:
            self._failed.popitem(last=False)

    def went_well(self, place: str, name: str) -> None:
        found = self._failed.get(place)
        if found is not None:
            del found.by_name[name]
