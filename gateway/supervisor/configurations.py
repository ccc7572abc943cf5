"""The Controller Configuration Storage: every controller that was ever stored for a line, known by its hash.

A configuration is stored once a line, as version 1, 2, 3 ...; each time that it is put forward, its origin is added:
who, when, why, from which configuration, on which model, by which verdict. A person archives what has proven itself
under a name (the paper's phi_stable is such a name; the newest of a name counts). Nothing is changed or deleted. Any
number of processes may read and add at the same time. The caller gives the time.
"""

import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import apsw

from gateway.core.canonical import known_hashes
from gateway.core.controller import Controller, ControllerRefused, canonical, config_hash, parse_controller
from gateway.storage.sqlite_file import FileKind, begin, open_there, rows_of, snapshot, told, transaction
from gateway.supervisor.find_version import find_version

FILE_NAME = "configurations.sqlite"
STABLE = "phi_stable"  #: the name of what held in stable operation
APPLICATION_ID = 0x52324346  # "R2CF"

_SCHEMA_1 = f"""
CREATE TABLE configuration (
    site TEXT NOT NULL,
    line TEXT NOT NULL,
    id TEXT NOT NULL,               -- SHA-256 of the content, in hexadecimal
    version INTEGER NOT NULL,       -- of its line, from 1
    content BLOB NOT NULL,          -- canonical JSON; see gateway/core/controller.py
    PRIMARY KEY (site, line, id),
    UNIQUE (site, line, version)
);
CREATE TABLE origin (
    number INTEGER PRIMARY KEY,
    site TEXT NOT NULL,
    line TEXT NOT NULL,
    id TEXT NOT NULL,
    time_s REAL NOT NULL,           -- Unix time
    who TEXT NOT NULL,
    why TEXT NOT NULL,
    parent TEXT,                    -- configuration that it was made from
    model TEXT,                     -- model that it was designed on
    verdict TEXT,                   -- hash of the verdict that let it through
    FOREIGN KEY (site, line, id) REFERENCES configuration
);
CREATE TABLE archive (
    number INTEGER PRIMARY KEY,     -- the last of a name is the one it stands for
    site TEXT NOT NULL,
    line TEXT NOT NULL,
    id TEXT NOT NULL,
    name TEXT NOT NULL,
    time_s REAL NOT NULL,           -- Unix time
    who TEXT NOT NULL,
    why TEXT NOT NULL,
    FOREIGN KEY (site, line, id) REFERENCES configuration
);
{
    "".join(
        f"CREATE TRIGGER {table}_stays BEFORE UPDATE ON {table} BEGIN SELECT RAISE(ABORT, 'it never changes'); END;"
        f"CREATE TRIGGER {table}_is_kept BEFORE DELETE ON {table} BEGIN SELECT RAISE(ABORT, 'it is kept'); END;"
        for table in ("configuration", "origin", "archive")
    )
}
PRAGMA application_id = {APPLICATION_ID};
"""

_Key = tuple[str, str, str]  #: site, line, id
_NAME = re.compile(r"[A-Za-z][A-Za-z0-9_-]{0,39}")

#: From version k (the key) to version k + 1. Every version that was ever released stays here.
MIGRATIONS: dict[int, str] = {0: _SCHEMA_1}


class ConfigurationsError(Exception):
    """The storage cannot do what was asked; the text says why and what to do."""


KIND = FileKind(
    "controller configuration storage",
    APPLICATION_ID,
    MIGRATIONS,
    ConfigurationsError,
    absent="there are no configurations at {path}: the gateway stores each that is put into service",
    damaged="It was left as it is; restore it from a copy, or move it away",
)


class Origin(NamedTuple):
    """Why a configuration was put forward."""

    time_s: float  #: Unix time
    who: str
    why: str
    parent: str | None = None  #: id of the configuration that it was made from
    model: str | None = None  #: id of the model that it was designed on
    verdict: str | None = None  #: SHA-256 of the verdict that let it through


class Archived(NamedTuple):
    """That a configuration was archived."""

    number: int  #: of this storage, in the order in which it was done
    name: str
    time_s: float  #: Unix time
    who: str
    why: str


@dataclass(frozen=True)
class Configuration:
    """A stored configuration."""

    id: str
    site: str
    line: str
    version: int
    controller: Controller | None  #: None: it is damaged
    damage: str  #: what is wrong with it; "": nothing
    origins: tuple[Origin, ...] = ()  #: the newest last
    archived: tuple[Archived, ...] = ()  #: the newest last

    @property
    def names(self) -> tuple[str, ...]:
        """Under which it was archived, though a later one may have taken a name over (`named`)."""
        return tuple(dict.fromkeys(archived.name for archived in self.archived))


