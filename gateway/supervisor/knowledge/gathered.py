"""What is known of a line, as documents made of its own file, stores and records: tier 3 of the agents' knowledge.

The same stores give the same documents, whoever asks, with a gateway running or without. They are bounded over years
of operation: of each kind the newest, and what was archived; what is left out is said. Nothing is written.
"""

import hashlib
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TypeVar

from pydantic import ValidationError

from gateway.core.controller import Controller
from gateway.core.line import Line
from gateway.core.line_problem import printable
from gateway.core.line_queries import Generated
from gateway.core.proposal import Proposal
from gateway.core.verdict import Verdict
from gateway.supervisor import audit_file, baselines, configurations, models
from gateway.supervisor.audit_file import AuditFile, AuditUnavailable
from gateway.supervisor.baselines import BaselinesError, Measurement, open_baselines
from gateway.supervisor.configurations import Archived, ConfigurationsError, open_configurations
from gateway.supervisor.knowledge.of_changes import REFUSED, Change, of_change, teaches
from gateway.supervisor.knowledge.of_line import of_line
from gateway.supervisor.knowledge.of_measurements import ControlNow, of_archive, of_control, of_measurement, of_recent
from gateway.supervisor.knowledge.of_models import of_model
from gateway.supervisor.lifecycle import Book, Entry
from gateway.supervisor.model_store import ModelsError
from gateway.supervisor.models import open_repository

#: Of each kind; further ones are left out, the oldest first.
MOST_MODELS, MOST_DEPLOYMENTS, MOST_REFUSALS, MOST_EXPERIMENTS, MOST_MEASUREMENTS = 20, 40, 40, 20, 40
MOST_ARCHIVED = 40
MOST_WHY = 300  #: letters of why something is left out
_FILES = (audit_file.FILE_NAME, baselines.FILE_NAME, configurations.FILE_NAME, models.FILE_NAME)
_ERRORS = (AuditUnavailable, BaselinesError, ConfigurationsError, ModelsError)
_T = TypeVar("_T")
_M = TypeVar("_M")


@dataclass(frozen=True)
class BookNow:
    """What of a book is looked at, so that it may be handed to another thread."""

    entries: tuple[Entry, ...] = ()  #: the oldest first
    in_service: str | None = None
    last_known_good: str | None = None
    epoch: int = 0
    model: str | None = None
    changed_s: float | None = None


def now_of(book: Book) -> BookNow:
    return BookNow(
        tuple(book.entries.values()), book.in_service, book.last_known_good, book.epoch, book.model, book.changed_s
    )


@dataclass(frozen=True)
class Known:
    documents: list[Generated]
    left_out: list[str]  #: in words
    revision: str  #: SHA-256 of all of it


