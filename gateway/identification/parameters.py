"""The vector of log-parameters that a structure has, its way to theta, and what can be said of it by name.

Everything that is believed in, single parameters and products of them alike, is a linear map of the logarithms: the
logarithm of R^2/J is 2 log R - log J.
"""

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from gateway.core.signals import FloatArray
from gateway.core.theta import Theta
from gateway.identification.estimate import Structure

EACH = ("length_m", "radius_m", "inertia_kg_m2", "friction_nms_per_rad")  #: of the paper, one per roller or span
SYMBOLS = {
    "stiffness_n": "EA", "length_m": "L", "radius_m": "R", "inertia_kg_m2": "J", "friction_nms_per_rad": "f",
    "coulomb_nm": "c", "torque_lag_s": "torque lag", "latency_s": "latency", "stiffness_per_length": "EA/L",
    "radius_per_inertia": "R/J", "friction_per_inertia": "f/J", "radius2_per_inertia": "R^2/J",
    "eccentricity": "eccentricity",
}  # fmt: skip
COMBINATIONS: dict[str, dict[str, float]] = {
    "stiffness_per_length": {"stiffness_n": 1.0, "length_m": -1.0},
    "radius_per_inertia": {"radius_m": 1.0, "inertia_kg_m2": -1.0},
    "friction_per_inertia": {"friction_nms_per_rad": 1.0, "inertia_kg_m2": -1.0},
    "radius2_per_inertia": {"radius_m": 2.0, "inertia_kg_m2": -1.0},
}


@dataclass(frozen=True)
class Parameters:
    """Log-parameters (p,) of a structure for the rollers and spans of `base`.

    What is one for all rollers is one factor on `base`: its log-parameter is that of the geometric mean. Coulomb
    friction has no such pattern in `base`: shared, it is the same for all.
    """

    structure: Structure
    base: Theta
    with_latency: bool = False  #: whether the latency is one of them

    @cached_property
    def names(self) -> list[str]:
        """stiffness_n first; "radius_m[1]" where rollers differ."""
        each = [*EACH, *(["coulomb_nm"] if self.structure.coulomb else [])]
        found = ["stiffness_n"]
        for name in each:
            found += [f"{name}[{i + 1}]" for i in range(self.base.n)] if self.structure.per_roller else [name]
        found += ["torque_lag_s"] if self.structure.torque_lag else []
        return found + (["latency_s"] if self.with_latency else [])

    @property
    def size(self) -> int:
        return len(self.names)

    @cached_property
    def maps(self) -> dict[str, FloatArray]:
        """The weights (p,) of everything that has a name: parameters, then combinations."""
        rows = dict(zip(self.names, np.eye(self.size), strict=True))
        index = [f"[{i + 1}]" for i in range(self.base.n)] if self.structure.per_roller else [""]
        for name, powers in COMBINATIONS.items():
            for at in index:
                rows[name + at] = sum(
                    (power * rows[part if part in rows else part + at] for part, power in powers.items()),
                    np.zeros(self.size),
                )
        return rows

    def weights(self, name: str) -> FloatArray:
        """Rows (r, p) of a name: one, or where rollers differ and no roller is named, one for each.

        Raises KeyError for a name that this structure does not have.
        """
        if name in self.maps:
            return self.maps[name][None, :]
        rows = [row for key, row in self.maps.items() if key.split("[")[0] == name]
        if not rows:
            raise KeyError(f"{name}: not a parameter of this structure; it has {', '.join(self.maps)}")
        return np.array(rows)

    def theta(self, logs: FloatArray) -> Theta:
        """Of log-parameters (p,)."""
        values = dict(zip(self.names, np.exp(logs).tolist(), strict=True))
        n, web = self.base.n, self.base.web
        each: dict[str, FloatArray] = {}
        for name in EACH:
            if self.structure.per_roller:
                each[name] = np.array([values[f"{name}[{i + 1}]"] for i in range(n)])
            else:
                pattern: FloatArray = getattr(web, name)
                each[name] = pattern * (values[name] / _mean(pattern))
        coulomb = np.zeros(n)
        if self.structure.coulomb:
            several = self.structure.per_roller
            coulomb = np.array([values[f"coulomb_nm[{i + 1}]" if several else "coulomb_nm"] for i in range(n)])
        return Theta(
            replace(web, stiffness_n=values["stiffness_n"], **each),
            coulomb,
            values.get("torque_lag_s", 0.0),
            values.get("latency_s", self.base.latency_s),
        )

    def logs(self, theta: Theta) -> FloatArray:
        """Log-parameters (p,) of a theta of this structure; of another one, the nearest in the mean."""
        values: dict[str, float] = {"stiffness_n": theta.web.stiffness_n, "torque_lag_s": theta.torque_lag_s}
        values["latency_s"] = theta.latency_s
        several = {name: getattr(theta.web, name) for name in EACH} | {"coulomb_nm": theta.coulomb_nm}
        for name, array in several.items():
            values |= {f"{name}[{i + 1}]": value for i, value in enumerate(array.tolist())}
            values[name] = _mean(array)
        return np.log(np.maximum([values[name] for name in self.names], 1e-12))


def _mean(values: FloatArray) -> float:
    """Geometric."""
    return float(np.exp(np.mean(np.log(np.maximum(values, 1e-12)))))
