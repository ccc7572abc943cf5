"""Process and measuring noise by maximum likelihood: one step of Fisher scoring on their logarithms."""

from math import log, pi

import numpy as np

from gateway.control.prediction import Gains, Stretch, gains_of, innovations, predict, whitened
from gateway.core.signals import FloatArray
from gateway.core.theta import Noise, Theta

_STEP = 1e-3  #: of a logarithm, for derivatives
_REACH = 1.0  #: longest step
_DAMPINGS = (0.0, *(10.0**power for power in range(1, 10)))  #: the next when a step is too long, or the wrong way
_BOUND = 7.0  #: the noise is looked for within this of where the search began
_WIDE = 1.0  #: standard deviation of a prior that keeps what the data do not tell from running away


def improved_noise(theta: Theta, noise: Noise, begun: Noise, stretches: list[Stretch]) -> tuple[Noise, float]:
    """A step nearer to where the likelihood of the stretches under this theta is greatest.

    Returns the step's length too, in standard deviations of what is estimated.

    With S and the whitened innovations r of the predictor, D = S^-1/2 dS S^-T/2 and q = S^-1/2 de, the gradient of the
    negative log-likelihood is sum(tr D - r'D r) / 2 + sum(q'r), and the information sum(tr D_i D_j) / 2 + sum(q_i'q_j).
    """
    logs, origin = _logs(noise), _logs(begun)
    cost, gradient, information = _prior(logs, origin), (logs - origin) / _WIDE**2, np.eye(3) / _WIDE**2
    for stretch in stretches:
        likelihood, slope, curvature = _derivatives(theta, logs, stretch)
        cost -= likelihood
        gradient += slope
        information += curvature
    for damping in _DAMPINGS:
        step = -np.linalg.solve(information + damping * np.eye(3), gradient)
        moved = np.clip(logs + step, origin - _BOUND, origin + _BOUND)
        if np.abs(step).max() > _REACH:
            continue
        tried = sum(float(predict(theta, _noise(moved), stretch).log_likelihood.sum()) for stretch in stretches)
        if _prior(moved, origin) - tried <= cost:
            return _noise(moved), float(np.sqrt((moved - logs) @ information @ (moved - logs)))
    return noise, 0.0


def _prior(logs: FloatArray, origin: FloatArray) -> float:
    return 0.5 * float(np.square(logs - origin).sum()) / _WIDE**2


def _derivatives(theta: Theta, logs: FloatArray, stretch: Stretch) -> tuple[float, FloatArray, FloatArray]:
    """Log-likelihood, gradient (3,) of its negative, information (3, 3)."""
    base = gains_of(theta, _noise(logs), stretch)
    white = whitened(innovations([theta], stretch, base)[0], base)[0]
    changes: list[FloatArray] = []  # D, (k, m m) for each of the three
    moves: list[FloatArray] = []  # r', (k, m)
    for row in np.eye(3):
        other = gains_of(theta, _noise(logs + _STEP * row), stretch)
        moves.append((whitened(innovations([theta], stretch, other)[0], base)[0] - white) / _STEP)
        changes.append(_whitened_change(base, other))
    k, m = white.shape
    D = np.array(changes).reshape(3, k, m, m)
    trace = np.trace(D, axis1=2, axis2=3)
    squared = np.einsum("ki,jkil,kl->jk", white, D, white, optimize=True)
    gradient = (0.5 * (trace - squared)).sum(axis=1) + np.einsum("jki,ki->j", np.array(moves), white)
    flat, moved = D.reshape(3, -1), np.array(moves).reshape(3, -1)
    likelihood = -0.5 * float(np.square(white).sum() + base.log_determinant.sum() + white.size * log(2.0 * pi))
    return likelihood, gradient, 0.5 * flat @ flat.T + moved @ moved.T


def _whitened_change(base: Gains, other: Gains) -> FloatArray:
    """S^-1/2 (S' - S) S^-T/2 over the step, (k, m, m)."""
    pairs, at = np.unique(np.column_stack((base.which, other.which)), axis=0, return_inverse=True)
    mixed = base.root[pairs[:, 0]] @ other.factor[pairs[:, 1]]
    change = (mixed @ mixed.transpose(0, 2, 1) - np.eye(mixed.shape[1])) / _STEP
    return change[at.ravel()]


def _logs(noise: Noise) -> FloatArray:
    return np.log([noise.tension_n, noise.speed_m_per_s, noise.acceleration_m_per_s1_5])


def _noise(logs: FloatArray) -> Noise:
    return Noise(*np.exp(logs).tolist())
