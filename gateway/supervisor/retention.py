"""How long telemetry and events are kept, and how large the history may become: the oldest goes first."""

from dataclasses import dataclass

import apsw

from gateway.core.line import History
from gateway.supervisor.store import delete_blobs

DAY_S = 86_400.0
BLOBS_AT_ONCE = 30  #: five minutes of history a turn, every ten seconds: it catches up, and no turn takes long
EVENTS_AT_ONCE = 1000
PAGES_AT_ONCE = 2000  #: given back to the disk


@dataclass(frozen=True, slots=True)
class Retention:
    telemetry_s: float
    events_s: float
    most_bytes: int


def retention_of(history: History) -> Retention:
    return Retention(history.keep_days * DAY_S, history.keep_events_days * DAY_S, round(history.keep_gb * 1e9))


def expire(connection: apsw.Connection, retention: Retention, wall_s: float) -> int:
    """Delete some of what is too old or too much, in one transaction. Returns how many blobs went.

    Space is used again by what comes; what is more than that is given back to the disk.
    """
    old: list[int] = []
    with connection:
        old = _oldest(connection, retention, wall_s)
        delete_blobs(connection, old)
        connection.execute(
            "DELETE FROM event WHERE id IN (SELECT id FROM event WHERE wall_s < ? ORDER BY id LIMIT ?)",
            (wall_s - retention.events_s, EVENTS_AT_ONCE),
        )
    connection.execute(f"PRAGMA incremental_vacuum({PAGES_AT_ONCE})").fetchall()
    return len(old)


def _oldest(connection: apsw.Connection, retention: Retention, wall_s: float) -> list[int]:
    """Blobs that go now."""
    rows = connection.execute(
        "SELECT id FROM blob WHERE end_s + wall_ahead_s < ? ORDER BY id LIMIT ?",
        (wall_s - retention.telemetry_s, BLOBS_AT_ONCE),
    ).fetchall()
    if not rows and used_bytes(connection) > retention.most_bytes:
        rows = connection.execute("SELECT id FROM blob ORDER BY id LIMIT ?", (BLOBS_AT_ONCE,)).fetchall()
    return [int(str(blob_id)) for (blob_id,) in rows]


def used_bytes(connection: apsw.Connection) -> int:
    """Of the file, without pages that are free for what comes."""
    return connection.pragma("page_size") * (connection.pragma("page_count") - connection.pragma("freelist_count"))
