"""Phase 4, `r2rgate refine`: in downtime, the model identified anew from what the line has shown since it was accepted.

By the procedure of phase 0, with the accepted model as the prior as far as the data bear it out. What is in service is
archived as phi_stable before anything changes, so that later runs can go back to it; model and redesign are proposed
like anything else. A redesign that is approved stands on probation until the line has run with it.
"""

import asyncio
import time
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

from gateway.cli.commission import Tell
from gateway.cli.commission_changes import MOST_REASON, LineNow
from gateway.cli.commission_side import CannotGoOn, GateSide, put, region_kept
from gateway.cli.identify_model import model_of_found
from gateway.commissioning.chain import refused_at_once
from gateway.commissioning.past import OPEN_STAGES
from gateway.commissioning.redesign import redesigns
from gateway.core.controller import config_hash
from gateway.core.decisions import Archive, ProposalShown
from gateway.core.deployment import Region
from gateway.core.line import Line
from gateway.core.line_model import LineModel, ModelRefused
from gateway.core.messages import Reply
from gateway.core.proposal import Evidence, GainsChange, ModelChange
from gateway.core.recording import Recording
from gateway.core.theta import Noise
from gateway.identification.assessment import assess
from gateway.identification.identify import NotIdentified
from gateway.identification.inheritance import NotInherited, identify_after
from gateway.supervisor.configurations import STABLE

DOWNTIME = ("SILENT", "READY", "STOP")
ON_PROBATION = ("probation", "keeping")  #: as far as a change of gains comes while the line stands


class RefinedSide(GateSide, Protocol):
    async def archive(self, command: Archive) -> Reply:
        """Recorded in the audit before it is done. Raises CannotGoOn."""
        ...


@dataclass(frozen=True)
class Refined:
    """`model`: a refined one is in service. `gains`: so is a redesign on it, or on probation until the line has run."""

    model: bool
    gains: bool
    text: str
    tried: list[ProposalShown]


async def refine(line: Line, side: RefinedSide, tell: Tell = lambda text: None) -> Refined:
    """Raises CannotGoOn where the line runs, or there is nothing to refine by; nothing has changed then."""
    if why := refused_at_once(line):
        raise CannotGoOn(why)
    await _require_downtime(side)
    shown, now = await side.proposals(), await side.now()
    if now.model is None:
        raise CannotGoOn("no model has been accepted yet: `r2rgate commission` begins")
    if pending := next((one for one in shown if one.stage in OPEN_STAGES), None):
        raise CannotGoOn(f"proposal {pending.proposal_hash[:12]} is {pending.stage}: settle it first")
    since = (await side.recordings())[: _experiments_since_model(shown)]
    recordings = [one for one in since if not assess(one, line).refusals][:1]
    if not recordings:
        raise CannotGoOn(
            f"of {len(since)} experiments since the model in service was accepted none has data that tell of the line: "
            "run one in production (`r2rgate experiment design`)"
        )
    model, words = await asyncio.to_thread(_identified, line, now, now.model, recordings)
    tell(words)
    await _archive(side, now, tell)
    tried: list[ProposalShown] = []
    await _require_downtime(side)
    change, reason = ModelChange(model=model), f"refined on the newest experiment; {words}"
    tried.append(await _settled(side, await put(line, side, change, reason[:MOST_REASON], [_named("model", 0)])))
    if tried[-1].stage != "kept":
        return Refined(False, False, f"the refined model is {tried[-1].stage}: {tried[-1].why}", tried)
    tell("the refined model is in service")
    # As fast as the newest data go: the others may be too old for the gate.
    region = (region_kept(shown) or Region()).model_copy(update={"speed_max_m_per_s": None})
    found = await asyncio.to_thread(redesigns, line, model, now.in_service, now.tension_n, region)
    for rung, offer in enumerate(found):
        await _require_downtime(side)
        reason = f"{offer.law.text} on the refined model"
        tell(reason)
        hash_ = await put(line, side, GainsChange(controller=offer.controller), reason, [_named("redesign", rung)])
        tried.append(await _settled(side, hash_))
        if tried[-1].stage in ("kept", *ON_PROBATION):
            return Refined(True, True, f"{reason} is deployed; it is kept once the line has run with it", tried)
    last = f"; the last one: {tried[-1].why}" if found else ""
    return Refined(True, False, f"no redesign of {len(found)} gets through: what was in service stays{last}", tried)


def _named(what: str, candidate: int) -> Evidence:
    return Evidence(what=f"refinement: {what}", value=float(candidate))


async def _require_downtime(side: GateSide) -> None:
    if (state := await side.state()) not in DOWNTIME:
        raise CannotGoOn(
            f"the line is in {state}: models are refined in downtime; allowed: {', '.join(DOWNTIME)} (`r2rgate stop`)"
        )


def _experiments_since_model(shown: Sequence[ProposalShown]) -> int:
    """That were run, to their end or not, since a model was accepted."""
    kinds = [(one.proposal.kind, one.stage) for one in shown]
    last = max((i for i, one in enumerate(kinds) if one == ("model", "kept")), default=-1)
    return sum(one == ("experiment", "done") for one in kinds[last + 1 :])


def _identified(line: Line, now: LineNow, parent: LineModel, recordings: Sequence[Recording]) -> tuple[LineModel, str]:
    """And what became of the accepted model as the prior. Raises CannotGoOn."""
    try:
        inherited = identify_after(parent, recordings, line, Noise(), time.perf_counter)
        created = now.at.isoformat(timespec="milliseconds")
        return (
            model_of_found(line, recordings, inherited.found, created, parent=inherited.parent),
            "; ".join(inherited.words),
        )
    except (NotIdentified, NotInherited, ModelRefused) as refused:
        raise CannotGoOn(f"the data give no model: {refused}") from refused


async def _archive(side: RefinedSide, now: LineNow, tell: Tell) -> None:
    """What is in service, as phi_stable. Raises CannotGoOn."""
    hash_ = config_hash(now.in_service)
    reply = await side.archive(Archive(configuration=hash_, name=STABLE, because="in service before a refinement"))
    if not reply.ok:
        why = "; ".join(reply.reasons) or reply.text
        raise CannotGoOn(f"what is in service cannot be archived, so nothing is changed: {why}")
    tell(f"{STABLE}: {hash_[:12]}, which was in service")


async def _settled(side: GateSide, proposal: str) -> ProposalShown:
    """Once it goes no further while the line stands."""
    while True:
        shown = next(one for one in await side.proposals() if one.proposal_hash == proposal)
        if shown.stage not in OPEN_STAGES or shown.stage in ON_PROBATION:
            return shown
        await side.wait_for(proposal)
