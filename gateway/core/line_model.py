"""The model file: what was found of a line's physics, how sure, from which data, and how it did on other data. SI.

A model is known by the SHA-256 of its canonical bytes: whoever holds the file can tell which model it is.
"""

import hashlib
from collections.abc import Iterator, Sequence
from datetime import datetime
from typing import Annotated, Any, Literal, Self

import numpy as np
from pydantic import AfterValidator, Field, ValidationError, model_validator

from gateway.core.canonical import canonical_bytes
from gateway.core.json_problems import NotJson, document_of, problems
from gateway.core.line import Name, NonNegative, Positive, Strict
from gateway.core.line_model_names import MOST_SPANS, UNITS, wrong_name
from gateway.core.line_model_posterior import ModelPosterior, wrong_names
from gateway.core.theta import Noise, Theta
from gateway.core.web_model import WebModel


def _instant(text: str) -> str:
    try:
        given = datetime.fromisoformat(text)
    except ValueError:
        given = None
    if given is None or given.tzinfo is None:
        raise ValueError("is no date and time with a zone; allowed: ISO 8601, such as 2026-08-03T14:05:00+00:00")
    return text


Digest = Annotated[str, Field(pattern=r"^[0-9a-f]{64}$")]
Instant = Annotated[str, AfterValidator(_instant)]
Text = Annotated[str, Field(min_length=1, max_length=200)]
Vector = Annotated[list[Positive], Field(min_length=1, max_length=MOST_SPANS)]
VectorFrom0 = Annotated[list[NonNegative], Field(min_length=1, max_length=MOST_SPANS)]


class ModelRefused(Exception):
    """It is no model that can be used; `reasons` are all of them."""

    def __init__(self, reasons: Sequence[str]) -> None:
        super().__init__("; ".join(reasons))
        self.reasons = list(reasons)


class ModelParameters(Strict):
    """`Theta`, as it stands in a file."""

    stiffness_n: Positive
    length_m: Vector
    radius_m: Vector
    inertia_kg_m2: Vector
    friction_nms_per_rad: VectorFrom0
    coulomb_nm: VectorFrom0
    torque_lag_s: NonNegative
    latency_s: NonNegative
    tension_before_n: NonNegative = 0.0
    tension_after_n: NonNegative = 0.0
    #: Amplitude over radius; null: all round. Not written then, so that models from before it keep their hash.
    eccentricity: VectorFrom0 | None = Field(default=None, exclude_if=lambda value: value is None)

    @property
    def n(self) -> int:
        return len(self.length_m)


class ModelNoise(Strict):
    tension_n: Positive
    speed_m_per_s: Positive
    acceleration_m_per_s1_5: Positive


class ModelStructure(Strict):
    """What the model has beside the parameters of the paper."""

    per_roller: bool  #: rollers and spans each by themselves; else one factor for all
    coulomb: bool
    torque_lag: bool


class ModelInterval(Strict):
    value: float
    low: float
    high: float


class ModelData(Strict):
    """What the model was made from."""

    digest: Digest  #: `Recording.digest`
    source: Text
    samples: Annotated[int, Field(ge=1)]
    period_s: Positive


class ModelRegion(Strict):
    """Speeds of the unwinder and tensions that the data went through: beyond them nobody has seen the model hold."""

    speed_from_m_per_s: float
    speed_to_m_per_s: float
    tension_from_n: list[float | None]  #: (n,); null: a span without a load cell
    tension_to_n: list[float | None]


class ModelValidation(Strict):
    """How the model did on data that it was not made from."""

    samples: Annotated[int, Field(ge=1)]
    innovation_tension: list[NonNegative | None]  #: (n,), mean square over what the model expects; 1 is right
    innovation_speed: list[NonNegative]  #: (n,)
    r2_tension: Annotated[float, Field(le=1.0)] | None  #: null: nothing moved
    r2_speed: Annotated[float, Field(le=1.0)] | None
    mae_tension_n: NonNegative
    mae_speed_m_per_s: NonNegative
    whiteness: Literal["white", "coloured", "not tested"]  #: of the innovations


class ChannelDelay(Strict):
    """How much later a channel tells than the others, as found in the data and taken out."""

    channel: Text
    late_s: float
    low_s: float
    high_s: float


class LineModel(Strict):
    format: Annotated[int, Field(ge=1, le=1)]
    site: Name
    line: Name
    created: Instant
    program_version: Text
    method: Text
    structure: ModelStructure
    parameters: ModelParameters
    noise: ModelNoise | None  #: null: the method says nothing of it
    confidence: Annotated[float, Field(ge=0.95, le=0.95)] = 0.95  #: of the intervals
    intervals: dict[str, ModelInterval]  #: by the names of `UNITS`
    data: ModelData
    region: ModelRegion
    validation: ModelValidation | None = None
    alignment: list[ChannelDelay] = []
    parent: Digest | None = None  #: the model that was the prior; null: the line's file
    #: null: the method gives none, or the file is older. Not written then: models from before it keep their hash.
    posterior: ModelPosterior | None = Field(default=None, exclude_if=lambda value: value is None)

    @property
    def n(self) -> int:
        return self.parameters.n

    @model_validator(mode="after")
    def _check(self) -> Self:
        lengths = [*_wrong_lengths(self)]
        wrong = [*lengths, *_wrong_intervals(self), *_wrong_order(self)]
        if self.posterior is not None and not lengths:
            wrong += wrong_names(self.posterior, self.n, _by_base(self.parameters))
        if wrong:
            raise ValueError("; ".join(wrong))
        return self


