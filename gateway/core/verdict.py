"""A verdict: what every rule found of a proposal, with number, limit and margin. Accepted where every rule passes."""

import hashlib
from typing import Annotated, Literal, Self

from pydantic import Field, model_validator

from gateway.core.canonical import canonical_bytes
from gateway.core.deployment import Region
from gateway.core.line import Line, NonNegative, Strict
from gateway.core.line_model import Digest, Instant
from gateway.core.proposal import Kind

#: Rules that speak against the moment, not against what is proposed.
OF_THE_MOMENT = frozenset({"state of the line", "cool-down", "freshness", "time", "judge process"})

Text = Annotated[str, Field(max_length=2000)]


class RuleFinding(Strict):
    """Of one rule. `margin` is above 0 where it passes by a number: the distance to the limit, in the rule's unit."""

    rule: Annotated[str, Field(min_length=1, max_length=60)]
    passed: bool
    text: Text  #: for a person: what was found, where, what is allowed
    value: float | None = None
    limit: float | None = None
    margin: float | None = None
    unit: Annotated[str, Field(max_length=20)] = ""


class ScenarioFigures(Strict):
    """Of a simulated scenario at the model's mean. null: not settled, or the line ran away."""

    scenario: Annotated[str, Field(min_length=1, max_length=60)]
    configuration: Literal["in service", "baseline", "proposed"]
    rmse_n: NonNegative | None
    overshoot_pct: NonNegative | None
    settling_s: NonNegative | None
    effort_n2m2s: NonNegative | None


class Verdict(Strict):
    format: Annotated[int, Field(ge=1, le=1)]
    proposal: Digest | None  #: null: the bytes were no proposal
    payload: Digest  #: SHA-256 of the bytes as they came
    context: Digest
    line: Digest  #: SHA-256 of the line's file in its canonical form
    kind: Kind | None
    seed: Annotated[int, Field(ge=0)]  #: follows from what is proposed, and a secret of the gateway
    accepted: bool
    findings: list[RuleFinding]  #: of the rules that decide, each
    reported: list[RuleFinding] = []  #: beside them: S_robust, the paper's criteria
    figures: list[ScenarioFigures] = []
    region: Region | None = None  #: for which it was judged; null: nothing was accepted
    judged: Instant  #: the context's `now`
    program_version: Annotated[str, Field(min_length=1, max_length=60)]

    @model_validator(mode="after")
    def _check(self) -> Self:
        if not self.findings:
            raise ValueError("findings is empty; allowed: what each rule found")
        if self.accepted != all(finding.passed for finding in self.findings):
            raise ValueError(f"accepted is {self.accepted}; allowed: true where every rule passed, and only there")
        return self

    @property
    def reasons(self) -> list[str]:
        """Against the proposal."""
        return [finding.text for finding in self.findings if not finding.passed]


def canonical(verdict: Verdict) -> bytes:
    """The one byte representation of a verdict."""
    return canonical_bytes(verdict)


def verdict_hash(verdict: Verdict) -> str:
    """SHA-256 of the canonical bytes, in hexadecimal."""
    return hashlib.sha256(canonical(verdict)).hexdigest()


def canonical_line(line: Line) -> bytes:
    """A line's file in the one byte representation, with everything that it leaves to defaults."""
    return canonical_bytes(line)


def line_hash(line: Line) -> str:
    """SHA-256 of the canonical bytes, in hexadecimal."""
    return hashlib.sha256(canonical_line(line)).hexdigest()
