"""The commissioning chain carried out: the next proposal is made and put before the gate, until the chain has ended.

Whoever runs it, on a simulated line in stepped time or on a gateway that runs, gives a `GateSide`. Nothing is kept
here: what has been tried stands in the gate's list, what measurements have shown in the line's baselines, and a
candidate that cannot be made is found so again.
"""

import asyncio
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from datetime import timedelta
from math import inf
from pathlib import Path
from typing import Protocol

from gateway.cli.commission_changes import Changes, LineNow, first_speed_m_per_s
from gateway.cli.commission_measurements import keep, kept
from gateway.commissioning.candidates import Exhausted, NotOffered, fastest_m_per_s
from gateway.commissioning.chain import (
    AS_IT_IS,
    Ended,
    Look,
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
from gateway.commissioning.convergence import Convergence
from gateway.core.controller import config_hash
from gateway.core.decisions import ProposalShown
from gateway.core.deployment import Region
from gateway.core.line import Line
from gateway.core.line_model import model_hash
from gateway.core.messages import Reply
from gateway.core.proposal import Change, Evidence, Proposal, canonical, proposal_hash
from gateway.core.recording import Recording
from gateway.supervisor.baselines import BaselinesError

AUTHOR = "rules"
STANDS_S = 8.0 * 3600.0  #: a proposal, until somebody decides
KINDS = {
    Step.FIRST: "gains", Step.EXPERIMENT: "experiment", Step.MODEL: "model", Step.REDESIGN: "gains",
    Step.MEASUREMENT: "experiment",
}  # fmt: skip

Tell = Callable[[str], None]


class CannotGoOn(Exception):
    """The line or its gateway does not let the chain go on; the text says why, and what to do."""


class GateSide(Protocol):
    """A gate and the line behind it. Every method raises CannotGoOn."""

    async def proposals(self) -> list[ProposalShown]:
        """All of the line, the oldest first."""
        ...

    async def now(self) -> LineNow: ...

    async def state(self) -> str:
        """Of the loop: RUN, READY ..."""
        ...

    async def folder(self) -> Path:
        """Of the line's data, where its baselines are."""
        ...

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
    shown: Convergence | None = None  #: by a measurement

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
    converged: bool = False  #: it does what it should, and nothing significant is left to gain


async def commission(
    line: Line,
    side: GateSide,
    tell: Tell = lambda text: None,
    *,
    wanted_m_per_s: float | None = None,
    adaptations: int = 1,
    most_redesigns: int | None = None,
    again: bool = False,
) -> Commissioned:
    """Until the chain has ended, one way or the other. Every rung is tried once, so that it does.

    `wanted_m_per_s`: up to which the line is to be adapted; None: as fast as its drives hold.
    `adaptations`: redesigns at least; `most_redesigns`: it is left there once so many have been kept.
    `again`: the line is no longer as it was (another grade, a new part). What is in service stays, and counts as a
    first configuration: for low speed, until experiments have shown more.
    """
    if why := refused_at_once(line):
        return Commissioned(False, why, [], None)
    changes = Changes(line, inf if wanted_m_per_s is None else wanted_m_per_s)
    unmade: list[tuple[int, Past]] = []  #: candidates that could not be made, by how many proposals there were
    past: list[Past] = []
    shown: list[ProposalShown] = []
    measured: dict[str, Convergence] = {}
    outdated = None if again else 0  #: so many proposals, the oldest, say nothing of the line as it is now
    while True:
        try:
            shown, measured = await side.proposals(), await measured_on(line, side)
            outdated = len(shown) if outdated is None else outdated
            past = _merged(shown, unmade, measured)
            if outdated:
                past = [_begin(line, past[:outdated]), *past[outdated:]]
            kept_now = sum(one.step is Step.REDESIGN and one.outcome is Outcome.DONE for one in past)
            if most_redesigns is not None and kept_now >= most_redesigns:
                return _commissioned(Ended(True, f"{kept_now} redesigns are kept"), past, shown, measured)
            now = await side.now()
            fastest = fastest_m_per_s(line, now.model)
            wanted = fastest if wanted_m_per_s is None else min(wanted_m_per_s, fastest)
            step = next_step(past, first_speed_m_per_s(line), wanted, adaptations)
            if isinstance(step, Ended):
                return _commissioned(step, past, shown, measured)
            if isinstance(step, Pending):
                await side.wait_for(step.proposal)
                continue
            if isinstance(step, Look):
                try:
                    await _look(changes, side, step.proposal, tell)
                except NotOffered as error:
                    text = f"an adapted configuration is in service up to {region_speed(past) or 0.0:.3g} m/s"
                    ended = Ended(True, f"{text}; what was measured cannot be judged: {error}")
                    return _commissioned(ended, past, shown, measured)
                continue
            await side.ready()
            await _propose(changes, side, step, shown, unmade, tell)
        except CannotGoOn as stopped:
            return _commissioned(Ended(False, str(stopped)), past, shown, measured)


async def _look(changes: Changes, side: GateSide, proposal: str, tell: Tell) -> None:
    """At what the measurement under `proposal`, the newest experiment, has shown. Raises CannotGoOn, NotOffered."""
    now, recordings = await side.now(), await side.recordings()
    if not recordings or now.model is None:
        raise CannotGoOn("the data of the last measurement are no longer there: measure anew (--again)")
    try:
        found = await asyncio.to_thread(changes.looked_at, now, recordings)
        keep(await side.folder(), changes.line, now, proposal, found, changes.effort_n2m2s(recordings[0]))
    except BaselinesError as error:
        raise CannotGoOn(f"what was measured cannot be kept: {error}") from error
    tell(f"measurement: {found.text}")


async def measured_on(line: Line, side: GateSide) -> dict[str, Convergence]:
    """By proposal. Raises CannotGoOn."""
    try:
        return kept(await side.folder(), line)
    except BaselinesError as error:
        raise CannotGoOn(str(error)) from error


async def _propose(
    changes: Changes, side: GateSide, step: Next, shown: list[ProposalShown], unmade: list[tuple[int, Past]], tell: Tell
) -> None:
    line, now, recordings = changes.line, await side.now(), await side.recordings()
    _require_slow(line, step, now)
    what = f"{step.step}, candidate {step.rung + 1}"
    tell(f"{what}: being made")
    try:
        change, reason = await asyncio.to_thread(changes.made, step, now, recordings, region_kept(shown))
    except NotOffered as refused:
        tell(f"{what}: cannot be made: {refused}")
        rung = AS_IT_IS - 1 if isinstance(refused, Exhausted) else step.rung
        unmade.append((len(shown), Past(KINDS[step.step], Outcome.FAILED, step.step, rung, str(refused))))
        return
    tell(f"{what}: {reason}")
    await put(line, side, change, reason, named(step.step, step.rung))


async def put(line: Line, side: GateSide, change: Change, reason: str, evidence: Evidence) -> str:
    """Before the gate; its hash. Raises CannotGoOn where the gate does not take it."""
    now = await side.now()
    proposal = Proposal(
        format=1,
        site=line.site,
        line=line.line,
        change=change,
        base=config_hash(now.in_service),
        model=None if now.model is None else model_hash(now.model),
        reason=reason,
        evidence=[evidence],
        author=AUTHOR,
        created=now.at.isoformat(timespec="milliseconds"),
        expires=(now.at + timedelta(seconds=min(STANDS_S, line.gate.expiry_max_s))).isoformat(timespec="milliseconds"),
    )
    reply = await side.propose(canonical(proposal))
    if not reply.ok:
        raise CannotGoOn("; ".join([reply.text, *reply.reasons]))
    return proposal_hash(proposal)


def _require_slow(line: Line, step: Next, now: LineNow) -> None:
    """A first configuration is judged for low speed, and put on a line that runs no faster."""
    first = first_speed_m_per_s(line)
    if step.step is Step.FIRST and now.speed_m_per_s > first:
        raise CannotGoOn(
            f"the line shall run at {now.speed_m_per_s:g} m/s, and a first configuration is judged up to {first:g} m/s "
            f"(gate.first_speed_max_m_per_s): `r2rgate speed {first:g}`, then go on"
        )


def region_kept(shown: Sequence[ProposalShown]) -> Region | None:
    """Of the configuration that was kept last."""
    kept = [one.verdict for one in shown if one.proposal.kind == "gains" and one.stage == "kept"]
    return kept[-1].region if kept and kept[-1] is not None else None


def _merged(
    shown: Sequence[ProposalShown], unmade: Sequence[tuple[int, Past]], measured: Mapping[str, Convergence]
) -> list[Past]:
    past = [past_of(one) for one in shown]
    for at, one in enumerate(past):
        if found := measured.get(one.proposal):
            past[at] = replace(one, settled=found.settled, gains=found.gains, why=found.text)
    for before, (at, one) in enumerate(unmade):
        past.insert(at + before, one)
    return past


def _begin(line: Line, outdated: Sequence[Past]) -> Past:
    """What was kept last, as a first configuration of the line as it is now."""
    kept = [one for one in outdated if one.kind == "gains" and one.outcome is Outcome.DONE]
    if not kept:
        raise CannotGoOn("nothing has been kept on this line yet: leave out --again")
    return replace(kept[-1], step=Step.FIRST, rung=0, speed_m_per_s=first_speed_m_per_s(line))


def _commissioned(
    ended: Ended, past: Sequence[Past], shown: Sequence[ProposalShown], measured: Mapping[str, Convergence]
) -> Commissioned:
    by_hash = {one.proposal_hash: one for one in shown}
    tried = [_tried(one, by_hash.get(one.proposal), measured.get(one.proposal)) for one in past]
    return Commissioned(ended.reached, ended.text, tried, region_speed(past), ended.converged)


def _tried(one: Past, shown: ProposalShown | None, measured: Convergence | None) -> Tried:
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
