"""What a model says of each parameter and combination, with its interval where it has one."""

from dataclasses import dataclass

import numpy as np

from gateway.core.line_model import LineModel, ModelInterval, theta_of
from gateway.core.line_model_names import PER_SPAN
from gateway.core.signals import FloatArray

#: How a person writes them.
SYMBOLS = {
    "stiffness_n": "EA",
    "length_m": "L",
    "radius_m": "R",
    "inertia_kg_m2": "J",
    "friction_nms_per_rad": "f",
    "coulomb_nm": "Coulomb friction",
    "torque_lag_s": "torque lag",
    "latency_s": "latency",
    "stiffness_per_length": "EA/L",
    "radius_per_inertia": "R/J",
    "friction_per_inertia": "f/J",
    "radius2_per_inertia": "R²/J",
}


@dataclass(frozen=True)
class Quantity:
    value: float
    low: float | None = None  #: of 95 %; None: the model has no interval of it
    high: float | None = None

    @property
    def half_width_pct(self) -> float | None:
        """None: there is no interval, or nothing to relate it to."""
        if self.low is None or self.high is None or not self.value:
            return None
        return 50.0 * (self.high - self.low) / abs(self.value)

    def excludes(self, other: "Quantity") -> bool | None:
        """Whether the intervals have nothing in common; None where one has none."""
        if self.low is None or self.high is None or other.low is None or other.high is None:
            return None
        return self.high < other.low or other.high < self.low


def values_of(model: LineModel) -> dict[str, FloatArray]:
    """Every parameter and combination by name, (n,), or (1,) for those of the line."""
    theta = theta_of(model)
    web = theta.web
    return {
        "stiffness_n": np.array([web.stiffness_n]),
        "length_m": web.length_m,
        "radius_m": web.radius_m,
        "inertia_kg_m2": web.inertia_kg_m2,
        "friction_nms_per_rad": web.friction_nms_per_rad,
        "coulomb_nm": theta.coulomb_nm,
        "torque_lag_s": np.array([theta.torque_lag_s]),
        "latency_s": np.array([theta.latency_s]),
        "stiffness_per_length": web.stiffness_n / web.length_m,
        "radius_per_inertia": web.radius_m / web.inertia_kg_m2,
        "friction_per_inertia": web.friction_nms_per_rad / web.inertia_kg_m2,
        "radius2_per_inertia": web.radius_m**2 / web.inertia_kg_m2,
    }


def interval_at(model: LineModel, name: str, index: int) -> ModelInterval | None:
    """That of span or roller `index` (from 0): its own, else the one that all share."""
    return model.intervals.get(f"{name}[{index + 1}]") or model.intervals.get(name)


def quantities(model: LineModel) -> dict[str, Quantity]:
    """By name, "inertia_kg_m2[3]" where spans or rollers differ; in the order of `SYMBOLS`."""
    found: dict[str, Quantity] = {}
    for name, values in values_of(model).items():
        own = [f"{name}[{i}]" for i in range(1, model.n + 1)] if name in PER_SPAN else []
        differ = any(one in model.intervals for one in own)
        if differ or (name not in model.intervals and np.ptp(values) > 0.0):
            for i, one in enumerate(own):
                found[one] = _quantity(interval_at(model, name, i), float(values[i]))
        else:
            found[name] = _quantity(model.intervals.get(name), float(values[0]))
    return found


def _quantity(interval: ModelInterval | None, value: float) -> Quantity:
    return Quantity(value) if interval is None else Quantity(interval.value, interval.low, interval.high)


def typical(model: LineModel, name: str) -> Quantity:
    """One for all: where spans or rollers differ, the mean of the values and of the ends."""
    found = quantities(model)
    each = [found[name]] if name in found else [found[f"{name}[{i}]"] for i in range(1, model.n + 1)]
    lows = [one.low for one in each if one.low is not None]
    highs = [one.high for one in each if one.high is not None]
    value = float(np.mean([one.value for one in each]))
    if len(lows) < len(each):
        return Quantity(value)
    return Quantity(value, float(np.mean(lows)), float(np.mean(highs)))


def symbol_of(name: str) -> str:
    """ "J[3]" of "inertia_kg_m2[3]"."""
    base, bracket, number = name.partition("[")
    return SYMBOLS[base] + bracket + number
