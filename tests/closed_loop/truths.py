"""Simulated lines to be identified, and what is true of them by the names that estimates use."""

from dataclasses import replace
from typing import Any

import numpy as np

from gateway.core.line import Line
from gateway.core.theta import Theta, nominal_theta
from gateway.identification.estimate import Structure
from gateway.identification.parameters import Parameters
from sim_plant.plant import Plant, plant_of
from tests.closed_loop.recorded import demonstration_line


def altered(plant: Plant, changes: dict[str, Any]) -> Plant:
    """`plant` with tables of its file changed: {"drives": {"torque_lag_s": 0.005}}."""

    def merged(into: dict[str, Any], what: dict[str, Any]) -> dict[str, Any]:
        return into | {
            key: merged(into[key], value) if isinstance(value, dict) and isinstance(into.get(key), dict) else value
            for key, value in what.items()
        }

    return plant_of(merged(plant.model_dump(), changes))


def with_friction_and_lag(plant: Plant, coulomb_nm: float = 2.0, lag_s: float = 0.005) -> Plant:
    return altered(
        plant, {"effects": {"friction": {"coulomb_nm": coulomb_nm}}, "drives": {"torque_lag_s": lag_s}}
    )  # fmt: skip


def truth_of(plant: Plant, line: Line | None = None) -> Theta:
    """The theta of a plant under the line's latency."""
    line = line or demonstration_line(plant.spans)
    nominal, p = nominal_theta(line), plant.parameters()
    web = replace(
        nominal.web, stiffness_n=float(p.stiffness_n[0]), length_m=p.length_m, radius_m=p.radius_m,
        inertia_kg_m2=p.inertia_kg_m2, friction_nms_per_rad=p.friction_nms_per_rad,
    )  # fmt: skip
    coulomb = np.resize(plant.effects.friction.coulomb_nm, plant.spans).astype(float)
    return replace(nominal, web=web, coulomb_nm=coulomb, torque_lag_s=plant.drives.torque_lag_s)


def true_values(plant: Plant, structure: Structure, line: Line | None = None) -> dict[str, float]:
    """By name, as `Estimate.intervals` has them."""
    truth = truth_of(plant, line)
    parameters = Parameters(structure, nominal_theta(line or demonstration_line(plant.spans)))
    logs = parameters.logs(truth)
    return {name: float(np.exp(row @ logs)) for name, row in parameters.maps.items()}
