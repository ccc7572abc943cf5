"""What the data themselves say of a model: that no other one near it explains them better than it admits.

With w the innovations (white, of size 1), J their derivative by the logarithms of what the model says it knows, F = J'J
and P the precision of the tolerances in the line's file:

    shift      d = -(F + P)^-1 J'w, a Gauss-Newton step, in units of what model and data leave open:
               d' (C + (F + P)^-1)^-1 d, C the covariance that the model states; of a true model chi-squared
    sureness   the least eigenvalue of C against (F + P)^-1: how much surer the model is than the data can make it
    noise      the gain in log-likelihood when one noise is taken half as large again, or as much smaller
    others     the log-likelihood against the model in service, or the line's file
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from math import inf, isfinite, isnan, log, sqrt

import numpy as np

from gateway.control.corners import moved
from gateway.control.prediction import Predicted, innovations, predict, whitened
from gateway.core.line import Line
from gateway.core.line_model import LineModel, noise_of, theta_of
from gateway.core.line_model_names import split_name
from gateway.core.signals import FloatArray
from gateway.core.theta import Noise, Theta, nominal_theta
from gateway.core.unnamed_terms import COULOMB_DIFFERS, ROLLERS_DIFFER, deviation, widest
from gateway.core.verdict import RuleFinding
from safety.believed import Unbelievable, stated
from safety.case import Case
from safety.findings import at_least, at_most, told
from safety.predicting import Foretold, foretold, foretold_of, normalised, with_swings

SHIFT, SURENESS, NOISE, OTHERS = "model: shift", "model: sureness", "model: noise", "model: held-out prediction"
MOST = 1000.0  #: moments of data that are looked at
SHIFT_MOST = 4.0  #: times the number of parameters
SURENESS_LEAST = 0.25  #: of the covariance that data and tolerances support: half the standard deviation
NOISE_FACTOR = 1.5
INSISTS = 10.0  #: a gain in log-likelihood with which data insist
PROBE = 1e-4
UNNAMED = 1.7  #: tolerance of what the line's file does not name: friction that is dry, lag, latency


@dataclass(frozen=True)
class Look:
    """A model on the recent, excited data."""

    theta: Theta
    noise: Noise
    found: list[Foretold]


def look_at(case: Case) -> Look:
    """Raises Unbelievable where there is nothing to look at."""
    noise = noise_of(case.model)
    if noise is None or not case.excited:
        raise Unbelievable("without the noise in the model, and data in which tensions move, nothing can be said")
    theta = theta_of(case.model)
    return Look(theta, noise, foretold_of(case, case.model, noise, MOST))


def check_sureness(case: Case) -> list[RuleFinding]:
    """Shift and sureness."""
    look, names, covariance = look_at(case), *stated(case.model)
    information, gradient = derivatives(look, names)
    scale = max(normalised(look.found), 1.0)  # what the noise does not explain is noise as well
    if not isfinite(scale):  # divided by it, any shift would be none
        return [told(SHIFT, False, "the model's predictions of the data run away: they say nothing of its numbers")]
    supported = np.linalg.inv(information / scale + prior_precision(case.line, names))
    step = -supported @ gradient / scale
    shift = float(step @ np.linalg.solve(covariance + supported, step))
    worst = int(np.argmax(np.abs(step) / np.sqrt(np.diag(covariance + supported))))
    more = _samples(case) / sum(one.predicted.stretch.predictions for one in look.found)
    root = np.linalg.cholesky(np.linalg.inv(supported) * more)
    least = float(np.linalg.eigvalsh(root.T @ covariance @ root)[0])
    most = SHIFT_MOST * len(names)
    return [
        at_most(
            SHIFT, shift, most, "",
            f"the data want {names[worst]} {100.0 * step[worst]:+.2f} % from where the model has it; in units of what "
            f"is open {shift:.1f}, allowed: up to {most:g}",
        ),
        at_least(
            SURENESS, least, SURENESS_LEAST, "",
            f"the model states {least:.2g} of the variance that its data support, in the direction of which it is "
            f"surest; allowed: {SURENESS_LEAST:g} and more",
        ),
        *_narrow_intervals(case.model, names, covariance),
    ]  # fmt: skip


def check_noise(case: Case) -> list[RuleFinding]:
    """Each noise of the model, against half as large again and as much smaller."""
    look = look_at(case)
    gains = {
        (name, way): _gain(look, replace(look.noise, **{name: getattr(look.noise, name) * factor}))
        for name in vars(look.noise)
        for way, factor in (("larger", NOISE_FACTOR), ("smaller", 1.0 / NOISE_FACTOR))
    }
    # What is no number is the greatest: a maximum would pass over it.
    (name, way), gain = max(gains.items(), key=lambda each: inf if isnan(each[1]) else each[1])
    text = (
        f"with noise.{name} {NOISE_FACTOR:g} times {way} than {getattr(look.noise, name):.3g} the data are likelier by "
        f"{gain:.3g} in the logarithm; allowed: up to {INSISTS:g}"
    )
    return [at_most(NOISE, gain, INSISTS, "", text)]


def check_others(case: Case) -> list[RuleFinding]:
    """Predictions of the same data by the model in service, or by the line's file."""
    look, before = look_at(case), case.context.model
    theta = nominal_theta(case.line) if before is None else theta_of(before)
    noise = look.noise if before is None else noise_of(before) or look.noise
    others = foretold(theta, noise, [one.part for one in look.found])
    gain = _log_likelihood(look.found) - _log_likelihood(others)
    whose = "the line's file" if before is None else "the model in service"
    text = f"the data are likelier by {gain:.4g} in the logarithm than by {whose}; allowed: {-INSISTS:g} and more"
    return [at_least(OTHERS, gain, -INSISTS, "", text)]


