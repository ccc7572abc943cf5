"""From the combinations that running data show to physical parameters, with the equipment's data as prior.

Regressions of the paper's two equations see f/J, R/J, R^2/J and c R/J of a roller, EA/L and 1/L of a span. EA and L
apart, and R and J, show weakly, so that what a regression says is kept as normal equations, which may be singular, and
the logarithms of the physical parameters are fitted to all of them and to the prior at once.
"""

from dataclasses import dataclass, replace
from math import sqrt

import numpy as np
from scipy.optimize import least_squares

from gateway.core.line import Line
from gateway.core.line import Parameter as Value
from gateway.core.signals import FloatArray
from gateway.core.theta import Theta, nominal_theta
from gateway.core.web_model import WebModel
from gateway.identification.estimate import Interval, Structure

ROLLER = 4  #: combinations of a roller: f/J, R/J, R^2/J, c R/J
SPAN = 2  #: of a span: EA/L, 1/L

_Z95 = 1.96
_LOG_BOUND = 3.0  #: of a factor: no prior is so wide
_COULOMB_SHARE = 0.05  #: standard deviation of the prior of Coulomb friction, of the permitted torque
_SAME = 1e-9  #: difference of two logarithms
_SINGULAR = 1e-12  #: eigenvalues below this part of the largest tell nothing
_STIFFNESS, _LENGTH, _RADIUS, _INERTIA, _FRICTION, _COULOMB = range(6)


@dataclass(frozen=True)
class Evidence:
    """Normal equations M c = m of roller and span combinations, weighted to unit variance of a residual.

    With `period_s` above 0 a roller's are those of the sampled equation: each is smaller by (1 - exp(-bh)) / bh, b =
    f/J, as the response of its speed to what stands for a period h.
    """

    roller_information: FloatArray  #: (n, 4, 4)
    roller_moment: FloatArray  #: (n, 4)
    span_information: FloatArray  #: (n, 2, 2)
    span_moment: FloatArray  #: (n, 2)
    period_s: float = 0.0


@dataclass(frozen=True)
class Fit:
    theta: Theta
    intervals: dict[str, Interval]


