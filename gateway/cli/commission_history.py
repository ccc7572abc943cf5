"""The history of a line's commissioning: what was tried, why, what the gate and people said, what was measured.

Read from the gate's list of proposals and the line's baselines, as the chain reads it: there is no other record.
"""

from dataclasses import dataclass
from typing import Any

from gateway.cli.commission_result import candidate_name
from gateway.cli.commission_side import CannotGoOn, GateSide, measured_on
from gateway.commissioning.convergence import Convergence
from gateway.commissioning.past import Step, past_of
from gateway.core.decisions import ProposalShown
from gateway.core.line import Line

APPROVED = frozenset({"kept", "done", "rolled-back", "running", "probation", "keeping", "deploying", "not-deployed"})


@dataclass(frozen=True)
class Tried:
    """A proposal, of the chain or of somebody else, and what became of it."""

    round: int  #: of the adaptation: models that have been accepted until then
    at: str
    step: str
    candidate: int | None  #: from 1; None: it is not of the chain
    proposal: str
    reason: str
    stage: str
    why: str
    against: list[str]  #: rules that did not pass
    measured: Convergence | None

    def row(self) -> tuple[str, ...]:
        """For a table."""
        ended = ": ".join(part for part in (self.stage, ", ".join(self.against) or self.why) if part)
        what = self.step if self.candidate is None else f"{self.step}, {candidate_name(self.candidate - 1)}"
        return (str(self.round), self.at[:19], what, self.reason, ended, self.measured.text if self.measured else "")

    def data(self) -> dict[str, Any]:
        """For JSON."""
        found = None
        if self.measured is not None:
            found = {**self.measured.model_dump(mode="json"), "converged": self.measured.converged}
        return {**vars(self), "measured": found}


async def history(line: Line, side: GateSide) -> list[Tried]:
    """The oldest first. Raises CannotGoOn."""
    shown, measured = await side.proposals(), await measured_on(line, side)
    if not shown:
        raise CannotGoOn("nothing has been proposed on this line yet: `r2rgate commission` begins")
    found: list[Tried] = []
    models = 0
    for one in shown:
        found.append(_tried(one, models, measured.get(one.proposal_hash)))
        models += one.proposal.kind == "model" and one.stage == "kept"
    return found


def approvals(tried: list[Tried]) -> int:
    """Proposals that were approved: what somebody had to do by hand, where a person decides each."""
    return sum(one.stage in APPROVED for one in tried)


def _tried(shown: ProposalShown, models: int, measured: Convergence | None) -> Tried:
    past, verdict = past_of(shown), shown.verdict
    return Tried(
        round=models,
        at=shown.proposal.created,
        step=past.step or shown.proposal.kind,
        candidate=None if past.step is None else past.rung + 1,
        proposal=shown.proposal_hash,
        reason=shown.proposal.reason,
        stage=shown.stage,
        why=shown.why,
        against=[] if verdict is None else [rule.rule for rule in verdict.findings if not rule.passed],
        measured=measured if past.step is Step.MEASUREMENT else None,
    )
