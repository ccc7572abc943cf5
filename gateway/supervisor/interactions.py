"""The Diagnostic History Log's part of the agents: every question that was put to one, and all that came of it.

One SQLite file beside the history. Of each agent the oldest go once it has its share: who talks without end fills no
disk, and drives out nobody's but its own.
"""

from collections.abc import Iterator, Sequence
from contextlib import closing, contextmanager
from dataclasses import dataclass
from pathlib import Path

import apsw

from gateway.core.interactions import Interaction, InteractionRefused, unpack
from gateway.storage.sqlite_file import FileKind, begin, open_there, rows_of, told, transaction

FILE_NAME = "interactions.sqlite"
APPLICATION_ID = 0x5232494E  # "R2IN"
MOST_BYTES = 128 * 2**20  #: of all that is kept of one agent
_SCHEMA_1 = f"""
CREATE TABLE interaction (
    number INTEGER PRIMARY KEY AUTOINCREMENT,
    id TEXT UNIQUE NOT NULL,
    agent TEXT NOT NULL,
    at TEXT NOT NULL,               -- ISO 8601, as the agent says
    decision TEXT NOT NULL,
    chosen TEXT NOT NULL,           -- the option
    decided_by TEXT NOT NULL,
    instead TEXT NOT NULL,          -- why the rules have decided; empty: nobody else was asked, or it answered
    bytes INTEGER NOT NULL,
    content BLOB NOT NULL           -- see gateway/core/interactions.py
);
PRAGMA application_id = {APPLICATION_ID};
"""


class InteractionsError(Exception):
    """The log cannot do what was asked; the text says why and what to do."""


KIND = FileKind(
    "interaction log",
    APPLICATION_ID,
    {0: _SCHEMA_1},
    InteractionsError,
    absent="no agent has been asked anything yet: there is no {path}",
    damaged="It was left as it is; move it away, and a new one is begun",
)


@dataclass(frozen=True)
class Row:
    number: int
    id: str
    agent: str
    at: str
    decision: str
    chosen: str
    decided_by: str
    instead: str


class Interactions:
    """The file of a folder, which may not be there yet. Raises InteractionsError."""

    def __init__(self, folder: Path) -> None:
        self.path = folder / FILE_NAME

    def keep(self, packed: bytes, one: Interaction) -> int:
        """Its number. What is kept already is kept once; something else under its id is refused."""
        with self._begun() as connection, transaction(connection):
            short = one.in_short
            connection.execute(
                "INSERT INTO interaction (id, agent, at, decision, chosen, decided_by, instead, bytes, content)"
                " VALUES (?, ?, ?, ?, ?, ?, ?, ?, ?) ON CONFLICT (id) DO NOTHING",
                (one.id, one.agent, one.at, *short, len(packed), packed),
            )
            connection.execute(
                "DELETE FROM interaction WHERE agent = ?1 AND number <= (SELECT max(number) FROM (SELECT number,"
                " sum(bytes) OVER (ORDER BY number DESC) AS until FROM interaction WHERE agent = ?1) WHERE until > ?2)",
                (one.agent, MOST_BYTES),
            )
            ((number, content),) = rows_of(
                connection, "SELECT number, content FROM interaction WHERE id = ?", (one.id,)
            )
            if content != packed:
                raise InteractionsError(f"{one.id} is another interaction already")
            return int(number)

    def newest(self, most: int, agent: str | None = None) -> list[Row]:
        """The newest first."""
        with self._there() as connection:
            rows = rows_of(
                connection,
                "SELECT number, id, agent, at, decision, chosen, decided_by, instead FROM interaction"
                " WHERE ?1 IS NULL OR agent = ?1 ORDER BY number DESC LIMIT ?2",
                (agent, most),
            )
        return [Row(*row) for row in rows]

    def find(self, id_: str) -> Interaction:
        """By its whole id, else by its number, else by the beginning of its id.

        Raises InteractionsError where none or several fit.
        """
        with self._there() as connection:
            found = rows_of(
                connection,
                "SELECT id, content, CAST(number AS TEXT) FROM interaction"
                " WHERE substr(id, 1, length(?1)) = ?1 OR CAST(number AS TEXT) = ?1"
                " ORDER BY id = ?1 DESC, CAST(number AS TEXT) = ?1 DESC LIMIT 3",
                (id_,),
            )
        exact = [one for one in found if one[0] == id_] or [one for one in found if one[2] == id_] or found
        if len(exact) != 1:
            what = "is the beginning of several: name more of it" if exact else "is in the log nowhere"
            raise InteractionsError(f"{id_} {what}; `r2rgate log` lists them")
        return _unpacked(id_, exact[0][1])

    def several(self, ids: Sequence[str]) -> dict[str, Interaction]:
        """Those that are there, by whole id. Raises InteractionsError."""
        marks = ", ".join("?" * len(ids))
        with self._there() as connection:
            rows = rows_of(connection, f"SELECT id, content FROM interaction WHERE id IN ({marks})", tuple(ids))
        return {id_: _unpacked(id_, content) for id_, content in rows}

    @contextmanager
    def _begun(self) -> Iterator[apsw.Connection]:
        with told(self.path, KIND), closing(begin(self.path, KIND)) as connection:
            yield connection

    @contextmanager
    def _there(self) -> Iterator[apsw.Connection]:
        with told(self.path, KIND), closing(open_there(self.path, KIND)) as connection:
            yield connection


def _unpacked(id_: str, content: bytes) -> Interaction:
    """Raises InteractionsError."""
    try:
        return unpack(content)
    except InteractionRefused as refused:
        raise InteractionsError(f"{id_} is damaged in the log: {refused}") from refused
