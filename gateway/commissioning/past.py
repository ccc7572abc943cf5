"""What has been tried on a line, as the gate's list of proposals tells it. Pure."""

from collections.abc import Sequence
from dataclasses import dataclass
from enum import StrEnum

from gateway.commissioning.decisions import RULES
from gateway.core.decisions import ProposalShown
from gateway.core.proposal import Evidence
from gateway.core.verdict import OF_THE_MOMENT, Verdict


class Step(StrEnum):
    FIRST = "first configuration"
    EXPERIMENT = "experiment"
    MODEL = "model"
    REDESIGN = "redesign"
    MEASUREMENT = "measurement"


class Follows(StrEnum):
    """What a measurement leads to."""

    NEWER_MODEL = "newer-model"  #: the line does otherwise than the model foresees: another round
    ALL_DATA = "all-data"  #: it does as foreseen, from few data: a model of all that has been recorded, and a redesign
    CALMER = "calmer"  #: the model has foreseen it: a calmer configuration on the same one
    LEAVE = "leave"  #: nothing significant is left to gain


class Outcome(StrEnum):
    OPEN = "open"  #: it is being judged, decided, or done
    DONE = "done"
    AGAIN = "again"  #: nothing was against it but the moment
    FAILED = "failed"


KINDS = {
    Step.FIRST: "gains", Step.EXPERIMENT: "experiment", Step.MODEL: "model", Step.REDESIGN: "gains",
    Step.MEASUREMENT: "experiment",
}  # fmt: skip
MOST_RUNG = 1000
#: From here on: what the rules propose in the end, where agents have led to what is in service.
BY_RULES = 200
PROPOSED_BY = "commissioning: "  #: how the evidence begins that names step and rung

OPEN_STAGES = frozenset({"received", "waiting", "approved", "deploying", "probation", "keeping", "running"})
UNDECIDED = frozenset({"received", "waiting"})  #: of somebody else's: nobody need wait for it
STALE_STAGES = frozenset({"expired", "superseded", "not-deployed"})


@dataclass(frozen=True)
class Past:
    """A proposal of the gate's list, or a candidate that could not even be made."""

    kind: str
    outcome: Outcome
    step: Step | None = None  #: of this chain; None: somebody else has proposed it
    rung: int = 0
    why: str = ""
    speed_m_per_s: float | None = None  #: up to which a verdict lets a configuration run
    proposal: str = ""  #: hash; empty: it could not be made
    converged: bool = False  #: of a measurement: the line did what it should, as the model foresees
    follows: Follows | None = None  #: from a measurement; None: nobody has looked at it yet
    last: bool = False  #: there is no design on a higher rung either, or a person wants none
    author: str = RULES


def past_of(shown: ProposalShown) -> Past:
    """A proposal as the gate shows it."""
    verdict = shown.verdict
    step, rung = _named(shown.proposal.kind, shown.proposal.evidence)
    region = None if verdict is None else verdict.region
    return Past(
        kind=shown.proposal.kind,
        outcome=_outcome(shown.stage, shown.why, verdict) if step or shown.stage not in UNDECIDED else Outcome.AGAIN,
        step=step,
        rung=rung,
        why=shown.why,
        speed_m_per_s=None if region is None else region.speed_max_m_per_s,
        proposal=shown.proposal_hash,
        author=shown.proposal.author,
        last=rung >= BY_RULES and shown.stage == "rejected",
    )


def named(step: Step, rung: int) -> Evidence:
    """By which a proposal of the chain is known."""
    return Evidence(what=f"{PROPOSED_BY}{step}", value=float(rung))


def _named(kind: str, evidence: Sequence[Evidence]) -> tuple[Step | None, int]:
    for one in evidence:
        name = one.what.removeprefix(PROPOSED_BY)
        if not one.what.startswith(PROPOSED_BY) or name not in set(Step) or one.value is None:
            continue
        if KINDS[Step(name)] == kind and 0.0 <= one.value < MOST_RUNG:
            return Step(name), int(one.value)
    return None, 0


def _outcome(stage: str, why: str, verdict: Verdict | None) -> Outcome:
    if stage in OPEN_STAGES:
        return Outcome.OPEN
    if stage in STALE_STAGES:
        return Outcome.AGAIN
    if stage == "kept" or (stage == "done" and not why):
        return Outcome.DONE
    if stage == "refused" and verdict is not None:
        against = {one.rule for one in verdict.findings if not one.passed}
        return Outcome.AGAIN if against <= OF_THE_MOMENT else Outcome.FAILED
    return Outcome.FAILED


def is_done(one: Past, kind: str) -> bool:
    """Whether something of `kind` was let through, and kept or carried out."""
    return one.kind == kind and one.outcome is Outcome.DONE


def last_done(past: Sequence[Past], kind: str) -> int:
    """Where in `past`; -1: none."""
    return max((i for i, one in enumerate(past) if is_done(one, kind)), default=-1)


def experiments_since_model(past: Sequence[Past]) -> int:
    """That were made, but for measurements."""
    since_model = past[last_done(past, "model") + 1 :]
    return sum(is_done(one, "experiment") and one.step is not Step.MEASUREMENT for one in since_model)
