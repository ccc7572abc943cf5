"""Rollers out of round: what turns with them is known but for its amplitude and where it begins.

The web on an eccentric roller runs on the radius

    R_i (1 + a_i cos(x_i/R_i) + b_i sin(x_i/R_i)),    x_i the integral of the measured surface speed,

so that a swing (a_i, b_i) enters the paper's equations as an input of known shape. It moves the web's speed by as much
of it, which tension sees through EA/L, and the arm at which the web pulls, which is of second order but costs nothing.

The swing of a stretch cannot be known before it: nobody knows the angle at which it began. It is a constant of unknown
size beside the predictor's state, and the separate-bias estimator (Friedland 1969, IEEE Trans. Automatic Control 14)
gives what a Kalman filter of both would, from the predictor of round rollers and its response to each swing.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from math import pi
from typing import TYPE_CHECKING

import numpy as np

from gateway.control import prediction_kernel
from gateway.core.signals import CountArray, FloatArray
from gateway.core.theta import Theta

if TYPE_CHECKING:
    from gateway.control.prediction import Stretch

SWING_STEP = 1e-3  #: of a swing, for responses; they are as good as linear
_ASTRAY_RAD = 0.1  #: by which the angle of a turn may be wrong: radii are known to percents, and reels grow


@dataclass(frozen=True)
class Swung:
    """What was learned of q = 2r numbers, two of each eccentric roller, along a stretch."""

    before: FloatArray  #: (k, n, 2), the swings as known before each sample was seen
    spread: FloatArray  #: (k, m, m), what the doubt about them adds to the unit covariance of whitened innovations
    whitened: FloatArray  #: (k, m), innovations with the swings of `before`, of unit covariance

    @property
    def log_determinant(self) -> FloatArray:
        """Of the covariance, over that without the doubt, (k,)."""
        return np.linalg.slogdet(np.eye(self.spread.shape[1]) + self.spread)[1]


def travel(speed_m_per_s: FloatArray, period_s: float) -> FloatArray:
    """What each surface has travelled at each sample since the first one, (k, n), by the trapezoidal rule."""
    moved = 0.5 * period_s * (speed_m_per_s[1:] + speed_m_per_s[:-1])
    return np.vstack((np.zeros((1, moved.shape[1])), np.cumsum(moved, axis=0)))


def radii_of(radius_m: Sequence[FloatArray], travelled_m: FloatArray, swings: FloatArray) -> FloatArray:
    """Under the web over their means, at every sample (b, k, n). Of b lines; `swings` (b, n, 2)."""
    found = np.ones((len(radius_m), *travelled_m.shape))
    for i in np.flatnonzero(swings.any(axis=(0, 2))).tolist():
        angle = travelled_m[:, i] / np.array([radii[i] for radii in radius_m])[:, None]
        found[:, :, i] += swings[:, i, :1] * np.cos(angle) + swings[:, i, 1:] * np.sin(angle)
    return found


def swings_beside(swing: FloatArray, at: CountArray) -> FloatArray:
    """`swing` (n, 2) and then, for each roller of `at`, with `SWING_STEP` more of its cosine and of its sine."""
    found = np.repeat(swing[None], 1 + 2 * len(at), axis=0)
    for j, i in enumerate(at.tolist()):
        found[1 + 2 * j, i, 0] += SWING_STEP
        found[2 + 2 * j, i, 1] += SWING_STEP
    return found


def learned(theta: Theta, stretch: "Stretch", at: CountArray, white: FloatArray) -> Swung | None:
    """Along the stretch, of the rollers `at` (r,), whose amplitudes theta knows.

    `white` (1 + 2r, k, m): whitened innovations of round rollers, and of each of `swings_beside`. None: numerically
    impossible.
    """
    response = np.ascontiguousarray((white[1:] - white[0]).transpose(1, 2, 0)) / SWING_STEP
    samples, m, q = response.shape
    variance = np.repeat(0.5 * theta.eccentricity[at] ** 2, 2)
    turns = np.diff(stretch.travelled_m[stretch.first :, at], axis=0) / (2.0 * pi * theta.web.radius_m[at])
    drift = variance * _ASTRAY_RAD**2 * np.repeat(np.abs(turns), 2, axis=1)
    whitened, spread, after = np.empty((samples, m)), np.empty((samples, m, m)), np.empty((samples, q))
    if not prediction_kernel.estimate_swing(
        np.ascontiguousarray(white[0]), response, drift, np.diag(variance), np.zeros(q), whitened, spread, after
    ):
        return None
    before = np.zeros((samples, theta.n, 2))
    before[1:, at] = after[:-1].reshape(-1, len(at), 2)
    return Swung(before, spread, whitened)
