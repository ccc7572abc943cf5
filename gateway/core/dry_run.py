"""What the judge would find of a proposal now. It is no verdict: nothing rests on it, and nothing is recorded of it."""

from typing import Annotated, Literal

from pydantic import Field

from gateway.core.deployment import Region
from gateway.core.line import Strict
from gateway.core.line_model import Digest, Instant
from gateway.core.verdict import RuleFinding, ScenarioFigures, Verdict


class DryRun(Strict):
    """Without the seed: a proposal is judged with another one, which nobody knows before."""

    format: Annotated[int, Field(ge=1, le=1)]
    dry_run: Literal[True] = True
    proposal: Digest | None  #: null: the bytes were no proposal
    would_pass: bool
    findings: list[RuleFinding]
    reported: list[RuleFinding]
    figures: list[ScenarioFigures]
    region: Region | None  #: for which it would be put into service; null: nothing would be accepted
    judged: Instant

    @property
    def reasons(self) -> list[str]:
        """Against the proposal."""
        return [finding.text for finding in self.findings if not finding.passed]


def dry_run_of(verdict: Verdict) -> DryRun:
    return DryRun(
        format=1, proposal=verdict.proposal, would_pass=verdict.accepted, findings=verdict.findings,
        reported=verdict.reported, figures=verdict.figures, region=verdict.region, judged=verdict.judged,
    )  # fmt: skip
