"""The plants that the truth may be: corners of the accepted model, or of the tolerances of the line's file."""

from dataclasses import replace
from math import log

import numpy as np

from gateway.control.corners import corners, corners_of_line
from gateway.core.line import Gate, Line
from gateway.core.line_model import LineModel
from gateway.core.line_model_posterior import ModelPosterior
from gateway.core.theta import Theta

PRIOR_CORNERS = 32  #: of the line's file
TWO_SIDED_95 = 1.96  #: standard deviations to the ends of an interval
PHYSICAL = ("stiffness_n", "length_m", "radius_m", "inertia_kg_m2", "friction_nms_per_rad")


class Unbelievable(ValueError):
    """The model does not say how sure it is."""


def corners_of_model(model: LineModel, gate: Gate, latency_s: float, seed: int) -> list[Theta]:
    """Of the joint posterior, or of intervals taken for independent where the file has none. Raises Unbelievable."""
    whole = model if model.posterior is not None else _of_intervals(model)
    found = corners(whole, gate.corner_sigmas, gate.corner_least, gate.corners, seed)
    return [replace(theta, latency_s=latency_s) for theta in found]


def prior_corners(line: Line, latency_s: float, seed: int) -> list[Theta]:
    """Of the tolerances of the line's file, around the measured latency."""
    shift_s = latency_s - line.control.latency_s
    found = corners_of_line(line, PRIOR_CORNERS, seed)
    return [replace(theta, latency_s=max(0.0, theta.latency_s + shift_s)) for theta in found]


def _of_intervals(model: LineModel) -> LineModel:
    """With a posterior of independent parameters, as its intervals have them."""
    names = [name for name in model.intervals if name.split("[")[0] in PHYSICAL and model.intervals[name].low > 0.0]
    if missing := [base for base in PHYSICAL if not any(name.split("[")[0] == base for name in names)]:
        raise Unbelievable(
            f"the model has neither a posterior nor an interval of {', '.join(missing)}: nobody knows how wrong it "
            "may be; identify again"
        )
    spread = [(log(model.intervals[n].high) - log(model.intervals[n].low)) / (2.0 * TWO_SIDED_95) for n in names]
    posterior = ModelPosterior(names=names, covariance=np.diag(np.square(spread)).tolist())
    return model.model_copy(update={"posterior": posterior})
