"""The prediction error method: maximum of the posterior of the log-parameters, with the noise by maximum likelihood.

The cost is the paper's (eq. identification_objective) with weights that probability gives: innovations of the Kalman
predictor, whitened by their own covariance, and the distance from the prior, by the prior's. Gauss-Newton; the gains
belong to the theta of each step and are not differentiated: their derivative only multiplies past innovations, which
at the truth are uncorrelated with the present one, so that neither the estimate nor its covariance depends on it. The
noise follows by scoring between the steps.

Swings of eccentric rollers belong to a stretch, not to the line: they are linear, and are eliminated from each
stretch's part of the normal equations (Schur's complement), which is what integrating over them amounts to.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from math import log, pi

import numpy as np
from scipy.linalg import cho_factor, cho_solve

from gateway.control.eccentricity import SWING_STEP, swings_beside
from gateway.control.prediction import (
    Gains,
    Stretch,
    Unpredictable,
    Unwinder,
    gains_of,
    imagined,
    innovations,
    predict,
    stretch_of,
    whitened,
)
from gateway.core.posterior import Posterior
from gateway.core.recording import Recording
from gateway.core.signals import CountArray, FloatArray
from gateway.core.theta import Noise, Theta
from gateway.identification.estimate import Estimate, Interval
from gateway.identification.noise import improved_noise
from gateway.identification.parameters import Parameters
from gateway.identification.prior import Prior

SWING_SD = 3e-3  #: of either part of a swing, before any data: 0.3 % of the radius
LEAST_S = 0.5  #: a stretch that is shorter tells too little to be used
Z95 = 1.959964  #: quantile of the normal distribution
_STEP = 1e-5  #: of a log-parameter, for sensitivities
_REACH = 0.7  #: longest step of a log-parameter
_BOUND = 6.0  #: standard deviations of the prior: nothing is looked for beyond
_ITERATIONS = 40
_SETTLED = 0.01  #: standard deviations of the posterior: a step that is no longer than this is the last
_LIKELIER = 3.0  #: by this much in the log-likelihood, twenty to one
_NOISE_SETTLED = 0.1  #: the same for the noise


@dataclass(frozen=True)
class Fit:
    """An estimate with everything that it rests on."""

    prior: Prior
    logs: FloatArray  #: (p,)
    covariance: FloatArray  #: (p, p) of the log-parameters, posterior (Laplace)
    information: FloatArray  #: (p, p), Fisher's, of the data alone
    noise: Noise
    stretches: list[Stretch]  #: with the swings that were found in them
    swing_covariances: list[FloatArray]  #: of each stretch, (2r, 2r), of its swings' cosines and sines in turn
    log_likelihood: float  #: of the data, at the estimate
    evidence: float  #: log marginal likelihood of the structure (Laplace), the noise at its best
    iterations: int
    converged: bool

    @property
    def parameters(self) -> Parameters:
        return self.prior.parameters

    @property
    def samples(self) -> int:
        return sum(stretch.predictions for stretch in self.stretches)

    @property
    def theta(self) -> Theta:
        amplitudes = np.zeros(self.parameters.base.n)
        for i in self.parameters.structure.eccentric:
            amplitudes[i - 1] = self.eccentricity(i).value
        return replace(self.parameters.theta(self.logs), eccentricity=amplitudes)

    def eccentricity(self, roller: int) -> Interval:
        """Of a roller, from 1, that the structure has as eccentric: amplitude over radius. Raises ValueError.

        The mean of its stretches, each with the weight that its deviation gives it.
        """
        j = 2 * self.parameters.structure.eccentric.index(roller)
        swings = np.array([stretch.swing[roller - 1] for stretch in self.stretches])
        amplitudes = np.hypot(swings[:, 0], swings[:, 1])
        along = swings / np.maximum(amplitudes, 1e-12)[:, None]
        covariances = np.array([covariance[j : j + 2, j : j + 2] for covariance in self.swing_covariances])
        weights = 1.0 / np.maximum(np.einsum("si,sij,sj->s", along, covariances, along), 1e-18)
        middle, deviation = float(np.average(amplitudes, weights=weights)), float(weights.sum()) ** -0.5
        return Interval(middle, max(middle - Z95 * deviation, 0.0), middle + Z95 * deviation)

    def interval(self, name: str) -> Interval:
        """Of 95 %. Raises KeyError."""
        row = self.parameters.maps[name]
        middle, deviation = float(row @ self.logs), float(np.sqrt(row @ self.covariance @ row))
        low, value, high = np.exp(middle + Z95 * deviation * np.array([-1.0, 0.0, 1.0])).tolist()
        return Interval(value, low, high)

    @property
    def estimate(self) -> Estimate:
        parameters = self.parameters
        return Estimate(
            method="prediction error",
            structure=parameters.structure,
            theta=self.theta,
            noise=self.noise,
            intervals={name: self.interval(name) for name in parameters.maps}
            | {f"eccentricity[{i}]": self.eccentricity(i) for i in parameters.structure.eccentric},
            samples=self.samples,
            posterior=Posterior(tuple(parameters.names), self.logs, self.covariance),
        )


def stretches_of(recordings: Sequence[Recording], unwinder: Unwinder = "linear") -> list[Stretch]:
    """All usable stretches. Raises Unpredictable when there is none."""
    found = [
        stretch_of(part, unwinder)
        for recording in recordings
        for part in recording.stretches(round(LEAST_S / recording.period_s))
    ]
    if not found:
        sources = ", ".join(recording.source for recording in recordings)
        raise Unpredictable(f"{sources}: no {LEAST_S} s in a row, under control, in which every signal is known")
    return found


def fit(recordings: Sequence[Recording], prior: Prior, noise0: Noise, unwinder: Unwinder | None = None) -> Fit:
    """The structure is that of the prior's parameters. How the unwinder's speed goes between samples: as the data say,
    unless it is known.

    Raises Unpredictable when the data hold nothing to use.
    """
    found = fit_stretches(stretches_of(recordings, unwinder or "linear"), prior, noise0)
    if unwinder is None:
        other = stretches_of(recordings, "held")
        if found.samples * (score(found, other) - score(found, found.stretches)) > _LIKELIER:
            return fit_stretches(other, prior, found.noise, start=found.logs)
    return found


def fit_stretches(
    stretches: list[Stretch], prior: Prior, noise0: Noise, *, start: FloatArray | None = None, know_noise: bool = False
) -> Fit:
    """From log-parameters `start` (p,), else from the prior's mean; `know_noise`: it is noise0.

    Swings begin with those of the stretches.
    """
    parameters, weight = prior.parameters, np.linalg.inv(prior.covariance)
    at = np.array(parameters.structure.eccentric, dtype=np.int64) - 1
    stretches = [replace(stretch, swing=_only(stretch.swing, at)) for stretch in stretches]
    reach = _BOUND * np.sqrt(np.diag(prior.covariance))
    logs = prior.mean.copy() if start is None else start.copy()
    noise, converged, iterations = noise0, False, 0
    while True:
        gains = [gains_of(parameters.theta(logs), noise, stretch) for stretch in stretches]
        found = normal_equations(parameters, logs, stretches, gains, at)
        gradient, information = found.reduced
        posterior = cho_factor(information + weight)
        if converged or iterations == _ITERATIONS:
            break
        iterations += 1
        step = -cho_solve(posterior, gradient + weight @ (logs - prior.mean))
        length = float(np.sqrt(step @ (information + weight) @ step + found.swings_reduce))
        swing_steps = [part.step(step) for part in found.swings]
        shorter = min(1.0, _REACH / max(float(np.abs(step).max()), 1e-12))
        before = found.cost + 0.5 * (logs - prior.mean) @ weight @ (logs - prior.mean)
        for _ in range(8):
            tried = np.clip(logs + shorter * step, prior.mean - reach, prior.mean + reach)
            away = tried - prior.mean
            moved = [
                replace(stretch, swing=_moved(stretch.swing, at, shorter * swing_step))
                for stretch, swing_step in zip(stretches, swing_steps, strict=True)
            ]
            if _cost(parameters, tried, moved, gains) + 0.5 * away @ weight @ away <= before + 1e-9 * abs(before):
                logs, stretches = tried, moved
                break
            shorter = 0.5 * shorter
        noise_length = 0.0
        if not know_noise:
            noise, noise_length = improved_noise(parameters.theta(logs), noise, noise0, stretches)
        converged = length < _SETTLED and noise_length < _NOISE_SETTLED
    covariance = cho_solve(posterior, np.eye(parameters.size))
    likelihood = -found.cost - _constant(stretches, gains)
    away = logs - prior.mean
    _, scale = np.linalg.slogdet(prior.covariance @ (information + weight))
    evidence = likelihood - 0.5 * float(away @ weight @ away) - 0.5 * float(scale) - 0.5 * found.swings_scale
    covariance = 0.5 * (covariance + covariance.T)
    return Fit(
        prior, logs, covariance, information, noise, stretches, [part.covariance(covariance) for part in found.swings],
        likelihood, evidence, iterations, converged,
    )  # fmt: skip


def score(fitted: Fit, stretches: Sequence[Stretch]) -> float:
    """Mean log-likelihood of a sample of data that the fit has not seen."""
    found = np.concatenate([predict(fitted.theta, fitted.noise, stretch).log_likelihood for stretch in stretches])
    return float(found.mean())


def bootstrap(fitted: Fit, draws: int, seed: int = 0) -> FloatArray:
    """Log-parameters (draws, p) estimated anew from data and prior means that the estimate itself would bring forth.

    A check on `Fit.covariance`, which they should have: it knows nothing of linearising. The noise is taken as known.
    """
    generator = np.random.default_rng(seed)
    theta, prior = fitted.parameters.theta(fitted.logs), fitted.prior
    gains = [gains_of(theta, fitted.noise, stretch) for stretch in fitted.stretches]
    root = np.linalg.cholesky(prior.covariance)
    found: list[FloatArray] = []
    for _ in range(draws):
        copies: list[Stretch] = []
        for stretch, own in zip(fitted.stretches, gains, strict=True):
            white = generator.standard_normal((stretch.predictions, len(stretch.outputs)))
            drawn: FloatArray = (own.factor[own.which] @ white[:, :, None])[:, :, 0]
            copies.append(imagined(theta, stretch, own, drawn))
        moved = replace(prior, mean=fitted.logs + root @ generator.standard_normal(len(root)))
        found.append(fit_stretches(copies, moved, fitted.noise, start=fitted.logs, know_noise=True).logs)
    return np.array(found)


@dataclass(frozen=True)
class SwingEquations:
    """One stretch's normal equations of its 2r swings, the prior's part among them."""

    crossed: FloatArray  #: (p, 2r), with the log-parameters
    information: FloatArray  #: (2r, 2r)
    gradient: FloatArray  #: (2r,)

    def step(self, of_logs: FloatArray) -> FloatArray:
        """Of the swings, (r, 2), that belongs to a step of the log-parameters."""
        found = np.linalg.solve(self.information, self.gradient + self.crossed.T @ of_logs)
        return -np.asarray(found, dtype=np.float64).reshape(-1, 2)

    def covariance(self, of_logs: FloatArray) -> FloatArray:
        """Posterior (2r, 2r), from that of the log-parameters."""
        along = np.linalg.solve(self.information, self.crossed.T)
        found: FloatArray = np.linalg.inv(self.information) + along @ of_logs @ along.T
        return found


@dataclass(frozen=True)
class NormalEquations:
    cost: float  #: half the sum of squared whitened innovations, and of swings over their prior deviation
    gradient: FloatArray  #: (p,)
    information: FloatArray  #: J'J (p, p)
    swings: list[SwingEquations]  #: of each stretch

    @property
    def reduced(self) -> tuple[FloatArray, FloatArray]:
        """Gradient and information of the log-parameters with the swings eliminated."""
        gradient, information = self.gradient.copy(), self.information.copy()
        for part in self.swings:
            solved = np.linalg.solve(part.information, np.column_stack((part.gradient, part.crossed.T)))
            gradient -= part.crossed @ solved[:, 0]
            information -= part.crossed @ solved[:, 1:]
        return gradient, information

    @property
    def swings_reduce(self) -> float:
        """Squared length of the swings' steps by themselves, in standard deviations."""
        return sum(float(part.gradient @ np.linalg.solve(part.information, part.gradient)) for part in self.swings)

    @property
    def swings_scale(self) -> float:
        """Logarithm of how much smaller than the prior's the volume is that the data leave to the swings."""
        return sum(float(np.linalg.slogdet(SWING_SD**2 * part.information)[1]) for part in self.swings)