class _Layout:
    """Which of the fitted numbers is which parameter of which roller or span."""

    def __init__(self, line: Line, structure: Structure) -> None:
        n = self.n = line.n
        each = n if structure.per_roller else 1
        web, rollers, spans = line.web, line.rollers, line.spans
        values: list[list[Value]] = [
            [web.stiffness_n], [span.length_m for span in spans], [roller.radius_m for roller in rollers],
            [roller.inertia_kg_m2 for roller in rollers], [roller.friction_nms_per_rad for roller in rollers],
        ]  # fmt: skip
        counts = [1, each, each, each, each, each if structure.coulomb else 0]
        starts = np.concatenate(([0], np.cumsum(counts)))
        self.size = int(starts[-1])
        self.coulomb = slice(int(starts[_COULOMB]), self.size)
        #: (6, n), of each parameter and roller; -1: not fitted
        self.at = np.array([start + np.arange(n) % count if count else np.full(n, -1)
                            for start, count in zip(starts[:-1].tolist(), counts, strict=True)])  # fmt: skip
        self.nominal = np.array([[value.value for value in column] * (n // len(column)) for column in values])
        tolerance = np.array([[value.tolerance for value in column] * (n // len(column)) for column in values])
        spread = np.log1p(tolerance) / sqrt(3.0)
        self.spread = np.full(self.size, _COULOMB_SHARE * line.limits.torque_nm)
        for index in range(int(starts[_COULOMB])):
            self.spread[index] = spread[self.at[:_COULOMB] == index].mean()

    def parameters(self, fitted: FloatArray) -> FloatArray:
        """(6, n)"""
        factors: FloatArray = np.exp(fitted[self.at[:_COULOMB]])
        coulomb = fitted[self.at[_COULOMB]] if self.size > self.coulomb.start else np.zeros(self.n)
        return np.vstack((self.nominal * factors, coulomb))


# d log(combination) / d log(EA, L, R, J, f)
_OF_ROLLER = np.array([[0, 0, 0, -1, 1], [0, 0, 1, -1, 0], [0, 0, 2, -1, 0], [0, 0, 1, -1, 0]], dtype=np.float64)
_OF_SPAN = np.array([[1, -1, 0, 0, 0], [0, -1, 0, 0, 0]], dtype=np.float64)


def fit(line: Line, structure: Structure, evidence: Evidence) -> Fit:
    """The parameters with the greatest posterior density, and their 95 % intervals.

    The prior is log-normal around the line's file; a tolerance t is a standard deviation of log(1 + t) / sqrt(3).
    Raises ValueError for a structure with a torque lag, which these regressions do not see.
    """
    if structure.torque_lag:
        raise ValueError("regressions on running data do not tell a torque lag; allowed: a structure without it")
    layout = _Layout(line, structure)
    problem = _Problem(layout, evidence)
    bound = np.full(layout.size, _LOG_BOUND)
    low = -bound
    bound[layout.coulomb] = np.inf
    low[layout.coulomb] = -1e-9
    start = np.zeros(layout.size)
    found = least_squares(problem.residuals, start, problem.jacobian, (low, bound), x_scale=layout.spread)
    fitted: FloatArray = np.array(found.x)
    slopes = problem.jacobian(fitted)
    covariance: FloatArray = np.linalg.inv(slopes.T @ slopes).astype(np.float64)
    fitted[layout.coulomb] = np.maximum(fitted[layout.coulomb], 0.0)
    theta = _theta(line, layout.parameters(fitted))
    return Fit(theta, _intervals(layout, structure, fitted, covariance))


class _Problem:
    """Residuals of unit variance: evidence of rollers, of spans, prior."""

    def __init__(self, layout: _Layout, evidence: Evidence) -> None:
        self._layout, self._period_s = layout, evidence.period_s
        rollers, spans = self._combinations(layout.parameters(np.zeros(layout.size)))
        scale = np.hstack((rollers, spans))
        scale[:, ROLLER - 1] = rollers[:, 1]  # for a Coulomb friction of 1 Nm
        self._root = np.zeros((layout.n, ROLLER + SPAN, ROLLER + SPAN))
        self._goal = np.zeros((layout.n, ROLLER + SPAN))
        for part, information, moment in (
            (slice(0, ROLLER), evidence.roller_information, evidence.roller_moment),
            (slice(ROLLER, None), evidence.span_information, evidence.span_moment),
        ):
            for i in range(layout.n):
                root, goal = _root(information[i], moment[i], scale[i, part])
                self._root[i, part, part], self._goal[i, part] = root, goal

    def residuals(self, fitted: FloatArray) -> FloatArray:
        combinations = np.hstack(self._combinations(self._layout.parameters(fitted)))
        found = np.einsum("ijk,ik->ij", self._root, combinations) - self._goal
        return np.concatenate((found.ravel(), fitted / self._layout.spread))

    def jacobian(self, fitted: FloatArray) -> FloatArray:
        layout = self._layout
        parameters = layout.parameters(fitted)
        rollers, spans = self._combinations(parameters)
        slopes = np.zeros((layout.n, ROLLER + SPAN, layout.size))
        own = np.arange(layout.n)
        b_h = parameters[_FRICTION] / parameters[_INERTIA] * self._period_s
        for name in range(_COULOMB):
            of_rollers = rollers * (_OF_ROLLER[:, name] + _OF_ROLLER[0, name] * log_slope(b_h)[:, None])
            slopes[own, :, layout.at[name]] += np.hstack((of_rollers, spans * _OF_SPAN[:, name]))
        if layout.size > layout.coulomb.start:
            slopes[own, ROLLER - 1, layout.at[_COULOMB]] = rollers[:, 1]
        found = np.einsum("ijk,ikp->ijp", self._root, slopes).reshape(-1, layout.size)
        return np.vstack((found, np.diag(1.0 / layout.spread)))

    def _combinations(self, parameters: FloatArray) -> tuple[FloatArray, FloatArray]:
        """(n, 4) and (n, 2)"""
        stiffness, length, radius, inertia, friction, coulomb = parameters
        rate = friction / inertia
        torque = radius / inertia
        rollers = np.stack((rate, torque, radius * torque, coulomb * torque), axis=1)
        return rollers * _held(rate * self._period_s)[:, None], np.stack((stiffness / length, 1.0 / length), axis=1)


def _held(b_h: FloatArray) -> FloatArray:
    """(1 - exp(-x)) / x: what is left of a constant acceleration after a period."""
    return np.where(b_h > 0.0, -np.expm1(-b_h) / np.maximum(b_h, 1e-12), 1.0)


def log_slope(b_h: FloatArray) -> FloatArray:
    """d log((1 - exp(-x)) / x) / d log x."""
    return np.where(b_h > 0.0, np.exp(-b_h) / _held(b_h) - 1.0, 0.0)


def _root(information: FloatArray, moment: FloatArray, scale: FloatArray) -> tuple[FloatArray, FloatArray]:
    """W and w such that |W c - w|^2 is, but for a constant, c' M c - 2 m' c. `scale`: what c is about."""
    values, vectors = np.linalg.eigh(information * np.outer(scale, scale))
    known = values > _SINGULAR * max(float(values[-1]), 1e-300)
    root = np.sqrt(np.where(known, values, 0.0))
    goal = np.where(known, vectors.T @ (scale * moment), 0.0) / np.where(known, root, 1.0)
    return root[:, None] * vectors.T / scale, goal


def _theta(line: Line, parameters: FloatArray) -> Theta:
    nominal = nominal_theta(line)
    stiffness, length, radius, inertia, friction, coulomb = parameters
    web = WebModel(
        stiffness_n=float(stiffness[0]),
        length_m=length,
        radius_m=radius,
        inertia_kg_m2=inertia,
        friction_nms_per_rad=friction,
        tension_before_n=nominal.web.tension_before_n,
        tension_after_n=nominal.web.tension_after_n,
    )
    return replace(nominal, web=web, coulomb_nm=coulomb)


# Logarithms of what is told as weighted sums of those of EA, L, R, J, f.
_TOLD = {
    "stiffness_n": (1, 0, 0, 0, 0),
    "length_m": (0, 1, 0, 0, 0),
    "radius_m": (0, 0, 1, 0, 0),
    "inertia_kg_m2": (0, 0, 0, 1, 0),
    "friction_nms_per_rad": (0, 0, 0, 0, 1),
    "stiffness_per_length": (1, -1, 0, 0, 0),
    "radius_per_inertia": (0, 0, 1, -1, 0),
    "friction_per_inertia": (0, 0, 0, -1, 1),
    "radius2_per_inertia": (0, 0, 2, -1, 0),
}


def _intervals(
    layout: _Layout, structure: Structure, fitted: FloatArray, covariance: FloatArray
) -> dict[str, Interval]:
    intervals: dict[str, Interval] = {}
    logs = np.log(layout.parameters(fitted)[:_COULOMB])
    for name, powers in _TOLD.items():
        weights = np.zeros((layout.n, layout.size))
        for parameter, power in enumerate(powers):
            weights[np.arange(layout.n), layout.at[parameter]] += power
        spread = _Z95 * np.sqrt(np.einsum("ij,jk,ik->i", weights, covariance, weights))
        middle = np.array(powers) @ logs
        found = [Interval(*np.exp([m, m - s, m + s]).tolist()) for m, s in zip(middle, spread, strict=True)]
        same = not structure.per_roller and bool(np.ptp(middle) < _SAME)
        intervals |= _named(name, found, same or name == "stiffness_n")
    if structure.coulomb:
        at = layout.at[_COULOMB]
        spread = _Z95 * np.sqrt(np.diag(covariance))[at]
        pairs = zip(fitted[at].tolist(), spread.tolist(), strict=True)
        found = [Interval(c, max(c - s, 0.0), c + s) for c, s in pairs]
        intervals |= _named("coulomb_nm", found, not structure.per_roller)
    return intervals


def _named(name: str, found: list[Interval], one_for_all: bool) -> dict[str, Interval]:
    if one_for_all:
        return {name: found[0]}
    return {f"{name}[{i}]": interval for i, interval in enumerate(found, start=1)}
