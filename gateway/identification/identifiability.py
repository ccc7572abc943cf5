"""What the data tell and what they do not: Fisher's information against the prior, in plain words, with remedies.

The eigenvectors of the information in units of the prior are combinations of log-parameters that are independent both
before and after the data. An eigenvalue of lambda makes the standard deviation of its combination smaller by
1 / sqrt(1 + lambda).
"""

from dataclasses import dataclass
from typing import Literal

import numpy as np
from scipy.linalg import solve_triangular

from gateway.core.signals import FloatArray
from gateway.core.unnamed_terms import deviation
from gateway.identification.parameters import COMBINATIONS, SYMBOLS, Parameters
from gateway.identification.prediction_error import Z95, Fit

STRONG, NOTHING = 0.03, 0.7  #: standard deviation over that of the prior: up to the first, from the second on
TAPE = 0.002  #: tolerance of a length or radius that is measured
_WORTH = 0.7  #: a measurement that makes an interval narrower than this part of it is worth it
_SHOWN = 0.15  #: smallest part of a combination that is named, of its largest


@dataclass(frozen=True)
class Known:
    """How well something is known."""

    name: str
    prior: float  #: standard deviations of the logarithm: 0.01 is 1 %
    posterior: float

    @property
    def told(self) -> Literal["strongly", "weakly", "not"]:
        """By the data."""
        ratio = self.posterior / self.prior
        return "strongly" if ratio <= STRONG else "not" if ratio >= NOTHING else "weakly"


@dataclass(frozen=True)
class Direction:
    """A combination of log-parameters."""

    weights: dict[str, float]  #: the largest is 1 in size
    information: float  #: of the data, over that of the prior

    def __str__(self) -> str:
        up = [_power(name, weight) for name, weight in self.weights.items() if weight > 0.0]
        down = [_power(name, -weight) for name, weight in self.weights.items() if weight < 0.0]
        under = " ".join(down)
        return (" ".join(up) or "1") + (f" / ({under})" if len(down) > 1 else f" / {under}" if down else "")


@dataclass(frozen=True)
class Identifiability:
    known: list[Known]
    directions: list[Direction]  #: the best known first
    #: By what is measured to 0.2 %: the standard deviation that each other parameter would have.
    remedies: dict[str, dict[str, float]]
    words: list[str]


def identifiability(fitted: Fit) -> Identifiability:
    parameters, prior = fitted.parameters, fitted.prior
    known = [
        Known(name, _deviation(prior.covariance, row), _deviation(fitted.covariance, row))
        for name, row in parameters.maps.items()
    ]
    remedies = {
        name: _after_measuring(parameters, fitted.covariance, name)
        for name in ("radius_m", "length_m")
        if max(_deviation(fitted.covariance, row) for row in parameters.weights(name)) > deviation(TAPE)
    }
    return Identifiability(known, directions(fitted), remedies, _words(parameters, known, remedies))


def directions(fitted: Fit) -> list[Direction]:
    """Combinations independent before and after, the best known first."""
    root = np.linalg.cholesky(fitted.prior.covariance)
    values, vectors = np.linalg.eigh(root.T @ fitted.information @ root)
    combined = solve_triangular(root, vectors, trans="T", lower=True)
    found: list[Direction] = []
    for value, column in zip(values[::-1].tolist(), combined.T[::-1], strict=True):
        scaled = column / column[np.argmax(np.abs(column))]
        weights = dict(zip(fitted.parameters.names, scaled.tolist(), strict=True))
        found.append(Direction({name: w for name, w in weights.items() if abs(w) >= _SHOWN}, max(value, 0.0)))
    return found


def _after_measuring(parameters: Parameters, covariance: FloatArray, name: str) -> dict[str, float]:
    for row in parameters.weights(name):
        column = covariance @ row
        covariance = covariance - np.outer(column, column) / (row @ column + deviation(TAPE) ** 2)
    return {other: _deviation(covariance, row) for other, row in parameters.maps.items()}


def _words(parameters: Parameters, known: list[Known], remedies: dict[str, dict[str, float]]) -> list[str]:
    families = _worst(known)
    words: list[str] = []
    for told in ("strongly", "weakly", "not"):
        some = [f"{symbol(one.name)} to {_percent(one.posterior)}" for one in families.values() if one.told == told]
        if some:
            words.append(f"{told} told by the data: {', '.join(some)}")
    for name, after in remedies.items():
        better = {
            other: max(value for key, value in after.items() if key.split("[")[0] == other)
            for other, one in families.items()
            if other != name and other not in COMBINATIONS
        }
        some = [
            f"{symbol(other)} from {_percent(families[other].posterior)} to {_percent(value)}"
            for other, value in better.items()
            if value < _WORTH * families[other].posterior
        ]
        if some:
            what = f"{symbol(name)}{' of every roller' if parameters.structure.per_roller else ''}"
            words.append(f"measure {what} to {TAPE:.1%}: that brings {', '.join(some)}")
    return words


def _worst(known: list[Known]) -> dict[str, Known]:
    """Of each family the one that is known least."""
    found: dict[str, Known] = {}
    for one in known:
        family = one.name.split("[")[0]
        if family not in found or one.posterior > found[family].posterior:
            found[family] = Known(family, one.prior, one.posterior)
    return found


def symbol(name: str) -> str:
    """ "radius_m[2]" is "R 2"."""
    family, _, index = name.partition("[")
    return f"{SYMBOLS[family]} {index[:-1]}".rstrip()


def _power(name: str, weight: float) -> str:
    return symbol(name) if abs(weight - 1.0) < 0.05 else f"{symbol(name)}^{weight:.1f}"


def _percent(deviation_of_log: float) -> str:
    """Half of the interval of 95 %."""
    return f"±{100.0 * np.expm1(Z95 * deviation_of_log):.2g} %"


def _deviation(covariance: FloatArray, row: FloatArray) -> float:
    return float(np.sqrt(max(row @ covariance @ row, 0.0)))
