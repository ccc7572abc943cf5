"""What people and programs say about proposals, and what they are shown. JSON, strict.

An approval is of what was shown and of nothing else: it carries the hash over proposal, verdict and epoch, and is
good for one decision. Whatever has changed in between makes another hash.
"""

import hashlib
import json
from typing import Annotated, Literal

from pydantic import Field, TypeAdapter

from gateway.core.line import Strict
from gateway.core.line_model import Digest
from gateway.core.proposal import Kind, Proposal
from gateway.core.verdict import Verdict

Comment = Annotated[str, Field(max_length=1000)]


class Decide(Strict):
    """A person's word on a proposal that the gate has accepted."""

    command: Literal["decide"] = "decide"
    proposal: Digest
    shown: Digest  #: `shown_hash` of what the person has seen
    revision: Annotated[int, Field(ge=0)] | None = None  #: of what was in service then, where they have named it
    approve: bool
    comment: Comment = ""
    script: Annotated[str, Field(max_length=80)] = ""  #: program that decides in a person's place; empty: a person


class RollBackNow(Strict):
    """Back to the last known good configuration, at once."""

    command: Literal["roll-back"] = "roll-back"
    comment: Comment = ""


class Archive(Strict):
    """Keep a stored configuration under a name. Puts nothing into service."""

    command: Literal["archive"] = "archive"
    configuration: Annotated[str, Field(min_length=1, max_length=80)]  #: version, name, or hash or the beginning of it
    name: Annotated[str, Field(max_length=80)]
    because: Annotated[str, Field(max_length=1000)]


class LineChanged(Strict):
    """The line is no longer as it was: another web, a new part. Puts nothing into service.

    What was learned of it counts no more: proposals are judged on the line's file, as in the beginning.
    """

    command: Literal["line-changed"] = "line-changed"
    because: Annotated[str, Field(min_length=1, max_length=1000)]


class Confirm(Strict):
    """A person answers for what controls the line: a first configuration that has followed a move of a tension and a
    change of the speed, or one of which no record says how it came to be there, and which may be armed then.

    It goes no further by it than a first configuration: what is to go further is proposed and approved.
    """

    command: Literal["confirm"] = "confirm"
    configuration: Digest  #: that the person means
    because: Annotated[str, Field(min_length=1, max_length=1000)]


Decision = Annotated[Decide | RollBackNow | Archive | LineChanged | Confirm, Field(discriminator="command")]
DECISION: TypeAdapter[Decide | RollBackNow | Archive | LineChanged | Confirm] = TypeAdapter(Decision)


MOST_LISTED = 200


class ListProposals(Strict):
    """The newest first. The first page has those that wait or are on the line, too, however old they are."""

    command: Literal["list"] = "list"
    most: Annotated[int, Field(ge=1, le=MOST_LISTED)] = 50
    skip: Annotated[int, Field(ge=0)] = 0  #: so many of the newest: for what is older


class ShowProposal(Strict):
    command: Literal["show"] = "show"
    proposal: Annotated[str, Field(pattern=r"^[0-9a-f]{6,64}$")]  #: its hash, or the beginning of it


Query = Annotated[ListProposals | ShowProposal, Field(discriminator="command")]
QUERY: TypeAdapter[ListProposals | ShowProposal] = TypeAdapter(Query)


class ProposalLine(Strict):
    """A proposal in a list."""

    proposal: Digest
    kind: Kind
    author: str
    stage: str
    why: str  #: of the stage: the first reason against it, what ended it
    created: str
    expires: str
    epoch: int | None  #: of the deployment; null: never deployed


class PerformanceTold(Strict):
    """How well the configuration in service did when it was measured last, on the line as it is."""

    scenario: str
    measured_s: float  #: Unix time
    rmse_n: float
    baseline_rmse_n: float | None  #: of the line's baseline in this scenario; null: none was set


class InServiceTold(Strict):
    """What controls the line, beside its hash."""

    kind: str | None  #: PID, LQR, LQI, LQG or MPC, and whether it is scheduled; null: it is not stored here
    #: operation: a baseline was set for the line as it is; null: what was measured cannot be read now.
    phase: Literal["commissioning", "operation"] | None
    performance: PerformanceTold | None


class ProposalList(Strict):
    format: Annotated[int, Field(ge=1, le=1)]
    site: str
    line: str
    in_service: Digest | None
    last_known_good: Digest | None
    epoch: int
    model: Digest | None  #: by which proposals are judged; null: the line's file
    line_changed_s: float | None = None  #: Unix time at which somebody said last that the line has changed
    since_change: int  #: proposals that have been made since then
    proposals: list[ProposalLine]
    controller: InServiceTold | None = None  #: null: the gateway is older


class ProposalShown(Strict):
    """Everything on which a person decides."""

    format: Annotated[int, Field(ge=1, le=1)]
    stage: str
    why: str
    proposal_hash: Digest
    shown: Digest | None  #: for `Decide`; null: there is nothing to decide
    epoch: int  #: of the configuration in service
    difference: list[str]  #: what would change, as the gateway computes it
    proposal: Proposal
    verdict: Verdict | None  #: null: not judged yet
    approvals: Annotated[int, Field(ge=1)] = 1  #: that it takes, each of another person
    approved_by: str | None = None  #: whose approval of what is shown is on record, where it takes another one's, too


def shown_hash(proposal: str, verdict: str, in_service: str, epoch: int, model: str | None) -> str:
    """SHA-256 over the hashes of a proposal, its verdict, configuration and model in service, and the epoch."""
    content = {"proposal": proposal, "verdict": verdict, "in_service": in_service, "epoch": epoch, "model": model}
    return hashlib.sha256(json.dumps(content, sort_keys=True, separators=(",", ":")).encode()).hexdigest()