def _by_base(given: ModelParameters) -> dict[str, list[float]]:
    """Values by name: one for the line, n for rollers and spans."""
    fields: dict[str, Any] = given.model_dump()
    return {name: value if isinstance(value, list) else [value] for name, value in fields.items()}


def _wrong_lengths(model: LineModel) -> Iterator[str]:
    """Lists that have not one entry per span."""
    given, region, validation = model.parameters, model.region, model.validation
    lists: dict[str, Sequence[object]] = {
        "parameters.radius_m": given.radius_m,
        "parameters.inertia_kg_m2": given.inertia_kg_m2,
        "parameters.friction_nms_per_rad": given.friction_nms_per_rad,
        "parameters.coulomb_nm": given.coulomb_nm,
        **({} if given.eccentricity is None else {"parameters.eccentricity": given.eccentricity}),
        "region.tension_from_n": region.tension_from_n,
        "region.tension_to_n": region.tension_to_n,
    }
    if validation is not None:
        lists["validation.innovation_tension"] = validation.innovation_tension
        lists["validation.innovation_speed"] = validation.innovation_speed
    for name, values in lists.items():
        if len(values) != model.n:
            yield f"{name} has {len(values)} entries; allowed: {model.n}, one per span, as in parameters.length_m"


def _wrong_intervals(model: LineModel) -> Iterator[str]:
    for name, interval in model.intervals.items():
        yield from (f"intervals.{name}: {fault}" for fault in wrong_name(name, model.n, tuple(UNITS)))
        if not interval.low <= interval.value <= interval.high:
            yield (
                f"intervals.{name} is {interval.value:g} from {interval.low:g} to {interval.high:g}; allowed: a value "
                "between its ends"
            )


def _wrong_order(model: LineModel) -> Iterator[str]:
    """Ranges whose end lies before their beginning."""
    region = model.region
    tensions = zip(region.tension_from_n, region.tension_to_n, strict=False)  # lengths are told elsewhere
    ranges = [("region.speed_from_m_per_s", region.speed_from_m_per_s, region.speed_to_m_per_s)]
    ranges += [(f"alignment[{i}].low_s", one.low_s, one.high_s) for i, one in enumerate(model.alignment, 1)]
    for i, (low, high) in enumerate(tensions, 1):
        if (low is None) is not (high is None):
            yield f"region.tension_from_n[{i}] and tension_to_n[{i}]: one is null; allowed: both or none"
        elif low is not None and high is not None:
            ranges.append((f"region.tension_from_n[{i}]", low, high))
    yield from (f"{key} is {low:g}, the end of its range {high:g}: below it" for key, low, high in ranges if low > high)


def canonical(model: LineModel) -> bytes:
    """The one byte representation of a model, the same whoever writes it."""
    return canonical_bytes(model)


def model_hash(model: LineModel) -> str:
    """SHA-256 of the canonical bytes, in hexadecimal."""
    return hashlib.sha256(canonical(model)).hexdigest()


def parse_model(payload: bytes) -> LineModel:
    """The model in `payload` (JSON). Raises ModelRefused with every reason."""
    try:
        return model_of(document_of(payload))
    except NotJson as error:
        raise ModelRefused([str(error)]) from error


def model_of(document: dict[str, Any]) -> LineModel:
    """The model of a parsed file, or of fields. Raises ModelRefused with every reason."""
    try:
        return LineModel.model_validate(document)
    except ValidationError as error:
        raise ModelRefused(problems(error, LineModel)) from error


def parameters_of(theta: Theta) -> dict[str, Any]:
    """The fields of `ModelParameters`."""
    web = theta.web
    return {
        "stiffness_n": float(web.stiffness_n),
        "length_m": web.length_m.tolist(),
        "radius_m": web.radius_m.tolist(),
        "inertia_kg_m2": web.inertia_kg_m2.tolist(),
        "friction_nms_per_rad": web.friction_nms_per_rad.tolist(),
        "coulomb_nm": theta.coulomb_nm.tolist(),
        "torque_lag_s": float(theta.torque_lag_s),
        "latency_s": float(theta.latency_s),
        "tension_before_n": float(web.tension_before_n),
        "tension_after_n": float(web.tension_after_n),
        **({"eccentricity": theta.eccentricity.tolist()} if theta.eccentricity.any() else {}),
    }


def theta_of(model: LineModel) -> Theta:
    given = model.parameters
    web = WebModel(
        given.stiffness_n, np.array(given.length_m), np.array(given.radius_m), np.array(given.inertia_kg_m2),
        np.array(given.friction_nms_per_rad), given.tension_before_n, given.tension_after_n,
    )  # fmt: skip
    return Theta(
        web, np.array(given.coulomb_nm), given.torque_lag_s, given.latency_s, np.array(given.eccentricity or ())
    )


def noise_of(model: LineModel) -> Noise | None:
    return None if model.noise is None else Noise(**model.noise.model_dump())
