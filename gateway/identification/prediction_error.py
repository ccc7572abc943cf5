"""The prediction error method: maximum of the posterior of the log-parameters, with the noise by maximum likelihood.

The cost is the paper's (eq. identification_objective) with weights that probability gives: innovations of the Kalman
predictor, whitened by their own covariance, and the distance from the prior, by the prior's. Gauss-Newton; the gains
belong to the theta of each step and are not differentiated: their derivative only multiplies past innovations, which
at the truth are uncorrelated with the present one, so that neither the estimate nor its covariance depends on it. The
noise follows by scoring between the steps.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from math import log, pi

import numpy as np
from scipy.linalg import cho_factor, cho_solve

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
from gateway.core.signals import FloatArray
from gateway.core.theta import Noise
from gateway.identification.estimate import Estimate, Interval
from gateway.identification.noise import improved_noise
from gateway.identification.parameters import Parameters
from gateway.identification.prior import Prior

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
    stretches: list[Stretch]
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
            theta=parameters.theta(self.logs),
            noise=self.noise,
            intervals={name: self.interval(name) for name in parameters.maps},
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
    """From log-parameters `start` (p,), else from the prior's mean; `know_noise`: it is noise0."""
    parameters, weight = prior.parameters, np.linalg.inv(prior.covariance)
    reach = _BOUND * np.sqrt(np.diag(prior.covariance))
    logs = prior.mean.copy() if start is None else start.copy()
    noise, converged, iterations = noise0, False, 0
    while True:
        gains = [gains_of(parameters.theta(logs), noise, stretch) for stretch in stretches]
        cost, gradient, information = _normal_equations(parameters, logs, stretches, gains)
        posterior = cho_factor(information + weight)
        if converged or iterations == _ITERATIONS:
            break
        iterations += 1
        step = -cho_solve(posterior, gradient + weight @ (logs - prior.mean))
        length = float(np.sqrt(step @ (information + weight) @ step))
        step *= min(1.0, _REACH / max(float(np.abs(step).max()), 1e-12))
        before = cost + 0.5 * (logs - prior.mean) @ weight @ (logs - prior.mean)
        for _ in range(8):
            tried = np.clip(logs + step, prior.mean - reach, prior.mean + reach)
            away = tried - prior.mean
            if _cost(parameters, tried, stretches, gains) + 0.5 * away @ weight @ away <= before + 1e-9 * abs(before):
                logs = tried
                break
            step = 0.5 * step
        noise_length = 0.0
        if not know_noise:
            noise, noise_length = improved_noise(parameters.theta(logs), noise, noise0, stretches)
        converged = length < _SETTLED and noise_length < _NOISE_SETTLED
    covariance = cho_solve(posterior, np.eye(parameters.size))
    likelihood = -cost - _constant(stretches, gains)
    away = logs - prior.mean
    _, scale = np.linalg.slogdet(prior.covariance @ (information + weight))
    evidence = likelihood - 0.5 * float(away @ weight @ away) - 0.5 * float(scale)
    return Fit(
        prior, logs, 0.5 * (covariance + covariance.T), information, noise, stretches, likelihood, evidence, iterations,
        converged,
    )  # fmt: skip


def score(fitted: Fit, stretches: Sequence[Stretch]) -> float:
    """Mean log-likelihood of a sample of data that the fit has not seen."""
    theta = fitted.parameters.theta(fitted.logs)
    found = np.concatenate([predict(theta, fitted.noise, stretch).log_likelihood for stretch in stretches])
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


def _normal_equations(
    parameters: Parameters, logs: FloatArray, stretches: list[Stretch], gains: list[Gains]
) -> tuple[float, FloatArray, FloatArray]:
    """Half the sum of squared whitened innovations, its gradient (p,), and J'J (p, p)."""
    p = parameters.size
    columns = [parameters.theta(row) for row in np.vstack((logs, logs + _STEP * np.eye(p)))]
    cost, gradient, information = 0.0, np.zeros(p), np.zeros((p, p))
    for stretch, own in zip(stretches, gains, strict=True):
        residuals = whitened(innovations(columns, stretch, own)[0], own).reshape(p + 1, -1)
        jacobian = (residuals[1:] - residuals[0]) / _STEP
        cost += 0.5 * float(residuals[0] @ residuals[0])
        gradient += jacobian @ residuals[0]
        information += jacobian @ jacobian.T
    return cost, gradient, information


def _cost(parameters: Parameters, logs: FloatArray, stretches: list[Stretch], gains: list[Gains]) -> float:
    """As the first of `_normal_equations`; what overflows is no candidate."""
    total = 0.0
    for stretch, own in zip(stretches, gains, strict=True):
        total += 0.5 * float(np.square(whitened(innovations([parameters.theta(logs)], stretch, own)[0], own)).sum())
    return total if np.isfinite(total) else np.inf


def _constant(stretches: list[Stretch], gains: list[Gains]) -> float:
    """What the negative log-likelihood has beside the sum of squares."""
    return sum(
        0.5 * float(own.log_determinant.sum()) + 0.5 * stretch.predictions * len(stretch.outputs) * log(2.0 * pi)
        for stretch, own in zip(stretches, gains, strict=True)
    )
