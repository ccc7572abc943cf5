"""What becomes of proposals, as the audit has it: a fold over its records, and which record may come next. Pure.

A record is stored before what it announces is done. So whatever instant a process dies at, the records say what may
have been done, and the loop says what was: `Book.explains` holds the one against the other.
"""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, replace
from enum import StrEnum
from typing import Any

from gateway.core.canonical import hash_of
from gateway.core.deployment import InService, Region
from gateway.core.proposal import Kind
from gateway.core.steady_clock import Moment
from gateway.supervisor.four_eyes import APPROVED_ONCE, FirstApproval, first_of


class Stage(StrEnum):
    RECEIVED = "received"  #: it is being judged
    REFUSED = "refused"  #: by the gate
    WAITING = "waiting"  #: for a person
    REJECTED = "rejected"  #: by a person
    EXPIRED = "expired"
    SUPERSEDED = "superseded"  #: what it would have changed is no longer in service
    APPROVED = "approved"
    DEPLOYING = "deploying"  #: the loop is being told, or has been
    NOT_DEPLOYED = "not-deployed"  #: the loop did not take it
    PROBATION = "probation"
    KEEPING = "keeping"  #: the loop is being told to keep it
    KEPT = "kept"
    ROLLED_BACK = "rolled-back"
    RUNNING = "running"  #: an experiment
    DONE = "done"  #: an experiment, complete or not


UNDECIDED = (Stage.RECEIVED, Stage.WAITING, Stage.APPROVED)
MOST_CLOSED = 4096  #: proposals that are done with and never went to the line, held in memory: the last ones
ON_THE_LINE = (Stage.DEPLOYING, Stage.PROBATION, Stage.KEEPING, Stage.RUNNING)  #: one at a time

#: Kinds of records: from which stages, to which.
STEPS: dict[str, tuple[tuple[Stage, ...], Stage]] = {
    "accepted": ((Stage.RECEIVED,), Stage.WAITING),
    "refused": ((Stage.RECEIVED,), Stage.REFUSED),
    APPROVED_ONCE: ((Stage.WAITING,), Stage.WAITING),
    "approved": ((Stage.WAITING,), Stage.APPROVED),
    "approval-lapsed": ((Stage.APPROVED,), Stage.WAITING),
    "rejected": ((Stage.WAITING,), Stage.REJECTED),
    "expired": (UNDECIDED, Stage.EXPIRED),
    "superseded": (UNDECIDED, Stage.SUPERSEDED),
    "deploying": ((Stage.APPROVED,), Stage.DEPLOYING),
    "not-deployed": ((Stage.DEPLOYING,), Stage.NOT_DEPLOYED),
    "put-off": ((Stage.DEPLOYING,), Stage.WAITING),
    "deployed": ((Stage.DEPLOYING,), Stage.PROBATION),
    "keeping": ((Stage.PROBATION,), Stage.KEEPING),
    "kept": ((Stage.KEEPING,), Stage.KEPT),
    "rolled-back": ((Stage.DEPLOYING, Stage.PROBATION, Stage.KEEPING), Stage.ROLLED_BACK),
    "experiment-begins": ((Stage.APPROVED,), Stage.RUNNING),
    "experiment-ends": ((Stage.RUNNING,), Stage.DONE),
    "model-in-service": ((Stage.APPROVED,), Stage.KEPT),
}
WELL = ("kept", "model-in-service", "experiment-ends")  #: the ends of changes that went well
PERSON, SCRIPT, VERDICT = "person", "script", "verdict"  #: who approved
PROPOSED, FOUND, LINE_CHANGED, CONFIRMED = "proposed", "found-in-service", "line-changed", "confirmed"
WIRING_PROVED = "wiring-proved"  #: the kind of a record that is no step: the loop has kept a proof
OF_NO_PROPOSAL = (FOUND, LINE_CHANGED, CONFIRMED)
IN_THE_BOOK = frozenset((*STEPS, PROPOSED, *OF_NO_PROPOSAL, WIRING_PROVED))  #: kinds of records that `Book` goes by
OWN_KIND: dict[str, Kind] = {"deploying": "gains", "experiment-begins": "experiment", "model-in-service": "model"}


class Impossible(Exception):
    """A record that cannot come now; the text says why."""