class Configurations:
    """`close` it, or use it as a context manager. Every method raises ConfigurationsError."""

    def __init__(self, path: Path, connection: apsw.Connection) -> None:
        self.path = path
        self._connection = connection

    def __enter__(self) -> "Configurations":
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        self._connection.close()

    def store(self, site: str, line: str, controller: Controller, origin: Origin) -> Configuration:
        """Add a configuration as the next version of its line, or another origin of one that is there."""
        id_, run = config_hash(controller), self._connection.execute
        key = (site, line, id_)
        with told(self.path, KIND), transaction(self._connection):
            if not run("SELECT 1 FROM configuration WHERE site = ? AND line = ? AND id = ?", key).get:
                last = run("SELECT max(version) FROM configuration WHERE site = ? AND line = ?", (site, line)).get
                run(
                    "INSERT INTO configuration (site, line, id, version, content) VALUES (?, ?, ?, ?, ?)",
                    (*key, (last or 0) + 1, canonical(controller)),
                )
            run(
                "INSERT INTO origin (site, line, id, time_s, who, why, parent, model, verdict)"
                " VALUES (?, ?, ?, ?, ?, ?, ?, ?, ?)",
                (*key, *origin),
            )
        return self._read("site = ? AND line = ? AND id = ?", *key)[0]

    def archive(self, site: str, line: str, id_: str, name: str, time_s: float, who: str, why: str) -> Configuration:
        """Keep a stored configuration under a name. What had the name before has it no longer, but keeps its entry."""
        key, run = (site, line, id_), self._connection.execute
        require_name(name)
        with told(self.path, KIND), transaction(self._connection):
            if not run("SELECT 1 FROM configuration WHERE site = ? AND line = ? AND id = ?", key).get:
                raise ConfigurationsError(
                    f"{self.path} has no configuration {id_[:12]} of {site}/{line}: nothing was archived"
                )
            run(
                "INSERT INTO archive (site, line, id, name, time_s, who, why) VALUES (?, ?, ?, ?, ?, ?, ?)",
                (*key, name, time_s, who, why),
            )
        return self._read("site = ? AND line = ? AND id = ?", *key)[0]

    def entries(self, site: str | None = None, line: str | None = None) -> list[Configuration]:
        """The configurations of a line, or of all; by line, in the order of their versions."""
        return self._read("site = coalesce(?, site) AND line = coalesce(?, line)", site, line)

    def find(self, wanted: str, site: str | None = None, line: str | None = None) -> Configuration:
        """The one that a person means: a name ("phi_stable"), "newest", a version ("3" or "v3"), or part of an id."""
        found = self.entries(site, line)
        if not found:
            raise ConfigurationsError(f"{self.path} has no configuration{f' of {site}/{line}' if site else ''} yet")
        names = named(found)
        holders = [one for (_, _, name), one in names.items() if name == wanted]
        if len(holders) == 1:
            return holders[0]
        if holders:
            lines = ", ".join(f"{one.site}/{one.line}" for one in holders)
            raise ConfigurationsError(f"{self.path} has a {wanted} of {lines}: name the line with --line")
        known = ", ".join(sorted({name for _, _, name in names}))
        also = f"or a name ({known})" if known else "or a name (none is archived yet)"
        return find_version(wanted, found, "configuration", self.path, ConfigurationsError, also)

    def get(self, site: str, line: str, id_: str) -> Configuration | None:
        """By its whole id; None: it was never stored for this line."""
        found = self._read("site = ? AND line = ? AND id = ?", site, line, id_)
        return found[0] if found else None

    def archives(self, site: str, line: str) -> list[tuple[str, Archived]]:
        """What was archived of a line, with the id of each, in the order in which it was done; nothing is parsed."""
        with told(self.path, KIND):
            rows = rows_of(
                self._connection,
                "SELECT id, number, name, time_s, who, why FROM archive WHERE site = ? AND line = ? ORDER BY number",
                (site, line),
            )
        return [(id_, Archived(*given)) for id_, *given in rows]

    def _read(self, where: str, *values: str | None) -> list[Configuration]:
        origins: dict[_Key, list[Origin]] = {}
        archived: dict[_Key, list[Archived]] = {}
        with told(self.path, KIND), snapshot(self._connection):
            rows = self._rows("version, content", "configuration", where, "site, line, version", values)
            of_origins = self._rows("time_s, who, why, parent, model, verdict", "origin", where, "number", values)
            of_archive = self._rows("number, name, time_s, who, why", "archive", where, "number", values)
        for site, line, id_, *given in of_origins:
            origins.setdefault((site, line, id_), []).append(Origin(*given))
        for site, line, id_, *given in of_archive:
            archived.setdefault((site, line, id_), []).append(Archived(*given))
        return [
            Configuration(
                id_, site, line, version, *_parsed(id_, content),
                tuple(origins.get((site, line, id_), ())), tuple(archived.get((site, line, id_), ())),
            )
            for site, line, id_, version, content in rows
        ]  # fmt: skip

    def _rows(self, columns: str, table: str, where: str, order: str, values: Sequence[str | None]) -> list[Any]:
        query = f"SELECT site, line, id, {columns} FROM {table} WHERE {where} ORDER BY {order}"
        return rows_of(self._connection, query, values)


def require_name(name: str) -> None:
    """Raises ConfigurationsError where nothing can be archived under it."""
    if not _NAME.fullmatch(name):
        raise ConfigurationsError(f"{name!r} is no name; allowed: a letter, then up to 39 letters, digits, _ and -")


def open_configurations(path: Path) -> Configurations:
    """The storage that is there. Raises ConfigurationsError."""
    return Configurations(path, open_there(path, KIND))


def begin_configurations(path: Path) -> Configurations:
    """The storage that is there, or a new one. Raises ConfigurationsError."""
    return Configurations(path, begin(path, KIND))


def named(found: Iterable[Configuration]) -> dict[tuple[str, str, str], Configuration]:
    """By (site, line, name) the configuration that it stands for: the one to which it was given last."""
    given = [(archived.number, archived.name, one) for one in found for archived in one.archived]
    return {(one.site, one.line, name): one for _, name, one in sorted(given, key=lambda each: each[0])}


def _parsed(id_: str, content: bytes) -> tuple[Controller | None, str]:
    """The controller, and what is wrong with it."""
    try:
        controller = parse_controller(content)
    except ControllerRefused as refused:
        return None, f"its content cannot be read: {refused}"
    if id_ not in known_hashes(controller):
        return None, "its content is not what was stored"
    return controller, ""
