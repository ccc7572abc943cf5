"""Which rollers run out of true: each that the data give more evidence than it costs to have its swings."""

import numpy as np

from gateway.control.prediction import gains_of
from gateway.core.signals import BoolArray, FloatArray
from gateway.identification.prediction_error import SWING_SD, Fit, NormalEquations, normal_equations

ENOUGH = 3.0  #: log evidence, 20 to 1, for each roller


def eccentric_rollers(fitted: Fit) -> tuple[int, ...]:
    """Rollers, from 1, whose turns the data of a fit show, whatever its own structure says of them.

    Around the fit everything is linear: the evidence of any set of rollers stands in one set of normal equations, and
    the set grows by the roller that adds most.
    """
    stretches = fitted.stretches
    theta = fitted.parameters.theta(fitted.logs)
    gains = [gains_of(theta, fitted.noise, stretch) for stretch in stretches]
    n = theta.n
    every = np.arange(n)
    found = normal_equations(fitted.parameters, fitted.logs, stretches, gains, every)
    swing = np.concatenate([stretch.swing.ravel() for stretch in stretches])
    gradient, information = _of_swings(fitted, found, swing)
    roller = np.tile(np.repeat(every, 2), len(stretches))
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
    return tuple(sorted(i + 1 for i in chosen))


def _of_swings(fitted: Fit, found: NormalEquations, swing: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Gradient (q,) and information (q, q) of all stretches' swings around none, the log-parameters eliminated."""
    weight = np.linalg.inv(fitted.prior.covariance)
    crossed = np.hstack([part.crossed for part in found.swings])
    slope = found.gradient + weight @ (fitted.logs - fitted.prior.mean)
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
