"""What a run of the commissioning chain comes to: each candidate that was tried, and where the line stands."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from gateway.commissioning.chain import region_speed
from gateway.commissioning.convergence import Convergence
from gateway.commissioning.ladder import BY_RULES, OWN, Ended
from gateway.commissioning.past import Past, Step
from gateway.core.decisions import ProposalShown


@dataclass(frozen=True)
class Tried:
    """A candidate and what became of it."""

    kind: str
    step: str  #: of the chain; empty: somebody else's
    rung: int
    proposal: str  #: hash; empty: it could not be made
    stage: str
    why: str
    rule: str = ""  #: the first that failed
    value: float | None = None
    limit: float | None = None
    speed_m_per_s: float | None = None  #: of the region, where a configuration was let through
    shown: Convergence | None = None  #: by a measurement

    @property
    def text(self) -> str:
        what = f"{self.step}, {candidate_name(self.rung)}" if self.step else self.kind
        by = f" by {self.rule}" if self.rule else ""
        return f"{what}: {self.stage}{by}{f': {self.why}' if self.why else ''}"


@dataclass(frozen=True)
class Commissioned:
    reached: bool
    text: str
    tried: list[Tried]
    speed_m_per_s: float | None  #: up to which the configuration in service was judged; None: none was kept
    converged: bool = False  #: it does what it should, and nothing significant is left to gain


def commissioned(
    ended: Ended, past: Sequence[Past], shown: Sequence[ProposalShown], measured: Mapping[str, Convergence]
) -> Commissioned:
    by_hash = {one.proposal_hash: one for one in shown}
    # Where the rules could not make a redesign they had nothing better.
    candidates = [one for one in past if one.proposal or one.rung < BY_RULES or one.step is not Step.REDESIGN]
    tried = [tried_of(one, by_hash.get(one.proposal), measured.get(one.proposal)) for one in candidates]
    return Commissioned(ended.reached, ended.text, tried, region_speed(past), ended.converged)


def tried_of(one: Past, shown: ProposalShown | None, measured: Convergence | None) -> Tried:
    """A candidate, and the proposal that was made of it where one was; `measured`: what a measurement has shown."""
    step = one.step or ""
    if shown is None:
        return Tried(one.kind, step, one.rung, "", "not made", one.why)
    verdict = shown.verdict
    first = next((rule for rule in verdict.findings if not rule.passed), None) if verdict is not None else None
    if first is None:
        return Tried(
            one.kind, step, one.rung, one.proposal, shown.stage, shown.why, speed_m_per_s=one.speed_m_per_s,
            shown=measured,
        )  # fmt: skip
    return Tried(one.kind, step, one.rung, one.proposal, shown.stage, one.why, first.rule, first.value, first.limit)


def candidate_name(rung: int) -> str:
    if rung >= BY_RULES:
        return f"candidate {rung - BY_RULES + 1} of the rules"
    return f"candidate {rung + 1}" if rung < OWN else f"own numbers {rung - OWN + 1}"
