"""The commissioning chain carried out: the next proposal is made and put before the gate, until the chain has ended.

Whoever runs it, on a simulated line in stepped time or on a gateway that runs, gives a `GateSide`. Nothing is kept
here: what has been tried stands in the gate's list, and a candidate that cannot be made is found so again.
"""

import asyncio
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from datetime import timedelta
from typing import Protocol

from gateway.cli.commission_changes import Changes, LineNow, first_speed_m_per_s
from gateway.commissioning.candidates import NotOffered, fastest_m_per_s
from gateway.commissioning.chain import (
    Ended,
    Next,
    Outcome,
    Past,
    Pending,
    Step,
    named,
    next_step,
    past_of,
    refused_at_once,
    region_speed,
)
from gateway.core.controller import config_hash
from gateway.core.decisions import ProposalShown
from gateway.core.line import Line
from gateway.core.line_model import model_hash
from gateway.core.messages import Reply
from gateway.core.proposal import Proposal, canonical
from gateway.core.recording import Recording

AUTHOR = "rules"
STANDS_S = 8.0 * 3600.0  #: a proposal, until somebody decides
KINDS = {Step.FIRST: "gains", Step.EXPERIMENT: "experiment", Step.MODEL: "model", Step.REDESIGN: "gains"}

Tell = Callable[[str], None]


class CannotGoOn(Exception):
    """The line or its gateway does not let the chain go on; the text says why, and what to do."""


class GateSide(Protocol):
    """A gate and the line behind it. Every method raises CannotGoOn."""

    async def proposals(self) -> list[ProposalShown]:
        """All of the line, the oldest first."""
        ...

    async def now(self) -> LineNow: ...

    async def recordings(self) -> list[Recording]:
        """Of experiments, as the gate judges by them: the newest first."""
        ...

    async def ready(self) -> None:
        """Until nothing moves, and the line may be changed again."""
        ...

    async def propose(self, payload: bytes) -> Reply: ...

    async def wait_for(self, proposal: str) -> None:
        """A while, or until it stands otherwise than now."""
        ...


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

    @property
    def text(self) -> str:
        what = f"{self.step or self.kind}, candidate {self.rung + 1}" if self.step else self.kind
        by = f" by {self.rule}" if self.rule else ""
        return f"{what}: {self.stage}{by}{f': {self.why}' if self.why else ''}"


@dataclass(frozen=True)
class Commissioned:
    reached: bool
    text: str
    tried: list[Tried]
    speed_m_per_s: float | None  #: up to which the configuration in service was judged; None: none was kept


async def commission(line: Line, side: GateSide, tell: Tell = lambda text: None) -> Commissioned:
    """Until the chain has ended, one way or the other. Every rung is tried once, so that it does."""
    if why := refused_at_once(line):
        return Commissioned(False, why, [], None)
    changes = Changes(line)
    unmade: list[tuple[int, Past]] = []  #: candidates that could not be made, by how many proposals there were
    shown: list[ProposalShown] = []
    while True:
        try:
            shown = await side.proposals()
            past = _merged(shown, unmade)
            now = await side.now()
            step = next_step(past, first_speed_m_per_s(line), fastest_m_per_s(line, now.model))
            if isinstance(step, Ended):
                return _commissioned(step, shown, unmade)
            if isinstance(step, Pending):
                await side.wait_for(step.proposal)
                continue
            await side.ready()
            await _propose(changes, side, step, shown, unmade, tell)
        except CannotGoOn as stopped:
            return _commissioned(Ended(False, str(stopped)), shown, unmade)


async def _propose(
    changes: Changes, side: GateSide, step: Next, shown: list[ProposalShown], unmade: list[tuple[int, Past]], tell: Tell
) -> None:
    line, now, recordings = changes.line, await side.now(), await side.recordings()
    _require_slow(line, step, now)
    try:
        change, reason = await asyncio.to_thread(changes.made, step, now, recordings)
    except NotOffered as refused:
        tell(f"{step.step}, candidate {step.rung + 1}: cannot be made: {refused}")
        unmade.append((len(shown), Past(KINDS[step.step], Outcome.FAILED, step.step, step.rung, str(refused))))
        return
    at = (await side.now()).at
    proposal = Proposal(
        format=1,
        site=line.site,
        line=line.line,
        change=change,
        base=config_hash(now.in_service),
        model=None if now.model is None else model_hash(now.model),
        reason=reason,
        evidence=[named(step.step, step.rung)],
        author=AUTHOR,
        created=at.isoformat(timespec="milliseconds"),
        expires=(at + timedelta(seconds=min(STANDS_S, line.gate.expiry_max_s))).isoformat(timespec="milliseconds"),
    )
    tell(f"{step.step}, candidate {step.rung + 1}: {reason}")
    reply = await side.propose(canonical(proposal))
    if not reply.ok:
        raise CannotGoOn("; ".join([reply.text, *reply.reasons]))


def _require_slow(line: Line, step: Next, now: LineNow) -> None:
    """A first configuration is judged for low speed, and put on a line that runs no faster."""
    first = first_speed_m_per_s(line)
    if step.step is Step.FIRST and now.speed_m_per_s > first:
        raise CannotGoOn(
            f"the line shall run at {now.speed_m_per_s:g} m/s, and a first configuration is judged up to {first:g} m/s "
            f"(gate.first_speed_max_m_per_s): `r2rgate speed {first:g}`, then go on"
        )


def _merged(shown: Sequence[ProposalShown], unmade: Sequence[tuple[int, Past]]) -> list[Past]:
    past = [past_of(one) for one in shown]
    for before, (at, one) in enumerate(unmade):
        past.insert(at + before, one)
    return past


def _commissioned(ended: Ended, shown: Sequence[ProposalShown], unmade: Sequence[tuple[int, Past]]) -> Commissioned:
    past = _merged(shown, unmade)
    by_hash = {one.proposal_hash: one for one in shown}
    tried = [_tried(one, by_hash.get(one.proposal)) for one in past]
    return Commissioned(ended.reached, ended.text, tried, region_speed(past))


def _tried(one: Past, shown: ProposalShown | None) -> Tried:
    step = one.step or ""
    if shown is None:
        return Tried(one.kind, step, one.rung, "", "not made", one.why)
    verdict = shown.verdict
    first = next((rule for rule in verdict.findings if not rule.passed), None) if verdict is not None else None
    if first is None:
        return Tried(one.kind, step, one.rung, one.proposal, shown.stage, one.why, speed_m_per_s=one.speed_m_per_s)
    return Tried(one.kind, step, one.rung, one.proposal, shown.stage, one.why, first.rule, first.value, first.limit)
