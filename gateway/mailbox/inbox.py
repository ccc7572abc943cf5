"""The bounds of what is taken from outside: how often, how long and how much of it may wait, for each caller.

One place for every transport. A caller is who the connection says (`SO_PEERCRED` on a unix socket, the key that the
access rules allow on the agents' bus), never a name inside a message. Callers come in groups, the processes of one user
or one agent: each process has its own share, and its group has one, so that neither one process nor many started for it
take more than theirs. What waits is taken in turns, group by group and process by process: a flood waits behind itself.

Pure; time is passed in.
"""

from collections import OrderedDict, deque
from collections.abc import Callable
from typing import Generic, NamedTuple, TypeVar

from gateway.core.finding import Finding, finding
from gateway.core.messages import Reply
from gateway.mailbox.allowance import Allowance

Item = TypeVar("Item")
Key = TypeVar("Key")

SOONEST_S = 0.05  #: what is rounded on its way is not asked for too early
MOST_CALLERS = 500  #: of which each has an account; the one that was quiet for longest is forgotten first


class Caller(NamedTuple):
    """Who asks."""

    group: str  #: "user 1000", "agent sysid"
    session: str  #: within it: "process 4711"; empty: the group has one


class Bounds(NamedTuple):
    """Of one kind of message."""

    per_s: float  #: of each session
    at_once: float  #: of each session after a pause
    group_per_s: float  #: of all sessions of a group together
    group_at_once: float
    bytes: int  #: of one message
    waiting: int = 4  #: of each session, taken and not yet worked on
    all_waiting: int = 64  #: of everybody together


class RateLimiter:
    """Says of each message that comes whether it is taken; refusing costs the caller nothing of its share."""

    def __init__(self, clock: Callable[[], float]) -> None:
        self._clock = clock
        self._accounts: OrderedDict[tuple[str, str], Allowance] = OrderedDict()
        self._groups: OrderedDict[str, Allowance] = OrderedDict()

    def refuse(self, caller: Caller, bounds: Bounds, size: int) -> Finding | None:
        """Why it is not taken, with `again_s`: when it is worth asking again. None: it is taken, and counted."""
        if size > bounds.bytes:
            return finding("inbox-size", caller=name_of(caller), size_bytes=size, allowed_bytes=bounds.bytes)
        now_s = self._clock()
        own = _account(self._accounts, caller, bounds.per_s, bounds.at_once)
        shared = _account(self._groups, caller.group, bounds.group_per_s, bounds.group_at_once)
        if (again_s := own.wait_s(now_s)) > 0.0:
            return finding("inbox-rate", caller=name_of(caller), every_s=1.0 / bounds.per_s, again_s=again_s)
        if (again_s := shared.wait_s(now_s)) > 0.0:
            return finding("inbox-rate", caller=caller.group, every_s=1.0 / bounds.group_per_s, again_s=again_s)
        own.take(now_s)
        shared.take(now_s)
        return None


class FairQueue(Generic[Item]):
    """What was taken and waits to be worked on. `take` goes round the groups, and round the sessions of each."""

    def __init__(self) -> None:
        self._groups: OrderedDict[str, OrderedDict[str, deque[Item]]] = OrderedDict()
        self._count = 0

    def __len__(self) -> int:
        return self._count

    def put(self, caller: Caller, item: Item) -> None:
        """Behind what this caller has put before; in front of nobody's first."""
        self._groups.setdefault(caller.group, OrderedDict()).setdefault(caller.session, deque()).append(item)
        self._count += 1

    def take(self) -> Item:
        """The next one. Raises IndexError where nothing waits."""
        if not self._count:
            raise IndexError("nothing waits")
        group, sessions = self._groups.popitem(last=False)
        session, items = sessions.popitem(last=False)
        item = items.popleft()
        if items:
            sessions[session] = items
        if sessions:
            self._groups[group] = sessions
        self._count -= 1
        return item

    def refuse(self, caller: Caller, bounds: Bounds, each_s: float) -> Finding | None:
        """Why one more of this caller cannot wait here; `each_s`: what one of them takes, at most. None: it can.

        Where all places are taken, one who has nothing waiting still finds one: what is bounded is the crowd, not the
        first of each.
        """
        own = len(self._groups.get(caller.group, {}).get(caller.session, ()))
        if own >= bounds.waiting:
            return finding("inbox-full", caller=name_of(caller), waiting=own, allowed=bounds.waiting, again_s=each_s)
        of_group = sum(len(items) for items in self._groups.get(caller.group, {}).values())
        if self._count >= bounds.all_waiting and of_group:
            return finding(
                "inbox-full", caller=caller.group, waiting=self._count, allowed=bounds.all_waiting, again_s=each_s
            )
        return None


def come_again_s(reply: Reply) -> float | None:
    """In how many seconds it is worth asking again; None: it was taken, or asking again changes nothing."""
    for one in reply.findings:
        again_s = one.parameters.get("again_s")
        if one.code in ("inbox-rate", "inbox-full") and isinstance(again_s, int | float):
            return max(SOONEST_S, float(again_s))
    return None


def name_of(caller: Caller) -> str:
    """In words: "user 1000, process 4711"."""
    return f"{caller.group}, {caller.session}" if caller.session else caller.group


def _account(accounts: OrderedDict[Key, Allowance], key: Key, per_s: float, at_once: float) -> Allowance:
    account = accounts.pop(key, None) or Allowance(per_s, at_once)
    accounts[key] = account
    while len(accounts) > MOST_CALLERS:
        accounts.popitem(last=False)
    return account