class LineKnowledge:
    """Of the stores in `folder`, which need not be there. What has not changed is not made again. It blocks."""

    def __init__(self, line: Line, folder: Path) -> None:
        self._line = line
        self._folder = folder
        self._known: tuple[object, Known] | None = None  #: with what it was made of
        self._made: dict[object, Generated | None] = {}  #: of what happened, by all that it was made of

    def told(self, now: BookNow) -> Known:
        """Raises nothing: what cannot be read is left out, with the reason."""
        made_of = (now, [_stamp(self._folder / name) for name in _FILES])
        if self._known is None or self._known[0] != made_of:
            self._known = made_of, self._gathered(now)
        return self._known[1]

    def _gathered(self, now: BookNow) -> Known:
        left_out: list[str] = []
        measured = self._from("measurements", self._measurements, [], left_out)
        archived = self._from("archived configurations", self._archives, [], left_out)
        control = self._from("what is in service", lambda: self._control(now), of_control(_bare(now)), left_out)
        measured = _newest(measured, MOST_MEASUREMENTS, "measurements", left_out)
        archives = _newest(archived, MOST_ARCHIVED, "archived configurations", left_out)
        happened = [
            *self._from("models", lambda: self._models(now, left_out), [], left_out),
            *self._from("proposals", lambda: self._changes(now, measured, archived, left_out), [], left_out),
            *_each("measurement", measured, lambda one: str(one.number), of_measurement, left_out),
            *_each("archived configuration", archives, lambda one: one[1].name, lambda one: of_archive(*one), left_out),
        ]
        of_file = self._from("the line's file", lambda: of_line(self._line), [], left_out)
        recent = self._from("what happened last", lambda: [of_recent(happened)], [], left_out)
        told = [*of_file, control, *recent, *happened]
        return Known(told, left_out, _revision(told, left_out))

    def _from(self, what: str, read: Callable[[], _T], otherwise: _T, left_out: list[str]) -> _T:
        try:
            return read()
        except Exception as error:  # of a store, or of what is in it: the rest is told
            left_out.append(f"{what}: {_why(error)}")
            return otherwise

    def _measurements(self) -> list[Measurement]:
        if not (path := self._folder / baselines.FILE_NAME).exists():
            return []
        with open_baselines(path) as database:
            return database.measurements(self._line.site, self._line.line)

    def _archives(self) -> list[tuple[str, Archived]]:
        """Of each name the one that it stands for."""
        if not (path := self._folder / configurations.FILE_NAME).exists():
            return []
        with open_configurations(path) as database:
            given = database.archives(self._line.site, self._line.line)
        last = {one.name: (id_, one) for id_, one in given}
        return sorted(last.values(), key=lambda pair: pair[1].number)

    def _control(self, now: BookNow) -> Generated:
        controller = None if now.in_service is None else self._controllers({now.in_service}).get(now.in_service)
        version = None
        if now.model is not None and (path := self._folder / models.FILE_NAME).exists():
            with open_repository(path) as database:
                stored = database.get(now.model)
                version = None if stored is None else stored.version
        return of_control(
            ControlNow(
                now.in_service, now.last_known_good, now.epoch, now.model, version, now.changed_s, controller
            )
        )  # fmt: skip

    def _models(self, now: BookNow, left_out: list[str]) -> list[Generated]:
        if not (path := self._folder / models.FILE_NAME).exists():
            return []
        with open_repository(path) as database:
            stored = database.entries(self._line.site, self._line.line)
        accepted = [one for one in stored if any(mark.state == "accepted" for mark in one.marks)]
        left_out += [f"model version {one.version}: {one.damage}" for one in accepted if one.model is None]
        sound = [(one, one.model) for one in accepted if one.model is not None]
        befores = [None, *(model for _, model in sound)]
        pairs = _newest(list(zip(sound, befores, strict=False)), MOST_MODELS, "models", left_out)
        return _each(
            "model version", pairs, lambda pair: str(pair[0][0].version),
            lambda pair: of_model(*pair[0], pair[1], pair[0][0].id == now.model), left_out,
        )  # fmt: skip

    def _changes(
        self, now: BookNow, measured: Sequence[Measurement], archived: Sequence[tuple[str, Archived]],
        left_out: list[str],
    ) -> list[Generated]:  # fmt: skip
        entries = _worth_telling(now.entries, {id_ for id_, _ in archived}, left_out)
        of: dict[str, list[Measurement]] = {}
        for one in measured:
            of.setdefault(one.run.configuration, []).append(one)
        keys = {entry: (entry, tuple(one.number for one in of.get(entry.changes, ()))) for entry in entries}
        self._make([entry for entry in entries if keys[entry] not in self._made], keys, of, left_out)
        self._made = {key: self._made[key] for key in keys.values() if key in self._made}
        return [one for one in self._made.values() if one is not None]

    def _make(
        self, entries: Sequence[Entry], keys: Mapping[Entry, object], of: dict[str, list[Measurement]],
        left_out: list[str],
    ) -> None:  # fmt: skip
        if not entries:
            return
        bases = {entry.base for entry in entries if entry.kind == "gains"}
        befores = self._from("what was in service before", lambda: self._controllers(bases), {}, left_out)
        with AuditFile(self._folder) as audit:
            for entry in entries:
                try:
                    proposal = Proposal.model_validate_json(_kept(audit, entry.proposal))
                    verdict = entry.verdict and Verdict.model_validate_json(_kept(audit, entry.verdict))
                except ValidationError:
                    left_out.append(f"proposal {entry.proposal[:12]}: this version cannot read what was recorded of it")
                    continue
                except KeyError:
                    left_out.append(f"proposal {entry.proposal[:12]}: the audit has lost it")
                    continue
                change = Change(entry, proposal, verdict or None, befores.get(entry.base), of.get(entry.changes, ()))
                for made in _each("proposal", [change], lambda one: one.entry.proposal[:12], of_change, left_out):
                    self._made[keys[entry]] = made

    def _controllers(self, ids: Iterable[str]) -> dict[str, Controller]:
        """Those that are stored and sound."""
        if not (path := self._folder / configurations.FILE_NAME).exists():
            return {}
        with open_configurations(path) as database:
            found = [database.get(self._line.site, self._line.line, id_) for id_ in ids]
        return {one.id: one.controller for one in found if one is not None and one.controller is not None}