@dataclass(frozen=True)
class Entry:
    """A proposal and where it stands."""

    proposal: str  #: hash
    kind: Kind  #: of its change
    author: str
    base: str  #: hash of the configuration that it would change
    changes: str  #: hash of the configuration, experiment or model that it brings
    created: str
    expires: str
    expires_s: float  #: Unix time
    stage: Stage = Stage.RECEIVED
    why: str = ""
    verdict: str | None = None  #: hash
    judged_by: str | None = None  #: hash of the model, once there is a verdict; None: by the line's file
    line: str | None = None  #: hash of the line's file by which it was judged; None: not on record
    epoch: int | None = None
    by_person: bool = False  #: approved by one, not by its verdict alone
    approval: str | None = None  #: hash of what the record of its approval says
    first: FirstApproval | None = None  #: while it waits for a second one
    since_s: float | None = None  #: Unix time at which it came to its stage
    received: Moment | None = None  #: None: its record does not say
    region: Region | None = None  #: of a configuration that has been deployed: for what it was judged
    good: str | None = None  #: of one that was kept: what was gone back to from then on
    number: int = 0  #: of proposals that were made before it


@dataclass
class Book:
    """The proposals of a line, oldest first, and what is in service as far as the records say."""

    entries: dict[str, Entry] = field(default_factory=dict[str, Entry])
    made: int = 0  #: proposals, with those that were forgotten
    forgotten: int = field(default=0, compare=False)  #: that the records alone tell of
    stay: int = field(default=0, compare=False)  #: of `entries`, that were not to be forgotten at the last look
    in_service: str | None = None
    last_known_good: str | None = None
    epoch: int = 0  #: of the last deployment that the loop has taken, or is being told of
    region: Region = Region()  #: in which the loop lets it run
    #: By configuration that was in service: as far as it went then.
    regions: dict[str, Region] = field(default_factory=dict[str, Region])
    unexplained: str | None = None  #: a configuration that was found in service, until another one is approved and kept
    #: Hashes of the proofs of the wiring that were kept, as far as records before this process tell.
    wiring_proofs: set[str] = field(default_factory=set[str], compare=False)
    confirmed: set[str] = field(default_factory=set[str])  #: configurations that a person has confirmed, unjudged
    model: str | None = None
    #: Hash of the line's file as this process has read it, which no record tells; None: nobody asks.
    line: str | None = field(default=None, compare=False)
    changed: Moment | None = None  #: when how the line is controlled has changed last
    line_changed_s: float | None = None  #: Unix time at which somebody said last that the line itself has changed
    line_changed: Moment | None = None  #: the same
    before_change: int = 0  #: proposals that there were then: they say nothing of the line as it is now
    #: By kind the proposal that a person approved last, and that went well; empty after anything was rolled back.
    trusted: dict[str, str] = field(default_factory=dict[str, str])

    @property
    def changed_s(self) -> float | None:
        """Unix time of `changed`, as the wall clock said then."""
        return None if self.changed is None else self.changed.wall_s

    @property
    def on_the_line(self) -> Entry | None:
        """What is being done to the line now."""
        return next((entry for entry in self.entries.values() if entry.stage in ON_THE_LINE), None)

    @property
    def undecided(self) -> list[Entry]:
        return [entry for entry in self.entries.values() if entry.stage in UNDECIDED]

    @property
    def is_unconfirmed(self) -> bool:
        """Whether what is in service has neither been deployed by a proposal nor been confirmed by a person."""
        here = self.in_service
        if here is None or here == self.unexplained:
            return here is not None
        judged = any(entry.changes == here and entry.region is not None for entry in self.entries.values())
        return not judged and here not in self.confirmed

    @property
    def since_change(self) -> list[Entry]:
        """Of the line as it is now."""
        return [entry for entry in self.entries.values() if entry.number >= self.before_change]

    @property
    def kept_for(self) -> dict[str, Region]:
        """Configurations kept on the line as it is now, the earliest first, as far as each was judged."""
        found: dict[str, Region] = {}
        for entry in self.since_change:
            if entry.stage is Stage.KEPT and entry.region is not None:
                before = found.get(entry.changes)
                found[entry.changes] = entry.region if before is None else before.and_also(entry.region)
        return found

    @property
    def judged_for(self) -> Region:
        """As far as the configuration in service has been judged and kept, now or before: data become too old again."""
        before = self.kept_for.get(self.in_service or "")
        return self.region if before is None else self.region.and_also(before)

    @property
    def first_as_far(self) -> tuple[str, Region] | None:
        """The earliest that was kept for all that the one in service is, which no chain of small steps moves."""
        here = self.judged_for
        return next(((one, region) for one, region in self.kept_for.items() if here.within(region)), None)

    def forget(self) -> bool:
        """Hold no more than `MOST_CLOSED` proposals, and a quarter, that are done with and never went to the line.

        Nothing here goes by those. Whoever asks for one is told from the records. False: there was nothing to forget.
        """
        if len(self.entries) - self.stay < MOST_CLOSED + MOST_CLOSED // 4:
            return False
        trusted = set(self.trusted.values())
        closed = [
            one.proposal
            for one in self.entries.values()
            if one.stage not in (*UNDECIDED, *ON_THE_LINE) and one.region is None and one.epoch is None
            and one.proposal not in trusted
        ]  # fmt: skip
        self.stay = len(self.entries) - len(closed)
        gone = closed[: max(0, len(closed) - MOST_CLOSED)]
        for one in gone:
            del self.entries[one]
        self.forgotten += len(gone)
        return bool(gone)

    def why_outdated(self, entry: Entry) -> str:
        """Why its verdict counts no more, while it waits; empty: it counts."""
        if entry.stage not in (Stage.WAITING, Stage.APPROVED):
            return ""
        if self.line is not None and entry.line != self.line:
            return "it was judged by the line's file as it was before it was changed: propose it again"
        if entry.judged_by == self.model:
            return ""
        by = "the line's file" if entry.judged_by is None else f"model {entry.judged_by[:12]}"
        now = "the line's file" if self.model is None else f"model {self.model[:12]}"
        return f"it was judged by {by}, and proposals are judged by {now} now: propose it again"

    def why_not(self, kind: str, what: Mapping[str, Any]) -> str:
        """Why a record of `kind` cannot come now; empty: it can."""
        proposal = str(what.get("proposal", ""))
        entry = self.entries.get(proposal)
        if kind == PROPOSED and entry is not None:
            return f"proposal {proposal[:12]} was made before: {entry.stage}"
        if kind == CONFIRMED and not (self.is_unconfirmed and what.get("configuration") == self.in_service):
            return "that is not what is in service, or it was judged or confirmed before: there is nothing to confirm"
        if kind == LINE_CHANGED and (other := self.on_the_line) is not None:
            return f"proposal {other.proposal[:12]} is {other.stage}: wait for its end, or roll it back"
        if kind == PROPOSED or kind in OF_NO_PROPOSAL:
            return ""
        if entry is None:
            return f"there is no proposal {proposal[:12]}"
        stages, _ = STEPS[kind]
        if entry.stage not in stages:
            return f"proposal {proposal[:12]} is {entry.stage}; {kind} comes after {' or '.join(stages)}"
        return self._why_not_carry_out(kind, entry, what) if kind in OWN_KIND else ""

    def _why_not_carry_out(self, kind: str, entry: Entry, what: Mapping[str, Any]) -> str:
        short = entry.proposal[:12]
        if OWN_KIND[kind] != entry.kind:
            return f"proposal {short} is of {entry.kind}; {kind} is for {OWN_KIND[kind]}"
        if (other := self.on_the_line) is not None:
            return f"proposal {other.proposal[:12]} is {other.stage}: one change at a time"
        if entry.base != self.in_service:
            return f"proposal {short} would change a configuration that is no longer in service"
        if kind == "deploying" and what.get("epoch") != self.epoch + 1:
            return f"epoch {what.get('epoch')} does not follow {self.epoch}"
        return ""

    def apply(self, kind: str, what: Mapping[str, Any]) -> None:
        """Take in a record that has been stored. Raises Impossible; other kinds of the audit are passed over."""
        if kind not in STEPS and kind != PROPOSED and kind not in OF_NO_PROPOSAL:
            self._note_wiring(kind, what)
            return
        if reason := self.why_not(kind, what):
            raise Impossible(reason)
        if kind == FOUND:
            self._found(what)
            return
        if kind == LINE_CHANGED:
            self._line_changed(what)
            return
        if kind == CONFIRMED:
            self.unexplained, self.regions[str(what["configuration"])] = None, self.region
            self.confirmed.add(str(what["configuration"]))
            return
        proposal = str(what["proposal"])
        if kind == PROPOSED:
            self.entries[proposal] = _proposed(what, self.made)
            self.made += 1
            return
        self.entries[proposal] = entry = _moved(self.entries[proposal], kind, what, self.model)
        self._in_service(kind, entry, what)
        self._trust(kind, entry)

    def _note_wiring(self, kind: str, what: Mapping[str, Any]) -> None:
        if kind == WIRING_PROVED and "proof" in what:  # records of an earlier version do not say which
            self.wiring_proofs.add(str(what["proof"]))

    def _trust(self, kind: str, entry: Entry) -> None:
        if kind == "rolled-back":
            self.trusted.clear()
        elif entry.by_person and kind in WELL and not (kind == "experiment-ends" and entry.why):
            self.trusted[entry.kind] = entry.proposal

    def _in_service(self, kind: str, entry: Entry, what: Mapping[str, Any]) -> None:
        if kind in ("deployed", "rolled-back") and "at_s" in what:
            self.changed = moment_of(what)
        if kind == "deploying":
            self.epoch = int(what["epoch"])
        elif kind in ("not-deployed", "put-off"):
            self.epoch = int(what["epoch"]) - 1
        elif kind == "deployed":
            self.in_service, self.region = entry.changes, entry.region or Region()
            self.regions[entry.changes] = self.region
        elif kind == "kept":
            self.last_known_good = str(what.get("last_known_good", entry.changes))
            self.entries[entry.proposal] = replace(entry, good=self.last_known_good)
            if self.last_known_good != self.unexplained:  # what is kept on top of it does not explain it
                self.unexplained = None
        elif kind == "rolled-back":
            self.in_service, self.region = str(what["to"]), _region(what)
            if not what.get("explained", True) or (self.in_service not in self.regions and self.regions):
                self.unexplained = self.in_service
        elif kind == "model-in-service":
            self.model = entry.changes

    def _found(self, what: Mapping[str, Any]) -> None:
        """The loop's own word on what controls the line."""
        if self.in_service not in (None, what["configuration"]):  # what was kept has been taken back
            self.trusted.clear()
        if not what.get("explained", True) and what.get("confined"):  # records of an earlier version confine nothing
            self.unexplained = str(what["configuration"])
        else:
            self.regions[str(what["configuration"])] = _region(what)
        self.in_service = str(what["configuration"])
        self.last_known_good = str(what["last_known_good"])
        self.epoch = int(what["epoch"])
        self.region = _region(what)

    def _line_changed(self, what: Mapping[str, Any]) -> None:
        """Nothing is believed any more, and nothing goes through that was judged by what was."""
        self.model = None
        self.trusted.clear()
        for entry in self.undecided:
            self.entries[entry.proposal] = superseded_by_change(entry, what)
        self.line_changed_s, self.line_changed, self.before_change = _at(what), moment_of(what), self.made

    def explains(self, found: InService) -> bool:
        """Whether the records say how the loop may have come to what it says of itself, in all that its proof says.

        Which configuration at which epoch, for what it was judged, and what is gone back to. What was deployed before
        the last deployment is not in service again by itself: a file of the loop that was put back would be explained
        by it.
        """
        if self.in_service is None:
            # Nothing is on record. Nor was there anything to record, where the loop has never taken a deployment.
            return found.epoch == 0 and found.hash == found.last_known_good
        # The loop has been told of these, or is about to be; whether it took them is not always on record yet.
        every = [(one, one.epoch) for one in self.entries.values() if one.epoch is not None]
        # What has lowered the epoch was unexplained itself, and makes nothing older right.
        taken = max((epoch for one, epoch in every if one.stage is not Stage.NOT_DEPLOYED), default=0)
        told = [(one, epoch) for one, epoch in every if epoch >= max(self.epoch, taken)]
        brought = [one for one, epoch in told if (one.changes, epoch) == (found.hash, found.epoch)]
        epochs = {self.epoch, *(epoch for _, epoch in told)}
        epochs |= {epoch - 1 for one, epoch in told if one.stage is Stage.DEPLOYING}
        # The one that was kept last is back where the files of the loop are put back as they were.
        good = {
            self.last_known_good,
            *(one.good for one in brought),
            *(one.changes for one, _ in told if one.stage is Stage.KEEPING),
        }
        known = bool(brought) or found.hash in {self.in_service, self.last_known_good}
        if not (known and found.epoch in epochs and found.last_known_good in good):
            return False
        judged = [self.regions.get(found.hash), *(one.region for one in brought)]
        return any(one is not None and found.region.within(one) for one in judged)


