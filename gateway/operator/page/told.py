"""A proposal as the page shows it: what would change, before and after, and how much of each rule's limit is used.

All of it as the gateway computes it; of its author there are the reason and what it rests on, as quotations.
"""

import math
from typing import Any

from gateway.core.decisions import ProposalShown
from gateway.core.proposal import ExperimentChange
from gateway.core.verdict import RuleFinding, Verdict

#: Rules with a lower and an upper limit: how much of one of them is used says nothing.
TWO_SIDED = frozenset({"model validity", "model: residuals"})


def proposal_told(shown: ProposalShown) -> dict[str, Any]:
    """Without the matrices: nobody decides on those."""
    proposal, change = shown.proposal, shown.proposal.change
    return {
        **shown.model_dump(
            include={"stage", "why", "proposal_hash", "shown", "epoch", "difference", "approvals", "approved_by"}
        ),
        **proposal.model_dump(include={"base", "model", "reason", "evidence", "predicted", "author"}),
        "kind": proposal.kind,
        "lasts_s": change.experiment.duration_s if isinstance(change, ExperimentChange) else None,
        "created": proposal.created,
        "expires": proposal.expires,
        "verdict": None if shown.verdict is None else verdict_told(shown.verdict),
    }


def verdict_told(verdict: Verdict) -> dict[str, Any]:
    """With how much of each limit is used."""
    return {
        "accepted": verdict.accepted,
        "judged": verdict.judged,
        "findings": [_finding(one) for one in verdict.findings],
        "reported": [_finding(one) for one in verdict.reported],
        "figures": [one.model_dump() for one in verdict.figures],
        "region": None if verdict.region is None else verdict.region.model_dump(),
    }


def _finding(finding: RuleFinding) -> dict[str, Any]:
    return {**finding.model_dump(), "used": used(finding)}


def used(finding: RuleFinding) -> float | None:
    """How much of what is allowed is used, 0 to 1; 1 too where more is. None: the rule has no such number.

    A rule of two limits has none, but its rows with a unit, such as a greatest speed, have one limit.

    Where at least the limit is asked for, the limit over the value; where at most, the value over the limit.
    """
    value, limit, margin = finding.value, finding.limit, finding.margin
    if value is None or limit is None or margin is None:
        return None
    if finding.rule in TWO_SIDED and not finding.unit:
        return None
    if margin < 0.0:
        return 1.0
    at_least = math.isclose(margin, value - limit, rel_tol=1e-6, abs_tol=1e-12)
    part, whole = (limit, value) if at_least else (abs(value), abs(limit))
    if whole <= 0.0 or part < 0.0:  # at least -10, say: of that nothing is used up
        return None
    return min(1.0, part / whole)
