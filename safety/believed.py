"""The plants that the truth may be: corners of the accepted model, or of the tolerances of the line's file."""

from dataclasses import replace
from math import log

import numpy as np

from gateway.control.corners import corners, corners_of_line
from gateway.core.line import Gate, Line, Parameter
from gateway.core.line_model import LineModel
from gateway.core.line_model_posterior import ModelPosterior
from gateway.core.signals import FloatArray
from gateway.core.theta import Theta, nominal_theta

TWO_SIDED_95 = 1.96  #: standard deviations to the ends of an interval
PHYSICAL = ("stiffness_n", "length_m", "radius_m", "inertia_kg_m2", "friction_nms_per_rad")


class Unbelievable(ValueError):
    """The model does not say how sure it is."""


def corners_of_model(model: LineModel, gate: Gate, latency_s: float, seed: int) -> list[Theta]:
    """Of the joint posterior, or of intervals taken for independent where the file has none. Raises Unbelievable."""
    whole = model.model_copy(update={"posterior": posterior_of(model)})
    found = corners(whole, gate.corner_sigmas, gate.corner_least, gate.corners, seed)
    return [replace(theta, latency_s=latency_s) for theta in found]


def stated(model: LineModel) -> tuple[list[str], FloatArray]:
    """Names, and the covariance (k, k) of their logarithms, as the model states them. Raises Unbelievable."""
    posterior = posterior_of(model)
    return posterior.names, np.array(posterior.covariance)


def prior_corners(line: Line, latency_s: float, seed: int) -> list[Theta]:
    """At a share of the tolerances of the line's file; friction, lag and latency are what the gate stresses."""
    share, count = line.gate.first_corner_share, line.gate.corners
    nominal = nominal_theta(line)
    return [
        replace(nominal, web=theta.web, latency_s=latency_s)
        for theta in corners_of_line(_narrowed(line, share), count, seed)
    ]


def _narrowed(line: Line, share: float) -> Line:
    """With a share of its tolerances."""

    def of(parameter: Parameter) -> Parameter:
        return Parameter(value=parameter.value, tolerance=share * parameter.tolerance)

    rollers = [
        roller.model_copy(
            update={
                "radius_m": of(roller.radius_m),
                "inertia_kg_m2": of(roller.inertia_kg_m2),
                "friction_nms_per_rad": of(roller.friction_nms_per_rad),
            }
        )
        for roller in line.rollers
    ]
    spans = [span.model_copy(update={"length_m": of(span.length_m)}) for span in line.spans]
    web = line.web.model_copy(update={"stiffness_n": of(line.web.stiffness_n)})
    return line.model_copy(update={"rollers": rollers, "spans": spans, "web": web})


def posterior_of(model: LineModel) -> ModelPosterior:
    """The model's, or one of independent parameters, as its intervals have them. Raises Unbelievable."""
    if model.posterior is not None:
        return model.posterior
    names = [name for name in model.intervals if name.split("[")[0] in PHYSICAL and model.intervals[name].low > 0.0]
    known = {base for base in PHYSICAL if base in names or {f"{base}[{i}]" for i in range(1, model.n + 1)} <= {*names}}
    if missing := [base for base in PHYSICAL if base not in known]:
        raise Unbelievable(
            f"the model has neither a posterior nor an interval of {', '.join(missing)}: nobody knows how wrong it "
            "may be; identify again"
        )
    spread = [(log(model.intervals[n].high) - log(model.intervals[n].low)) / (2.0 * TWO_SIDED_95) for n in names]
    return ModelPosterior(names=names, covariance=np.diag(np.square(spread)).tolist())
