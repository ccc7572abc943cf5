"""What the commissioning chain needs of a gate and the line behind it, and how a proposal is put before one."""

from collections.abc import Sequence
from datetime import timedelta
from pathlib import Path
from typing import Protocol

from gateway.cli.commission_changes import LineNow
from gateway.cli.commission_measurements import kept
from gateway.commissioning.convergence import Convergence
from gateway.commissioning.decisions import RULES
from gateway.commissioning.past import Outcome, past_of
from gateway.core.controller import config_hash
from gateway.core.decisions import ProposalShown
from gateway.core.deployment import Region
from gateway.core.line import Line
from gateway.core.line_model import model_hash
from gateway.core.messages import Reply
from gateway.core.proposal import Change, Evidence, GainsChange, Proposal, canonical, proposal_hash
from gateway.core.recording import Recording
from gateway.supervisor.baselines import BaselinesError

STANDS_S = 8.0 * 3600.0  #: a proposal, until somebody decides


class CannotGoOn(Exception):
    """The line or its gateway does not let the chain go on; the text says why, and what to do."""


class Away(CannotGoOn):
    """The gateway does not answer."""


class GateSide(Protocol):
    """A gate and the line behind it. Every method raises CannotGoOn, and Away where nobody answers."""

    async def proposals(self) -> list[ProposalShown]:
        """All that were made since the line was said to have changed last; the oldest first."""
        ...

    async def now(self) -> LineNow: ...

    async def state(self) -> str:
        """Of the loop: RUN, READY ..."""
        ...

    async def folder(self) -> Path:
        """Of the line's data, where its baselines are."""
        ...

    async def recordings(self) -> list[Recording]:
        """Of experiments on the line as it is now, as the gate judges by them: the newest first."""
        ...

    async def ready(self) -> None:
        """Until nothing moves, and the line may be changed again."""
        ...

    async def propose(self, payload: bytes) -> Reply: ...

    async def wait_for(self, proposal: str) -> None:
        """A while, or until it stands otherwise than now."""
        ...

    async def is_back(self, why: str) -> bool:
        """Once whoever was away answers again; False: not within a while. `why` is told: it says what to start."""
        ...


async def measured_on(line: Line, side: GateSide) -> dict[str, Convergence]:
    """By proposal. Raises CannotGoOn."""
    try:
        return kept(await side.folder(), line)
    except BaselinesError as error:
        raise CannotGoOn(str(error)) from error


async def put(
    line: Line, side: GateSide, change: Change, reason: str, evidence: Sequence[Evidence], author: str = RULES,
    made_on: LineNow | None = None,
) -> str:  # fmt: skip
    """Before the gate; its hash. `made_on`: what the change was made from; None: the line as it is now.

    Raises CannotGoOn where the gate does not take it.
    """
    now = await side.now()
    base = now if made_on is None else made_on
    proposal = Proposal(
        format=1,
        site=line.site,
        line=line.line,
        change=change,
        base=config_hash(base.in_service),
        model=None if base.model is None else model_hash(base.model),
        reason=reason,
        evidence=list(evidence),
        author=author,
        created=now.at.isoformat(timespec="milliseconds"),
        expires=(now.at + timedelta(seconds=min(STANDS_S, line.gate.expiry_max_s))).isoformat(timespec="milliseconds"),
    )
    reply = await side.propose(canonical(proposal))
    if not reply.ok:
        raise CannotGoOn("; ".join([reply.text, *reply.reasons]))
    return proposal_hash(proposal)


def proposed_on_model(shown: Sequence[ProposalShown]) -> frozenset[str]:
    """Hashes of the configurations that have had their answer since the accepted model was kept."""
    at = max((i for i, one in enumerate(shown) if one.proposal.kind == "model" and one.stage == "kept"), default=-1)
    answered = (one for one in shown[at + 1 :] if past_of(one).outcome in {Outcome.DONE, Outcome.FAILED})
    changes = (one.proposal.change for one in answered)
    return frozenset(config_hash(change.controller) for change in changes if isinstance(change, GainsChange))


def region_kept(shown: Sequence[ProposalShown]) -> Region | None:
    """Of the configuration that was kept last."""
    kept = [one.verdict for one in shown if one.proposal.kind == "gains" and one.stage == "kept"]
    return kept[-1].region if kept and kept[-1] is not None else None
