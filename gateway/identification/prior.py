"""What is known of the log-parameters before data: from the line's file, by measuring, or by an earlier estimate."""

from dataclasses import dataclass, replace
from math import log

import numpy as np

from gateway.core.line import Line, Parameter
from gateway.core.signals import FloatArray
from gateway.core.theta import nominal_theta
from gateway.core.unnamed_terms import (
    COULOMB_DIFFERS,
    COULOMB_SD,
    COULOMB_SHARE,
    LAG_S,
    LAG_SD,
    LATENCY_SD_S,
    ROLLERS_DIFFER,
    deviation,
)
from gateway.identification.estimate import Structure
from gateway.identification.parameters import EACH, Parameters


@dataclass(frozen=True)
class Prior:
    """Normal in the log-parameters."""

    parameters: Parameters
    mean: FloatArray  #: (p,)
    covariance: FloatArray  #: (p, p)

    def measured(self, values: dict[str, tuple[float, float]]) -> "Prior":
        """With what has been measured by other means: {"radius_m": (0.035, 0.005)} is 35 mm, to 0.5 % either way.

        A name without a roller holds for every roller. Raises KeyError for a name that the structure does not have,
        ValueError for a value or tolerance that is not above 0.
        """
        mean, covariance = self.mean, self.covariance
        for name, (value, tolerance) in values.items():
            if not (value > 0.0 and tolerance > 0.0):
                raise ValueError(f"{name}: value and tolerance must be above 0, not {value} and {tolerance}")
            for row in self.parameters.weights(name):
                gain = covariance @ row / (row @ covariance @ row + deviation(tolerance) ** 2)
                mean = mean + gain * (log(value) - row @ mean)
                covariance = covariance - np.outer(gain, row @ covariance)
                covariance = 0.5 * (covariance + covariance.T)
        return replace(self, mean=mean, covariance=covariance)


def prior_of(line: Line, structure: Structure, *, spread: float = ROLLERS_DIFFER, with_latency: bool = False) -> Prior:
    """From the line's file: nominal values and tolerances.

    Where rollers differ, the tolerance is that of a factor which all have in common, and each differs from it by
    `spread`; so what one roller shows helps to know the others. Coulomb friction is 2 % of the torque limit and a
    torque lag 3 ms, give or take a factor of e and 2; the latency, where it is asked for, 2 ms off.
    """
    base = nominal_theta(line)
    parameters = Parameters(structure, base, with_latency and base.latency_s > 0.0)
    logs = dict(zip(parameters.names, parameters.logs(base).tolist(), strict=True))
    families = [("stiffness_n", deviation(line.web.stiffness_n.tolerance))]
    families += [(name, deviation(_tolerance(line, name))) for name in EACH]
    covariance = np.zeros((parameters.size, parameters.size))
    for name, common in families:
        _believe(parameters, covariance, name, common, deviation(spread))
    if structure.coulomb:
        for row in np.flatnonzero(parameters.weights("coulomb_nm").any(axis=0)).tolist():
            logs[parameters.names[row]] = log(COULOMB_SHARE * line.limits.torque_nm)
        _believe(parameters, covariance, "coulomb_nm", COULOMB_SD, COULOMB_DIFFERS * deviation(spread))
    if structure.torque_lag:
        logs["torque_lag_s"] = log(LAG_S)
        _believe(parameters, covariance, "torque_lag_s", LAG_SD, 0.0)
    if parameters.with_latency:
        _believe(parameters, covariance, "latency_s", min(LATENCY_SD_S / base.latency_s, 0.5), 0.0)
    return Prior(parameters, np.array([logs[name] for name in parameters.names]), covariance)


def prior_after(
    earlier: Prior, mean: FloatArray, covariance: FloatArray, wanted: Prior, *, drift: float = 0.0
) -> Prior:
    """From an earlier estimate (p,), (p, p) under `earlier`, for the structure of `wanted`.

    Each parameter may have moved by `drift`, a fraction either way. What the earlier structure did not have is as in
    `wanted`, and so is the spread between rollers where it had one factor for all.
    """
    old, new = earlier.parameters, wanted.parameters
    own_mean, own = wanted.mean.copy(), wanted.covariance.copy()
    if new.structure.per_roller == old.structure.per_roller:
        at = [new.names.index(name) for name in old.names if name in new.names]
        rows = np.eye(old.size)[[name in new.names for name in old.names]]
        selected = np.eye(new.size)[at]
    else:
        shared = [name for name in _families(old) if name in _families(new)]
        rows = np.array([old.weights(name).mean(axis=0) for name in shared])
        selected = np.array([new.weights(name).mean(axis=0) for name in shared])
    # What both have in common is replaced in `wanted`; what depends on it there moves along.
    common = selected @ own @ selected.T
    gain = np.linalg.solve(common, selected @ own).T
    told = rows @ covariance @ rows.T + deviation(drift) ** 2 * np.eye(len(rows))
    own_mean = own_mean + gain @ (rows @ mean - selected @ own_mean)
    own = own - gain @ (common - told) @ gain.T
    return Prior(new, own_mean, 0.5 * (own + own.T))


def _families(parameters: Parameters) -> list[str]:
    """Names without rollers."""
    return list(dict.fromkeys(name.split("[")[0] for name in parameters.names))


def _believe(parameters: Parameters, covariance: FloatArray, name: str, common: float, each: float) -> None:
    """Fill in a name's variance: one factor in common, and where rollers differ, each by itself."""
    rows = np.flatnonzero([key.split("[")[0] == name for key in parameters.names])
    covariance[np.ix_(rows, rows)] = common**2
    if len(rows) > 1:
        covariance[rows, rows] += each**2


def _tolerance(line: Line, name: str) -> float:
    """The widest that any roller or span has."""
    parts = line.spans if name == "length_m" else line.rollers
    found: list[Parameter] = [getattr(part, name) for part in parts]
    return max(parameter.tolerance for parameter in found)