def normal_equations(
    parameters: Parameters, logs: FloatArray, stretches: list[Stretch], gains: list[Gains], at: CountArray
) -> NormalEquations:
    """Around log-parameters (p,) and the stretches' swings, of the eccentric rollers `at` (r,), from 0."""
    p = parameters.size
    theta = parameters.theta(logs)
    columns = [theta, *(parameters.theta(logs + _STEP * row) for row in np.eye(p)), *[theta] * (2 * len(at))]
    cost, gradient, information = 0.0, np.zeros(p), np.zeros((p, p))
    swings: list[SwingEquations] = []
    for stretch, own in zip(stretches, gains, strict=True):
        beside = swings_beside(stretch.swing, at)
        every = np.concatenate((np.repeat(stretch.swing[None], p, axis=0), beside))
        residuals = whitened(innovations(columns, stretch, own, every)[0], own).reshape(len(columns), -1)
        jacobian = (residuals[1 : p + 1] - residuals[0]) / _STEP
        gradient += jacobian @ residuals[0]
        information += jacobian @ jacobian.T
        swing = stretch.swing[at].ravel()
        cost += 0.5 * float(residuals[0] @ residuals[0]) + 0.5 * float(swing @ swing) / SWING_SD**2
        response = (residuals[p + 1 :] - residuals[0]) / SWING_STEP
        swings.append(
            SwingEquations(
                jacobian @ response.T,
                response @ response.T + np.eye(len(response)) / SWING_SD**2,
                response @ residuals[0] + swing / SWING_SD**2,
            )
        )
    return NormalEquations(cost, gradient, information, swings)


def _only(swing: FloatArray, at: CountArray) -> FloatArray:
    """Of the rollers `at`; the others are round."""
    found = np.zeros_like(swing)
    found[at] = swing[at]
    return found


def _moved(swing: FloatArray, at: CountArray, by: FloatArray) -> FloatArray:
    found = swing.copy()
    found[at] += by
    return found


def _cost(parameters: Parameters, logs: FloatArray, stretches: list[Stretch], gains: list[Gains]) -> float:
    """As that of `normal_equations`; what overflows is no candidate."""
    total = 0.0
    for stretch, own in zip(stretches, gains, strict=True):
        total += 0.5 * float(np.square(stretch.swing).sum()) / SWING_SD**2
        total += 0.5 * float(np.square(whitened(innovations([parameters.theta(logs)], stretch, own)[0], own)).sum())
    return total if np.isfinite(total) else np.inf


def _constant(stretches: list[Stretch], gains: list[Gains]) -> float:
    """What the negative log-likelihood has beside the sum of squares."""
    return sum(
        0.5 * float(own.log_determinant.sum()) + 0.5 * stretch.predictions * len(stretch.outputs) * log(2.0 * pi)
        for stretch, own in zip(stretches, gains, strict=True)
    )
