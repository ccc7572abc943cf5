"""What the audit of a line has on its proposals, read from its folder: also beside a gateway that writes it.

A damaged audit is told as far as it can be read; what is wrong with it is told, too.
"""

from collections.abc import Iterable, Mapping
from contextlib import suppress
from dataclasses import dataclass, field, replace
from pathlib import Path

from pydantic import TypeAdapter, ValidationError

from gateway.core.audit_record import BEFORE_FIRST, AuditRecord
from gateway.core.decisions import ProposalShown
from gateway.core.differences import of_controllers, of_experiment, of_models
from gateway.core.finding import finding
from gateway.core.judge_context import ContextRefused, JudgeContext, parse_context
from gateway.core.proposal import ExperimentChange, GainsChange, Proposal, ProposalRefused, parse_proposal
from gateway.core.verdict import Verdict
from gateway.supervisor.audit_file import AuditFile, AuditUnavailable
from gateway.supervisor.audit_verify import Verification, chained, verify
from gateway.supervisor.audit_writer import NOT_DONE
from gateway.supervisor.lifecycle import PROPOSED, STEPS, Book, Impossible
from gateway.wording.catalogue import sentence

FAR_S = 4e9  #: beyond any wall clock
_SEQUENCES: TypeAdapter[set[int]] = TypeAdapter(set[int])


@dataclass(frozen=True)
class Recorded:
    """A proposal, everything that was shown of it, and each step that it took."""

    shown: ProposalShown  #: with the stage that it has come to
    context: JudgeContext | None  #: in which it was judged; None: it was not, or that is lost
    steps: tuple[AuditRecord, ...]  #: in their order, the first is that it was proposed

    @property
    def hash(self) -> str:
        return self.shown.proposal_hash

    @property
    def proposal(self) -> Proposal:
        return self.shown.proposal

    def step(self, kind: str) -> AuditRecord | None:
        """The last of that kind."""
        return next((one for one in reversed(self.steps) if one.kind == kind), None)


@dataclass
class LineRecords:
    found: Verification
    book: Book
    proposals: list[Recorded] = field(default_factory=list[Recorded])  #: the oldest first
    others: list[AuditRecord] = field(default_factory=list[AuditRecord])  #: of no proposal
    problems: list[str] = field(default_factory=list[str])  #: what could not be told, beside what `found` has


def read_records(folder: Path) -> LineRecords:
    """Never raises for what is damaged: it tells."""
    told = LineRecords(verify(folder), Book())
    try:
        with AuditFile(folder) as file:
            records = [one.record for one in chained(file.rows(), 0, BEFORE_FIRST) if one.record is not None]
            steps = _fold(records, told)
            for hash_, taken in steps.items():
                try:
                    told.proposals.append(_recorded(file, told.book, hash_, taken))
                except (ProposalRefused, ValidationError, _Lost) as error:
                    told.problems.append(f"proposal {hash_[:12]} cannot be told: {error}")
    except AuditUnavailable as error:
        if str(error) not in told.found.problems:
            told.problems.append(str(error))
    return told


def verdicts_in(folder: Path) -> dict[str, Verdict]:
    """By proposal, as far as they can be read."""
    proposals = read_records(folder).proposals
    return {one.hash: one.shown.verdict for one in proposals if one.shown.verdict is not None}


def unconfirmed_in(book: Book) -> list[str]:
    """That nobody answers for what is in service, as a sentence for a page; empty where somebody has."""
    hash_ = book.in_service
    if hash_ is None or not book.is_unconfirmed:
        return []
    if hash_ == book.unexplained:
        one = finding("configuration-unexplained", configuration=hash_[:12], epoch=book.epoch)
    else:
        one = finding("configuration-unconfirmed", configuration=hash_[:12])
    return [f"Unconfirmed: {sentence(one)}."]


class _Lost(Exception):
    """Of a proposal something is not there any more."""


def _fold(records: Iterable[AuditRecord], told: LineRecords) -> dict[str, list[AuditRecord]]:
    """The steps of each proposal; the book is brought up to date. What a record calls not done was not."""
    records = list(records)
    not_done = {number for one in records if one.kind == NOT_DONE for number in _sequences(one.what)}
    steps: dict[str, list[AuditRecord]] = {}
    for one in records:
        if one.sequence in not_done:
            continue
        if against := _against(told.book, one):
            told.problems.append(f"record {one.sequence}, {one.kind}, does not follow from those before: {against}")
        proposal = one.what.get("proposal")
        if isinstance(proposal, str) and (one.kind == PROPOSED or proposal in steps):
            steps.setdefault(proposal, []).append(one)
        else:
            told.others.append(one)
    return steps


def _against(book: Book, record: AuditRecord) -> str:
    """Why it does not follow; empty: it does. The book has it either way, as if what is missing were there."""
    kind, what = record.kind, record.what
    try:
        book.apply(kind, what)
        return ""
    except (Impossible, KeyError, ValueError) as error:
        against = str(error)
    entry = book.entries.get(str(what.get("proposal")))
    if entry is not None and kind in STEPS:
        book.entries[entry.proposal] = replace(entry, stage=STEPS[kind][0][0])
        with suppress(Impossible, KeyError, ValueError):
            book.apply(kind, what)
    return against


def _sequences(what: Mapping[str, object]) -> set[int]:
    try:
        return _SEQUENCES.validate_python(what.get("sequences"))
    except ValidationError:
        return set()


def _recorded(file: AuditFile, book: Book, hash_: str, steps: list[AuditRecord]) -> Recorded:
    """Raises ProposalRefused, ValidationError, _Lost."""
    content = file.blob(hash_)
    if content is None:
        raise _Lost("its content is missing or damaged; `r2rgate audit verify` tells more")
    proposal = parse_proposal(content, len(content))
    judged = next((one for one in reversed(steps) if "verdict" in one.blobs), None)
    verdict, context = (None, None) if judged is None else _judged(file, judged)
    entry = book.entries.get(hash_)
    shown = ProposalShown(
        format=1,
        stage="unknown" if entry is None else entry.stage,
        why="" if entry is None else entry.why,
        proposal_hash=hash_,
        shown=None,
        epoch=0 if entry is None else entry.epoch or 0,
        difference=_difference(proposal, context),
        proposal=proposal,
        verdict=verdict,
    )
    return Recorded(shown, context, tuple(steps))


def _judged(file: AuditFile, record: AuditRecord) -> tuple[Verdict | None, JudgeContext | None]:
    """None of what is lost."""
    content, context = (file.blob(record.blobs.get(part, "")) for part in ("verdict", "context"))
    verdict = None if content is None else Verdict.model_validate_json(content)
    try:
        return verdict, None if context is None else parse_context(context)
    except ContextRefused:
        return verdict, None


def _difference(proposal: Proposal, context: JudgeContext | None) -> list[str]:
    """As the gateway computed it, against what was in service when it was judged."""
    change = proposal.change
    if isinstance(change, ExperimentChange):
        return of_experiment(change.experiment)
    if context is None:
        return ["against what it was is not known: it was never judged, or that is lost"]
    if isinstance(change, GainsChange):
        return of_controllers(context.in_service, change.controller)
    return of_models(context.model, change.model)
