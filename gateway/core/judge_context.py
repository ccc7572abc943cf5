"""What a proposal is judged against: what is in service, the model with its data, the clock, the state of the line.

A file of it makes a verdict repeatable away from the line: the same context, proposal and seed give the same verdict.
"""

import hashlib
from collections.abc import Sequence
from datetime import UTC, datetime, timedelta
from typing import Annotated

from pydantic import Field, ValidationError

from gateway.core.canonical import canonical_bytes
from gateway.core.controller import ControllerConfig
from gateway.core.deployment import Region
from gateway.core.json_problems import NotJson, document_of, problems
from gateway.core.line import NonNegative, Positive, Strict
from gateway.core.line_model import Digest, Instant, LineModel
from gateway.core.steady_clock import JUMP_S


class ContextRefused(Exception):
    """It is no context; `reasons` are all of them."""

    def __init__(self, reasons: Sequence[str]) -> None:
        super().__init__("; ".join(reasons))
        self.reasons = list(reasons)


class DataReference(Strict):
    """A recording: a CSV or MCAP file as `r2rgate export` writes it, beside the context; known by its digest."""

    path: Annotated[str, Field(min_length=1, max_length=400)]  #: relative to the context's file
    digest: Digest  #: `Recording.digest`
    recorded: Instant  #: when it ended


class LineState(Strict):
    """The line when it is judged."""

    state: Annotated[str, Field(pattern=r"^(SILENT|READY|RUN|HOLD|STOP)$")]
    tension_n: Annotated[list[Positive], Field(min_length=1, max_length=60)]  #: set-points
    speed_m_per_s: NonNegative  #: set-point
    moving: bool = False  #: set-points or speed are on their way
    experiment: bool = False  #: one is under way
    on_probation: bool = False  #: a change is under watch
    doubts: Annotated[list[Annotated[str, Field(max_length=200)]], Field(max_length=60)] = []  #: of what is measured
    since_change_s: NonNegative | None = None  #: since the last change of how it is controlled; null: none yet


class JudgeContext(Strict):
    format: Annotated[int, Field(ge=1, le=1)]
    now: Instant
    state: LineState
    in_service: ControllerConfig
    region: Region = Region()  #: for which that was judged; what it would do beyond is no measure for others
    baseline: ControllerConfig | None = None  #: that small steps are held against; null: as in service
    baseline_region: Region = Region()  #: as far as it is a measure
    model: LineModel | None = None  #: accepted, by which is judged; null: the tolerances of the line's file
    data: Annotated[list[DataReference], Field(max_length=64)] = []  #: recent, on which the model must hold
    latency_s: NonNegative | None = None  #: measured, from a sample to its torque; null: the line's file
    decided: Annotated[list[Digest], Field(max_length=4096)] = []  #: proposals that were decided: none is twice


def dated(context: JudgeContext, now_s: float) -> JudgeContext:
    """The same under a clock that says `now_s`, Unix time: what it dates is as long ago as before."""
    shift = datetime.fromtimestamp(now_s, UTC) - datetime.fromisoformat(context.now)
    if abs(shift.total_seconds()) <= JUMP_S:
        return context
    data = [one.model_copy(update={"recorded": _shifted(one.recorded, shift)}) for one in context.data]
    return context.model_copy(update={"now": _shifted(context.now, shift), "data": data})


def _shifted(instant: str, shift: timedelta) -> str:
    return (datetime.fromisoformat(instant) + shift).isoformat(timespec="milliseconds")


def canonical(context: JudgeContext) -> bytes:
    """The one byte representation of a context."""
    return canonical_bytes(context)


def context_hash(context: JudgeContext) -> str:
    """SHA-256 of the canonical bytes, in hexadecimal."""
    return hashlib.sha256(canonical(context)).hexdigest()


def parse_context(payload: bytes) -> JudgeContext:
    """The context in `payload` (JSON). Raises ContextRefused with every reason."""
    try:
        return JudgeContext.model_validate(document_of(payload))
    except NotJson as error:
        raise ContextRefused([str(error)]) from error
    except ValidationError as error:
        raise ContextRefused(problems(error, JudgeContext)) from error
