"""From an estimate to the record that is kept of it: the model file."""

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from gateway.core.line_model import ChannelDelay, LineModel, ModelValidation, model_of, parameters_of
from gateway.core.posterior import Posterior
from gateway.core.recording import Recording
from gateway.core.signals import BoolArray, FloatArray
from gateway.identification.estimate import Estimate


@dataclass(frozen=True)
class Origin:
    """Where a model comes from, beside its data. Its maker says when: nothing here reads a clock."""

    site: str
    line: str
    created: str  #: ISO 8601, with zone
    program_version: str
    parent: str | None = None  #: hash of the model that was the prior; None: the line's file


def model_from(
    estimate: Estimate,
    recording: Recording,
    origin: Origin,
    validation: ModelValidation | None = None,
    alignment: Sequence[ChannelDelay] = (),
) -> LineModel:
    """The record of `estimate`, which was made from `recording`. Raises ModelRefused with every reason against it."""
    return model_of(
        {
            "format": 1,
            **asdict(origin),
            "method": estimate.method,
            "structure": asdict(estimate.structure),
            "parameters": parameters_of(estimate.theta),
            "noise": None if estimate.noise is None else asdict(estimate.noise),
            "intervals": {name: asdict(interval) for name, interval in estimate.intervals.items()},
            "data": {
                "digest": recording.digest(),
                "source": recording.source,
                "samples": int(estimate.samples),
                "period_s": recording.period_s,
            },
            "region": _region(recording),
            "validation": None if validation is None else validation.model_dump(),
            "alignment": [delay.model_dump() for delay in alignment],
            "posterior": None if estimate.posterior is None else _posterior(estimate.posterior),
        }
    )


def _posterior(posterior: Posterior) -> dict[str, Any]:
    """Its mean is the parameters' own."""
    return {"names": list(posterior.names), "covariance": posterior.covariance.tolist()}


def _region(recording: Recording) -> dict[str, Any]:
    """What the data went through while the loop had the line. NaN, which no file takes, where it never did."""
    seen = recording.controlled
    speed = recording.unwind_speed_m_per_s[seen]
    spans = [_range(tension) for tension in recording.tension_n[seen].T]
    low, high = _range(speed)
    return {
        "speed_from_m_per_s": low,
        "speed_to_m_per_s": high,
        "tension_from_n": [None if np.isnan(least) else least for least, _ in spans],
        "tension_to_n": [None if np.isnan(most) else most for _, most in spans],
    }


def _range(values: FloatArray) -> tuple[float, float]:
    known: BoolArray = np.isfinite(values)
    if not known.any():
        return np.nan, np.nan
    return float(values[known].min()), float(values[known].max())