def _proposed(what: Mapping[str, Any], number: int) -> Entry:
    return Entry(
        **{key: what[key] for key in ("proposal", "author", "base", "changes", "created", "expires")},
        kind=what["change"],
        expires_s=float(what["expires_s"]),
        number=number,
        since_s=_at(what),
        received=moment_of(what),
    )


def _moved(entry: Entry, kind: str, what: Mapping[str, Any], model: str | None) -> Entry:
    """`model`: by which one judges now."""
    more: dict[str, Any] = {key: what[key] for key in ("verdict", "epoch") if key in what}
    if kind == "accepted":  # records of an earlier version do not say by which model
        more["judged_by"], more["line"] = what.get("model", model), what.get("line")
    if kind == "deploying":
        more["region"] = _region(what)
    if kind == "put-off":  # as if it had never been told
        more |= {"epoch": None, "region": None, "by_person": False, "approval": None}
    if kind == "approved":
        more["by_person"], more["approval"] = what.get("by", PERSON) == PERSON, hash_of(dict(what))
    return replace(
        entry, stage=STEPS[kind][1], why=str(what.get("because", entry.why)), since_s=_at(what),
        first=first_of(what) if kind == APPROVED_ONCE else None, **more,
    )  # fmt: skip


def superseded_by_change(entry: Entry, what: Mapping[str, Any]) -> Entry:
    """`what`: of the record that the line has changed."""
    return replace(entry, stage=Stage.SUPERSEDED, why=f"the line has changed: {what['because']}", since_s=_at(what))


