"""A proposal: whatever would change how the line is controlled, with reason, evidence and what is promised of it.

Three kinds, and one way in for each: gains (a controller configuration), an experiment (set-points that move for
identification), a model (what proposals are judged by). A proposal is known by the SHA-256 of its canonical bytes: a
verdict and an approval are of those bytes and no others.
"""

import hashlib
from collections.abc import Sequence
from datetime import datetime
from typing import Annotated, Literal, Self

from pydantic import Field, ValidationError, model_validator

from gateway.core.canonical import canonical_bytes
from gateway.core.controller import ControllerConfig
from gateway.core.experiment import Experiment
from gateway.core.json_problems import NotJson, document_of, problems
from gateway.core.line import Name, NonNegative, Strict
from gateway.core.line_model import Digest, Instant, LineModel

Kind = Literal["gains", "experiment", "model"]
MOST_BYTES = 65_536  #: unless the line's file has another limit

Reason = Annotated[str, Field(min_length=1, max_length=4000)]
Text = Annotated[str, Field(min_length=1, max_length=400)]


class ProposalRefused(Exception):
    """It is no proposal that can be judged; `reasons` are all of them."""

    def __init__(self, reasons: Sequence[str]) -> None:
        super().__init__("; ".join(reasons))
        self.reasons = list(reasons)


class GainsChange(Strict):
    kind: Literal["gains"] = "gains"
    controller: ControllerConfig

    @property
    def n(self) -> int:
        return self.controller.n


class ExperimentChange(Strict):
    """Set-points move for a while and go back; the controller in service stays."""

    kind: Literal["experiment"] = "experiment"
    experiment: Experiment

    @property
    def n(self) -> int:
        return self.experiment.n


class ModelChange(Strict):
    kind: Literal["model"] = "model"
    model: LineModel

    @property
    def n(self) -> int:
        return self.model.n


Change = Annotated[GainsChange | ExperimentChange | ModelChange, Field(discriminator="kind")]


class Evidence(Strict):
    """A number, or something by its hash, on which a proposal rests."""

    what: Text
    digest: Digest | None = None
    value: float | None = None
    unit: Annotated[str, Field(max_length=20)] = ""


class Promise(Strict):
    """What is predicted of a scenario under the change; null: nothing is promised."""

    scenario: Name
    rmse_n: NonNegative | None = None
    overshoot_pct: NonNegative | None = None
    settling_s: NonNegative | None = None


class Proposal(Strict):
    format: Annotated[int, Field(ge=1, le=1)]
    site: Name
    line: Name
    change: Change
    base: Digest  #: of the configuration in service that it would change (`config_hash`)
    model: Digest | None  #: by which it was made (`model_hash`); null: the line's file
    reason: Reason
    evidence: Annotated[list[Evidence], Field(max_length=32)] = []
    predicted: Annotated[list[Promise], Field(max_length=16)] = []
    author: Name
    created: Instant
    expires: Instant

    @property
    def kind(self) -> Kind:
        return self.change.kind

    @property
    def n(self) -> int:
        return self.change.n

    @model_validator(mode="after")
    def _check(self) -> Self:
        if datetime.fromisoformat(self.expires) <= datetime.fromisoformat(self.created):
            raise ValueError(f"expires is {self.expires}; allowed: after created, {self.created}")
        named = [promise.scenario for promise in self.predicted]
        if twice := sorted({name for name in named if named.count(name) > 1}):
            raise ValueError(f"predicted has {', '.join(twice)} twice; allowed: each scenario once")
        return self


def canonical(proposal: Proposal) -> bytes:
    """The one byte representation of a proposal, the same whoever writes it."""
    return canonical_bytes(proposal)


def proposal_hash(proposal: Proposal) -> str:
    """SHA-256 of the canonical bytes, in hexadecimal."""
    return hashlib.sha256(canonical(proposal)).hexdigest()


def parse_proposal(payload: bytes, most_bytes: int = MOST_BYTES) -> Proposal:
    """The proposal in `payload` (JSON). Raises ProposalRefused with every reason."""
    if len(payload) > most_bytes:
        raise ProposalRefused([f"it has {len(payload)} bytes; allowed: {most_bytes}"])
    try:
        return Proposal.model_validate(document_of(payload))
    except NotJson as error:
        raise ProposalRefused([str(error)]) from error
    except ValidationError as error:
        raise ProposalRefused(problems(error, Proposal)) from error