def _worth_telling(entries: Iterable[Entry], archived: set[str], left_out: list[str]) -> list[Entry]:
    """Of each kind the newest, and of deployments those that are archived as well; the oldest first."""
    told = [entry for entry in entries if teaches(entry)]
    refused = [entry for entry in told if entry.stage in REFUSED]
    on_line = [entry for entry in told if entry.stage not in REFUSED]
    deployed = [entry for entry in on_line if entry.kind == "gains"]
    proven = [entry for entry in deployed if entry.changes in archived][-MOST_ARCHIVED:]
    others = [entry for entry in deployed if entry not in proven]
    kept = {
        *proven,
        *_newest(others, MOST_DEPLOYMENTS, "deployments that are not archived", left_out),
        *_newest(refused, MOST_REFUSALS, "refusals", left_out),
        *_newest([entry for entry in on_line if entry.kind == "experiment"], MOST_EXPERIMENTS, "experiments", left_out),
    }
    return [entry for entry in told if entry in kept]


def _newest(given: Sequence[_T], most: int, what: str, left_out: list[str]) -> list[_T]:
    if len(given) > most:
        left_out.append(f"the {len(given) - most} oldest {what} of {len(given)}")
    return list(given[-most:])


def _each(
    what: str, given: Iterable[_T], name: Callable[[_T], str], make: Callable[[_T], _M], left_out: list[str]
) -> list[_M]:  # fmt: skip
    """A document of each. One that cannot be made is left out, and the rest is told."""
    told: list[_M] = []
    for one in given:
        try:
            told.append(make(one))
        except Exception as error:  # whatever stands in a record that others have written
            left_out.append(f"{what} {name(one)}: {_why(error)}")
    return told


def _why(error: Exception) -> str:
    said = str(error) if isinstance(error, _ERRORS) else f"{type(error).__name__}: {error}"
    return printable(said)[:MOST_WHY]


def _bare(now: BookNow) -> ControlNow:
    return ControlNow(now.in_service, now.last_known_good, now.epoch, now.model, since_s=now.changed_s)


def _kept(audit: AuditFile, id_: str) -> bytes:
    """Raises KeyError where it is no longer what was stored, and AuditUnavailable."""
    if (content := audit.blob(id_)) is None:
        raise KeyError(id_)
    return content


def _stamp(path: Path) -> tuple[int, int] | None:
    """Of a file that has not changed the same as before; None: it is not there."""
    try:
        found = path.stat()
    except OSError:
        return None
    return found.st_size, found.st_mtime_ns


def _revision(documents: Iterable[Generated], left_out: Iterable[str]) -> str:
    said = "\0".join([*(one.model_dump_json() for one in documents), *left_out])
    return hashlib.sha256(said.encode()).hexdigest()