def entry_of(records: Iterable[tuple[str, Mapping[str, Any]]]) -> Entry | None:
    """Where a proposal stands by its own records; None: they do not begin with it."""
    entry = None
    for kind, what in records:
        if kind == PROPOSED:
            entry = _proposed(what, 0)
        elif entry is not None and kind in STEPS:
            entry = _moved(entry, kind, what, None)
    return entry


def _at(what: Mapping[str, Any]) -> float | None:
    return float(what["at_s"]) if "at_s" in what else None


def moment_of(what: Mapping[str, Any]) -> Moment | None:
    """When a record was made, as far as it says; `clock` is what `clock_fields` has written into it."""
    if "at_s" not in what:
        return None
    clock = what.get("clock", {})
    return Moment(
        float(what["at_s"]), str(clock.get("boot", "")), float(clock.get("monotonic_s", 0.0)),
        bool(clock.get("agreed", False)),
    )  # fmt: skip


def clock_fields(moment: Moment) -> dict[str, Any]:
    """What a record says of its time."""
    clock = {"boot": moment.boot, "monotonic_s": moment.monotonic_s, "agreed": moment.agreed}
    return {"at_s": moment.wall_s, "clock": clock}


def _region(what: Mapping[str, Any]) -> Region:
    return Region.model_validate(what.get("region", {}))


