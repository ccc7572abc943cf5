"""Which rollers run out of true: each that the data give more evidence than it costs to have its swings.

A swing is looked for at the frequency of its roller, v/2 pi R. After some turns that tells the radius to a percent, and
a radius that is off by ten has the swing out of step with the data. So it is looked for at many radii first.
"""

from dataclasses import replace
from math import log

import numpy as np

from gateway.control.prediction import Stretch, gains_of
from gateway.core.signals import BoolArray, CountArray, FloatArray
from gateway.identification.prediction_error import SWING_SD, Fit, NormalEquations, normal_equations

ENOUGH = 3.0  #: log evidence, 20 to 1, for each roller
IN_STEP_RAD = 0.6  #: between neighbouring radii, of the longest turn in the data; more where that were too many
FAR = 3.0  #: standard deviations of the prior to which radii are looked at
LEAST_RADII, MOST_RADII = 3, 61
AT_ONE_RADIUS = ("radius_m", "inertia_kg_m2", "friction_nms_per_rad")  #: what else goes with it, so that R/J, f/J stay


def with_swings(fitted: Fit) -> tuple[FloatArray, list[Stretch]] | None:
    """Where a fit with eccentric rollers may begin: log-parameters (p,), and the stretches with their swings.

    At the radius, one factor for all, at which swings have most evidence. None where they have not enough at any.
    `fitted` has round rollers, which make its radius anything, and knows R/J and f/J all the same.
    """
    names, prior = fitted.parameters.names, fitted.prior
    at = [names.index(name) for name in AT_ONE_RADIUS]
    radius_m = float(fitted.parameters.theta(prior.mean).web.radius_m.min())
    turned = max(float(np.ptp(stretch.travelled_m, axis=0).max()) for stretch in fitted.stretches) / radius_m
    reach = FAR * float(np.sqrt(prior.covariance[at[0], at[0]]))
    count = min(max(2 * round(reach * turned / IN_STEP_RAD) + 1, LEAST_RADII), MOST_RADII)
    best, found = ENOUGH + log(count), None
    for away in np.linspace(-reach, reach, count).tolist():
        logs = fitted.logs.copy()
        logs[at] += prior.mean[at[0]] + away - fitted.logs[at[0]]
        _, evidence = _shown(fitted, logs)
        if evidence > best:
            best, found = evidence, logs
    return None if found is None else (found, _swung(fitted, found))


def eccentric_rollers(fitted: Fit) -> tuple[int, ...]:
    """Rollers, from 1, whose turns the data of a fit show, whatever its own structure says of them."""
    return _shown(fitted, fitted.logs)[0]


def _shown(fitted: Fit, logs: FloatArray) -> tuple[tuple[int, ...], float]:
    """Rollers, from 1, whose turns the data show around these log-parameters; with their log evidence.

    There everything is linear: the evidence of any set of rollers stands in one set of normal equations, and the set
    grows by the roller that adds most.
    """
    gradient, information, roller = _swings_of(fitted, logs)
    n = int(roller.max()) + 1
    chosen: list[int] = []
    evidence = 0.0
    while len(chosen) < n:
        tried = {
            i: _evidence(gradient, information, np.isin(roller, [*chosen, i])) for i in range(n) if i not in chosen
        }
        best = max(tried, key=lambda i: tried[i])
        if tried[best] < evidence + ENOUGH:
            break
        chosen.append(best)
        evidence = tried[best]
    return tuple(sorted(i + 1 for i in chosen)), evidence


def _swung(fitted: Fit, logs: FloatArray) -> list[Stretch]:
    """With the swings of all rollers that are likeliest with these log-parameters."""
    equations = _equations(fitted, logs)
    nothing = np.zeros(len(logs))
    return [
        replace(stretch, swing=stretch.swing + part.step(nothing))
        for stretch, part in zip(fitted.stretches, equations.swings, strict=True)
    ]


def _equations(fitted: Fit, logs: FloatArray) -> NormalEquations:
    """With the swings of all rollers."""
    theta, stretches = fitted.parameters.theta(logs), fitted.stretches
    gains = [gains_of(theta, fitted.noise, stretch) for stretch in stretches]
    return normal_equations(fitted.parameters, logs, stretches, gains, np.arange(theta.n))


def _swings_of(fitted: Fit, logs: FloatArray) -> tuple[FloatArray, FloatArray, CountArray]:
    """Gradient (q,) and information (q, q) of all stretches' swings around none; whose each is, from 0 (q,)."""
    swings = [stretch.swing for stretch in fitted.stretches]
    gradient, information = _eliminated(fitted, logs, _equations(fitted, logs), np.concatenate(swings).ravel())
    return gradient, information, np.tile(np.repeat(np.arange(len(swings[0])), 2), len(swings))


def _eliminated(
    fitted: Fit, logs: FloatArray, found: NormalEquations, swing: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Gradient (q,) and information (q, q) of the swings around none, the log-parameters eliminated."""
    weight = np.linalg.inv(fitted.prior.covariance)
    crossed = np.hstack([part.crossed for part in found.swings])
    slope = found.gradient + weight @ (logs - fitted.prior.mean)
    solved = np.linalg.solve(found.information + weight, np.column_stack((slope, crossed)))
    information = -crossed.T @ solved[:, 1:]
    begin = 0
    for part in found.swings:
        own = slice(begin, begin + len(part.gradient))
        information[own, own] += part.information
        begin = own.stop
    gradient = np.concatenate([part.gradient for part in found.swings]) - crossed.T @ solved[:, 0]
    return gradient - information @ swing, information


def _evidence(gradient: FloatArray, information: FloatArray, some: BoolArray) -> float:
    """Log evidence of these swings (q,) over that of none."""
    own, slope = information[np.ix_(some, some)], gradient[some]
    _, scale = np.linalg.slogdet(SWING_SD**2 * own)
    return 0.5 * float(slope @ np.linalg.solve(own, slope)) - 0.5 * float(scale)
