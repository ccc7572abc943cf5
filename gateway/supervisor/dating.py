"""When the rows of a history were: of each boot of the machine how long it ran, and what its wall clock was ahead once
it was seen to agree with the monotonic one.

A boot has one such number: the last that agreed. A computer that starts in 1970 and is then told the time dates what it
has stored since its start by that; so does one whose time server was wrong for an hour, once it is right again.
"""

from collections.abc import Mapping

import apsw

from gateway.core.steady_clock import AGREES_AFTER_S, EARLIEST_WALL_S, JUMP_S

REDATED_AT_ONCE = 20_000  #: rows

#: Later than schema 1; of boots that older programs have stored, what their blobs say.
TABLE = f"""
CREATE TABLE IF NOT EXISTS boot_clock (
    number INTEGER PRIMARY KEY,     -- in the order of the boots
    boot TEXT UNIQUE NOT NULL,
    seen_s REAL NOT NULL,           -- monotonic: it ran until then, and perhaps longer
    agreed_ahead_s REAL             -- Unix time minus monotonic time, once seen to agree
);
INSERT OR IGNORE INTO boot_clock (boot, seen_s, agreed_ahead_s)
SELECT boot, max(end_s), CASE
    WHEN max(blob.wall_ahead_s) - min(blob.wall_ahead_s) <= {JUMP_S} AND max(end_s) - min(start_s) >= {AGREES_AFTER_S}
        AND min(start_s + blob.wall_ahead_s) >= {EARLIEST_WALL_S} THEN avg(blob.wall_ahead_s) END
FROM blob JOIN run ON run.id = blob.run
WHERE EXISTS (SELECT 1 FROM run WHERE boot NOT IN (SELECT boot FROM boot_clock))
GROUP BY boot ORDER BY min(run.id);
"""


def note_seen(connection: apsw.Connection, boot: str, seen_s: float) -> None:
    """This boot runs still at `seen_s`, monotonic."""
    connection.execute(
        "INSERT INTO boot_clock (boot, seen_s) VALUES (?1, ?2) ON CONFLICT (boot) DO UPDATE SET seen_s = ?2",
        (boot, seen_s),
    )


def note_agreed(connection: apsw.Connection, boot: str, ahead_s: float) -> None:
    """The wall clock of this boot has been seen to agree."""
    connection.execute("UPDATE boot_clock SET agreed_ahead_s = ? WHERE boot = ?", (ahead_s, boot))


def agreed_ahead(connection: apsw.Connection) -> dict[str, float]:
    """By boot, Unix time minus monotonic time, where a clock was seen to agree; nothing in a file of older programs."""
    if not connection.execute("SELECT count(*) FROM sqlite_schema WHERE name = 'boot_clock'").get:
        return {}
    rows = connection.execute("SELECT boot, agreed_ahead_s FROM boot_clock WHERE agreed_ahead_s IS NOT NULL")
    return {str(boot): float(str(ahead_s)) for boot, ahead_s in rows.fetchall()}


def redate(connection: apsw.Connection, boot: str, ahead_s: float) -> bool:
    """Date some of what this boot has stored under a clock that stood elsewhere. Returns whether there is more."""
    runs = "run IN (SELECT id FROM run WHERE boot = ?1)"
    values = (boot, ahead_s, JUMP_S, REDATED_AT_ONCE)
    connection.execute(
        f"UPDATE blob SET wall_ahead_s = ?2 WHERE id IN (SELECT id FROM blob WHERE {runs}"
        " AND abs(wall_ahead_s - ?2) > ?3 LIMIT ?4)",
        values,
    )
    changed = connection.changes()
    connection.execute(
        f"UPDATE event SET wall_s = time_s + ?2 WHERE id IN (SELECT id FROM event WHERE {runs}"
        " AND abs(wall_s - time_s - ?2) > ?3 LIMIT ?4)",
        values,
    )
    return max(changed, connection.changes()) == REDATED_AT_ONCE


def ends_of_boots(connection: apsw.Connection, boot: str, now_s: float) -> Mapping[str, float]:
    """By boot, on that boot's monotonic clock, where now would be at the latest known: it minus a time is an age.

    `now_s`: of this boot. Ages are the least that they may be: between two boots the machine may have been off for no
    time at all, unless both wall clocks were seen to agree. A boot that is not in it is not known.
    """
    rows = connection.execute("SELECT boot, seen_s, agreed_ahead_s FROM boot_clock ORDER BY number DESC").fetchall()
    ends, ahead_s, up_s = dict[str, float](), None, None
    for other, seen_s, agreed_s in rows:
        if other == boot:
            ends[boot], ahead_s, up_s = now_s, agreed_s, now_s
        elif up_s is not None:
            end_s = float(str(seen_s)) + up_s
            up_s = end_s
            if ahead_s is not None and agreed_s is not None:
                end_s = max(end_s, now_s + float(str(ahead_s)) - float(str(agreed_s)))
            ends[str(other)] = end_s
    return ends