def reconciled(book: Book, found: InService) -> tuple[str, dict[str, Any]] | None:
    """The next record that brings the book to what the loop says of itself; None: they agree.

    To be asked again after each, until there is none. What the loop says is what is: it alone applies torques.
    """
    change = book.on_the_line
    if change is not None and change.stage is not Stage.RUNNING:
        return _settled(book, change, found)
    said = (found.hash, found.last_known_good, found.epoch, found.region)
    if said != (book.in_service, book.last_known_good, book.epoch, book.region):
        return FOUND, {
            "configuration": found.hash,
            "last_known_good": found.last_known_good,
            "epoch": found.epoch,
            "region": found.region.model_dump(),
            "because": found.why,
            "explained": (explained := book.explains(found)),
            **({} if explained else {"confined": True}),
        }
    stale = next((entry for entry in book.undecided if entry.base != book.in_service), None)
    if stale is not None:
        because = "the configuration that it would change is no longer in service"
        return "superseded", {"proposal": stale.proposal, "because": because}
    return None


def _settled(book: Book, change: Entry, found: InService) -> tuple[str, dict[str, Any]] | None:
    """What has become of a change that was on its way to the line."""
    # The same configuration may be deployed again for another region: what was before it is back, then.
    runs = (found.hash, found.epoch) == (change.changes, change.epoch) and change.region in (None, found.region)
    goods = {book.last_known_good} if found.on_probation else {book.last_known_good, change.changes}
    runs = runs and found.last_known_good in goods
    named: dict[str, Any] = {"proposal": change.proposal, "epoch": change.epoch}
    if runs and found.on_probation:
        return ("deployed", named) if change.stage is Stage.DEPLOYING else None
    if runs:
        after = {Stage.DEPLOYING: "deployed", Stage.PROBATION: "keeping"}
        kind = after.get(change.stage, "kept")
        return kind, {**named, "last_known_good": found.last_known_good} if kind == "kept" else named
    if change.stage is Stage.DEPLOYING and found.epoch != change.epoch:
        return "not-deployed", {**named, "because": f"the loop is at epoch {found.epoch}: {found.why}"}
    because = found.why.removeprefix("rolled back: ")
    what = {**named, "to": found.hash, "region": found.region.model_dump(), "because": because}
    return "rolled-back", what if book.explains(found) else {**what, "explained": False}


def book_of(records: Iterable[tuple[str, Mapping[str, Any]]]) -> Book:
    """From kinds and contents in the order of the audit, what is done with left out. Raises Impossible."""
    book = Book()
    for kind, what in records:
        book.apply(kind, what)
        book.forget()
    return book
