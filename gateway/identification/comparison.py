"""Estimates of several methods on the same held-out recordings, by one yardstick that belongs to none of them.

Each theta is let run freely from measured states over windows of 1 s under the torques that were sent, and over single
periods; how far that is from what was measured is set against the sensors' noise. Below 1.4, the noise of both ends,
nobody can be over a period; over a second the disturbances of the line are in it too, alike for all. They decide
between methods that are all good, wherefore each row says by how many standard errors it is behind the best.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from math import inf, sqrt

import numpy as np

from gateway.core.recording import Recording
from gateway.core.signals import FloatArray
from gateway.core.theta import Noise, Theta
from gateway.identification.estimate import Estimate
from gateway.identification.free_run import Windows, periods_before, run_freely, windows_of

WINDOW_S = 1.0
ASSUMED = Noise()
_OVERLAP = 4  #: windows begin this often within one


@dataclass(frozen=True)
class Errors:
    """Root mean square over samples and spans or rollers, in standard deviations of a sample's noise."""

    tension: float
    speed: float

    @property
    def both(self) -> float:
        return sqrt(0.5 * (self.tension**2 + self.speed**2))


@dataclass(frozen=True)
class Row:
    """One method. Parameters and intervals are the estimate's."""

    estimate: Estimate
    seconds: float  #: that the estimate took, as whoever made it measured
    free_run: Errors  #: over windows of `WINDOW_S`
    one_step: Errors  #: over single periods
    behind: float  #: the best row, in standard errors of the difference; below 2 it is as good, for all one can say

    @property
    def score(self) -> float:
        """Smaller is better."""
        return self.free_run.both


@dataclass(frozen=True)
class Comparison:
    rows: list[Row]  #: the best first
    windows: int
    steps: int

    @property
    def best(self) -> Row:
        return self.rows[0]


def compare(
    estimates: Sequence[tuple[Estimate, float]], held_out: Sequence[Recording], noise: Noise = ASSUMED
) -> Comparison:
    """Estimates, each with the seconds that it took, on recordings that none of them has seen.

    Raises ValueError without estimates, for one of another line, and for recordings without a stretch of a window.
    """
    if not estimates or not held_out:
        raise ValueError(f"{len(estimates)} estimates and {len(held_out)} recordings; at least one of each is needed")
    period_s, n = held_out[0].period_s, held_out[0].n
    for estimate, _ in estimates:
        if estimate.theta.n != n:
            raise ValueError(f"{estimate.method}: is of {estimate.theta.n} spans, {held_out[0].source} of {n}")
    before = max(periods_before(estimate.theta, period_s) for estimate, _ in estimates)
    periods = round(WINDOW_S / period_s)
    windows = windows_of(held_out, periods, before, max(periods // _OVERLAP, 1))
    steps = windows_of(held_out, 1, before, 1)
    free = [_squares(estimate.theta, windows, noise) for estimate, _ in estimates]
    single = [_squares(estimate.theta, steps, noise) for estimate, _ in estimates]
    best = min(free, key=lambda squares: _errors(squares).both)
    rows = [
        Row(estimate, seconds, _errors(of_windows), _errors(of_steps), _behind(of_windows, best))
        for (estimate, seconds), of_windows, of_steps in zip(estimates, free, single, strict=True)
    ]
    return Comparison(sorted(rows, key=lambda row: row.score), windows.count, steps.count)


def _squares(theta: Theta, windows: Windows, noise: Noise) -> FloatArray:
    """Mean squared errors (w, 2) of tension and speed, by the noise. A theta that runs away has infinite ones."""
    with np.errstate(over="ignore", invalid="ignore"):
        tension, speed = run_freely(theta, windows)
        of_tension = ((tension - windows.tension_n[:, 1:]) / noise.tension_n) ** 2
        of_speed = ((speed - windows.speed_m_per_s[:, 1:]) / noise.speed_m_per_s) ** 2
        measured = ~np.isnan(windows.tension_n[:, 1:])
        of_tension = np.where(measured, of_tension, 0.0).sum(axis=(1, 2)) / np.maximum(measured.sum(axis=(1, 2)), 1)
        found = np.stack((of_tension, of_speed.mean(axis=(1, 2))), axis=1)
    return np.where(np.isfinite(found), found, np.inf)


def _errors(squares: FloatArray) -> Errors:
    tension, speed = np.sqrt(squares.mean(axis=0)).tolist()
    return Errors(tension, speed)


def _behind(squares: FloatArray, best: FloatArray) -> float:
    """Windows that overlap count as what they would be without."""
    if not np.isfinite(squares).all():
        return inf
    difference = (squares - best).mean(axis=1)
    count = max(len(difference) / _OVERLAP, 2.0)
    return float(difference.mean() / max(float(difference.std()) / sqrt(count - 1.0), 1e-12))