def derivatives(look: Look, names: Sequence[str]) -> tuple[FloatArray, FloatArray]:
    """F (p, p) and J'w (p,) over all parts."""
    information, gradient = np.zeros((len(names), len(names))), np.zeros(len(names))
    thetas = [look.theta, *(moved(look.theta, {name: PROBE}) for name in names)]
    for one in look.found:
        predicted: Predicted = one.predicted
        found, _ = innovations(thetas, with_swings(predicted), predicted.gains)
        white = whitened(found, predicted.gains).reshape(len(thetas), -1)
        J = (white[1:] - white[0]) / PROBE
        information += J @ J.T
        gradient += J @ white[0]
    return information, gradient


def prior_precision(line: Line, names: Sequence[str]) -> FloatArray:
    """P (p, p): uniform within the tolerance, as a variance; hardly any of what the file does not name.

    Rollers and spans of one line have the widest tolerance of any in common, and differ by less.
    """
    tolerances = {
        "stiffness_n": line.web.stiffness_n.tolerance,
        "length_m": widest(span.length_m for span in line.spans),
        "radius_m": widest(roller.radius_m for roller in line.rollers),
        "inertia_kg_m2": widest(roller.inertia_kg_m2 for roller in line.rollers),
        "friction_nms_per_rad": widest(roller.friction_nms_per_rad for roller in line.rollers),
    }
    families = [split_name(name)[0] for name in names]
    covariance = np.zeros((len(names), len(names)))
    for family in set(families):
        rows = np.flatnonzero([family == one for one in families])
        covariance[np.ix_(rows, rows)] = deviation(tolerances.get(family, UNNAMED)) ** 2
        if len(rows) > 1:
            differ = COULOMB_DIFFERS if family == "coulomb_nm" else 1.0
            covariance[rows, rows] += (differ * deviation(ROLLERS_DIFFER)) ** 2
    return np.asarray(np.linalg.inv(covariance), dtype=np.float64)


def _narrow_intervals(model: LineModel, names: Sequence[str], covariance: FloatArray) -> list[RuleFinding]:
    """Intervals that are narrower than the posterior beside them."""
    narrow = [
        name
        for name, variance in zip(names, np.diag(covariance).tolist(), strict=True)
        if name in model.intervals
        and model.intervals[name].low > 0.0
        and log(model.intervals[name].high / model.intervals[name].low) < 2.0 * 1.96 * sqrt(SURENESS_LEAST * variance)
    ]
    if not narrow:
        return []
    return [told(SURENESS, False, f"intervals of {', '.join(narrow)} are narrower than the model's own posterior")]


def _samples(case: Case) -> int:
    """That the model may have been made from: those of the context, and no more."""
    return sum(recording.samples for recording in case.recordings)


def _gain(look: Look, noise: Noise) -> float:
    others = [predict(look.theta, noise, one.predicted.stretch) for one in look.found]
    return sum(float(one.log_likelihood.sum()) for one in others) - _log_likelihood(look.found)


def _log_likelihood(found: Sequence[Foretold]) -> float:
    return sum(float(one.predicted.log_likelihood.sum()) for one in found)
