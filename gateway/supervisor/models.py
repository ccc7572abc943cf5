"""The System Model Repository: every model of a line that was ever made, each known by the hash of its content.

Models are added, never changed or deleted; each has a version, 1, 2, 3 ... of its line, and marks say what became of
it. Any number of processes may read, and add, at the same time. The caller gives the time.
"""

from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Literal, NamedTuple

import apsw

from gateway.core.canonical import known_hashes
from gateway.core.line_model import LineModel, ModelRefused, canonical, model_hash, parse_model
from gateway.storage.sqlite_file import snapshot, told, transaction
from gateway.supervisor.find_version import find_version
from gateway.supervisor.model_store import KIND, ModelsError, begin_models, open_models

FILE_NAME = "models.sqlite"

State = Literal["accepted", "superseded", "rejected"]


class Mark(NamedTuple):
    state: State
    time_s: float  #: Unix time
    reason: str


@dataclass(frozen=True)
class Entry:
    """A stored model."""

    id: str
    site: str
    line: str
    version: int
    stored_s: float  #: Unix time
    model: LineModel | None  #: None: it is damaged
    damage: str  #: what is wrong with it; "": nothing
    marks: tuple[Mark, ...] = ()  #: the newest last

    @property
    def state(self) -> State | None:
        """None: nobody has said anything of it."""
        return self.marks[-1].state if self.marks else None


class _Row(NamedTuple):
    id: str
    site: str
    line: str
    version: int
    stored_s: float
    content: bytes


def open_repository(path: Path) -> "Models":
    """The repository that is there. Raises ModelsError."""
    return Models(path, open_models(path))


def begin_repository(path: Path) -> "Models":
    """The repository that is there, or a new one. Raises ModelsError."""
    return Models(path, begin_models(path))


class Models:
    """`close` it, or use it as a context manager. Every method raises ModelsError."""

    def __init__(self, path: Path, connection: apsw.Connection) -> None:
        self.path = path
        self._connection = connection

    def __enter__(self) -> "Models":
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        self._connection.close()

    def store(self, model: LineModel, stored_s: float) -> Entry:
        """Add a model as the next version of its line. One that is there already stays as it is, and is returned."""
        id_, run = model_hash(model), self._connection.execute
        with told(self.path, KIND), transaction(self._connection):
            if not run("SELECT 1 FROM model WHERE id = ?", (id_,)).get:
                last = run("SELECT max(version) FROM model WHERE site = ? AND line = ?", (model.site, model.line)).get
                run(
                    "INSERT INTO model (id, site, line, version, stored_s, content) VALUES (?, ?, ?, ?, ?, ?)",
                    (id_, model.site, model.line, (last or 0) + 1, stored_s, canonical(model)),
                )
        return self._entries("id = ?", (id_,))[0]

    def mark(self, id_: str, state: State, time_s: float, reason: str) -> None:
        """Say what has become of a stored model. Earlier marks stay."""
        run = self._connection.execute
        with told(self.path, KIND), transaction(self._connection):
            if not run("SELECT 1 FROM model WHERE id = ?", (id_,)).get:
                raise ModelsError(f"{self.path} has no model {id_[:12]}: nothing was marked")
            run("INSERT INTO mark (model, state, time_s, reason) VALUES (?, ?, ?, ?)", (id_, state, time_s, reason))

    def entries(self, site: str | None = None, line: str | None = None) -> list[Entry]:
        """The models of a line, or of all; by line, in the order of their versions."""
        return self._entries("site = coalesce(?, site) AND line = coalesce(?, line)", (site, line))

    def get(self, id_: str) -> Entry | None:
        """By its whole id; None: it was never stored."""
        found = self._entries("id = ?", (id_,))
        return found[0] if found else None

    def find(self, wanted: str, site: str | None = None, line: str | None = None) -> Entry:
        """The one that a person means: "newest", a version ("3" or "v3"), or the beginning of an id."""
        found = self.entries(site, line)
        if not found:
            raise ModelsError(f"{self.path} has no model{f' of {site}/{line}' if site else ''} yet")
        return find_version(wanted, found, "model", self.path, ModelsError)

    def ancestors(self, entry: Entry) -> list[Entry]:
        """The models that were the prior of one another, the nearest first, as far as they lie here."""
        by_id = {one.id: one for one in self.entries()}
        found: list[Entry] = []
        while entry.model is not None and entry.model.parent in by_id:
            entry = by_id[entry.model.parent]
            found.append(entry)  # none is its own ancestor: its hash covers its parent's
        return found

    def _entries(self, where: str, values: Iterable[str | None]) -> list[Entry]:
        run = self._connection.execute
        with told(self.path, KIND), snapshot(self._connection):
            rows = run(
                f"SELECT id, site, line, version, stored_s, content FROM model WHERE {where}"
                " ORDER BY site, line, version",
                tuple(values),
            )
            stored = [_Row(*row) for row in rows]
            marks = list(run("SELECT model, state, time_s, reason FROM mark ORDER BY id"))
        return [_entry(row, tuple(Mark(*mark) for id_, *mark in marks if id_ == row.id)) for row in stored]


def _entry(row: _Row, marks: tuple[Mark, ...]) -> Entry:
    try:
        model, damage = parse_model(row.content), ""
        if row.id not in known_hashes(model) or (model.site, model.line) != (row.site, row.line):
            model, damage = None, "its content is not what was stored"
    except ModelRefused as refused:
        model, damage = None, f"its content cannot be read: {refused}"
    return Entry(row.id, row.site, row.line, row.version, row.stored_s, model, damage, marks)
