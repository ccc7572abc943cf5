"""How long telemetry and events are kept, and how large the history may become: the oldest goes first.

Age is what the monotonic clocks of this boot and the ones after it add up to; the time between boots counts only
where wall clocks were seen to agree (`dating.py`). A clock that was set deletes nothing by itself, and as even one that
agrees may be wrong, no more than a day of telemetry and a day of events go in an hour. What is too much goes by its
order: events where they take more than their share of it, or there is nothing else; telemetry else. So the bound holds
for both, and neither drives the other out.
"""

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from math import ceil
from typing import cast

import apsw

from gateway.core.line import History
from gateway.supervisor.dating import ends_of_boots
from gateway.supervisor.store import delete_blobs

DAY_S = 86_400.0
TURN_S = 3_600.0  #: in which no more than a day goes by its age: a backlog of a year takes two weeks
BLOBS_AT_ONCE = 30  #: ten minutes of history every twenty seconds: it catches up, and no turn takes long
EVENTS_AT_ONCE = 1000
EVENTS_SHARE = 0.25  #: of what may be kept, that events have where there is more
MUCH_AT_ONCE = 20_000  #: events, where they are too much: more than a loop can tell until the next look
WEIGHED = 200  #: events that are weighed for all of them
_SIZE, _THESE = "octet_length(text) + octet_length(data)", "SELECT value FROM json_each(?)"
ROW_BYTES = 80  #: of an event in its table and in the index by time, beside its text and data
PAGES_AT_ONCE = 2000  #: given back to the disk
SPARE_PAGES = 128  #: and a twentieth of the file: used again by what comes; giving them back would move the newest


@dataclass(frozen=True, slots=True)
class Retention:
    telemetry_s: float
    events_s: float
    most_bytes: int


def retention_of(history: History) -> Retention:
    return Retention(history.keep_days * DAY_S, history.keep_events_days * DAY_S, round(history.keep_gb * 1e9))


@dataclass
class _DayATurn:
    """How much recorded time may still go in this turn."""

    left_s: float = DAY_S
    last: tuple[str, float] | None = None  #: boot and monotonic time up to which it went

    def allows(self, boot: str, until_s: float) -> bool:
        """Whether the next, which ends then, may go; it counts as gone."""
        step_s = until_s - self.last[1] if self.last is not None and self.last[0] == boot else 0.0
        if step_s > self.left_s:
            return False
        self.left_s -= max(0.0, step_s)
        self.last = boot, until_s
        return True


@dataclass
class Allowance:
    """Of one gateway: what may go by its age until the turn is over."""

    began_s: float | None = None  #: monotonic
    telemetry: _DayATurn = field(default_factory=_DayATurn)
    events: _DayATurn = field(default_factory=_DayATurn)

    def look(self, now_s: float) -> None:
        """Begin a turn when it is time."""
        if self.began_s is None or now_s - self.began_s >= TURN_S:
            self.began_s, self.telemetry, self.events = now_s, _DayATurn(), _DayATurn()


def expire(connection: apsw.Connection, retention: Retention, allowance: Allowance, boot: str, now_s: float) -> int:
    """Delete some of what is too old or too much, in one transaction. Returns how many blobs went.

    `now_s`: monotonic, of this boot. Space is used again by what comes; what is much more is given back to the disk.
    """
    allowance.look(now_s)
    ends = ends_of_boots(connection, boot, now_s)
    oldest = _oldest(connection, "blob", "end_s", BLOBS_AT_ONCE)
    blobs = _too_old(oldest, ends, retention.telemetry_s, allowance.telemetry)
    events = _too_old(
        _oldest(connection, "event", "time_s", EVENTS_AT_ONCE), ends, retention.events_s, allowance.events
    )
    if (used := used_bytes(connection)) > (most := retention.most_bytes):
        much = _too_many(connection, used - most, EVENTS_SHARE * most if oldest else 0.0)
        events = much or events
        blobs = blobs if blobs or much else [blob for blob, _, _ in oldest]
    if blobs or events:
        with connection:
            delete_blobs(connection, blobs)
            connection.executemany("DELETE FROM event WHERE id = ?", [(event,) for event in events])
    _give_back(connection)
    return len(blobs)


def _oldest(connection: apsw.Connection, table: str, time: str, most: int) -> Sequence[tuple[int, str, float]]:
    """In the order in which they were stored: number, boot, and when it ended."""
    rows = connection.execute(
        f"SELECT {table}.id, boot, {time} FROM {table} JOIN run ON run.id = {table}.run ORDER BY {table}.id LIMIT ?",
        (most,),
    ).fetchall()
    return cast("list[tuple[int, str, float]]", rows)


def _too_old(
    oldest: Sequence[tuple[int, str, float]], ends: Mapping[str, float], keep_s: float, turn: _DayATurn
) -> list[int]:
    """The first ones of them."""
    found: list[int] = []
    for number, boot, time_s in oldest:
        if boot not in ends or ends[boot] - time_s <= keep_s or not turn.allows(boot, time_s):
            break
        found.append(number)
    return found


def _too_many(connection: apsw.Connection, over_bytes: int, share_bytes: float) -> Sequence[int]:
    """The oldest events that take `over_bytes`, as far as all of them take more than `share_bytes`; not all at once.

    Some are weighed for all, evenly spread. As only the oldest go, their numbers have no gaps.
    """
    first, last = cast("tuple[int | None, int | None]", connection.execute("SELECT min(id), max(id) FROM event").get)
    if first is None or last is None:
        return ()
    count = last - first + 1
    some = json.dumps([*range(first, last + 1, -(-count // WEIGHED))])
    mean_bytes = ROW_BYTES + connection.execute(f"SELECT avg({_SIZE}) FROM event WHERE id IN ({_THESE})", (some,)).get
    beyond = ceil(min(float(over_bytes), count * mean_bytes - share_bytes) / mean_bytes)
    return range(first, first + min(max(beyond, 0), count, MUCH_AT_ONCE))


def _give_back(connection: apsw.Connection) -> None:
    spare = max(SPARE_PAGES, connection.pragma("page_count") // 20)
    free = connection.pragma("freelist_count")
    if free > spare:
        connection.execute(f"PRAGMA incremental_vacuum({min(free - spare, PAGES_AT_ONCE)})").fetchall()


def used_bytes(connection: apsw.Connection) -> int:
    """Of the file, without pages that are free for what comes."""
    return connection.pragma("page_size") * (connection.pragma("page_count") - connection.pragma("freelist_count"))
