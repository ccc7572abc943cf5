"""Whether a sequence is white: portmanteau statistics, and the strongest line of its spectrum."""

from collections.abc import Sequence
from dataclasses import dataclass
from math import log

import numpy as np
from scipy.stats import chi2

from gateway.core.signals import FloatArray

LAGS = 20


@dataclass(frozen=True)
class Line:
    """In the periodogram of one output."""

    output: int
    frequency_hz: float
    resolution_hz: float
    share: float  #: of the output's variance


def portmanteau(parts: Sequence[FloatArray], risk: float, lags: int = LAGS) -> float:
    """Ljung-Box statistic of sequences (k,) of one source over its quantile; a white one is above 1 at this risk."""
    return portmanteau_of_all([part[:, None] for part in parts], risk, lags)


def portmanteau_of_all(parts: Sequence[FloatArray], risk: float, lags: int = LAGS) -> float:
    """The same of sequences (k, m) and of what is between their columns (Hosking's form for a unit covariance)."""
    long = [part for part in parts if len(part) > 2 * lags]
    if not long:
        return float("nan")
    samples, m = sum(len(part) for part in long), long[0].shape[1]
    scale = np.sqrt(sum(np.square(part).sum(axis=0) for part in long) / samples)
    total = 0.0
    for lag in range(1, lags + 1):
        product = np.zeros((m, m))
        pairs = 0
        for part in long:
            product += (part[lag:] / scale).T @ (part[:-lag] / scale)
            pairs += len(part) - lag
        total += float(np.square(product).sum()) / pairs
    return total / float(chi2.ppf(1.0 - risk, m * m * lags))


def strongest_line(white: FloatArray, period_s: float, risk: float = 0.001) -> Line | None:
    """Of sequences (k, m); None where chance explains the greatest ordinate (Fisher's test, over all outputs), or it is
    the slowest one, which is a drift."""
    samples, m = white.shape
    if samples < 2 * LAGS:
        return None
    power = np.square(np.abs(np.fft.rfft(white - white.mean(axis=0), axis=0)))[1 : (samples - 1) // 2 + 1]
    whole = power.sum(axis=0)
    share = np.divide(power, whole, out=np.zeros_like(power), where=whole > 0.0)  # of nothing, or NaN, no line
    row, output = (int(at) for at in np.unravel_index(int(np.argmax(share)), share.shape))
    greatest, ordinates = float(share[row, output]), len(share)
    if log(m * ordinates) + (ordinates - 1) * np.log1p(-greatest) > log(risk) or row == 0:
        return None
    resolution_hz = 1.0 / (samples * period_s)
    return Line(output, (row + 1) * resolution_hz, resolution_hz, greatest)
