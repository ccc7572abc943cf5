"""Lines as they may turn out: random plants around S_sim, and what no drawing of a line has beside.

A plant is a function of its seed and the number of its spans.
"""

from pathlib import Path
from typing import Any

import numpy as np

from sim_plant.physics import FloatArray
from sim_plant.plant import Plant, load_plant

SPREAD = {"stiffness_n": 0.2, "inertia_kg_m2": 0.2, "length_m": 0.2, "radius_m": 0.15, "friction_nms_per_rad": 0.5}
FASTEST_M_PER_S, MOST_FRICTION_NM = 0.1, 50.0  #: a line whose drives could not hold it is not kept
OF_ITSELF = 0.02  #: of a roller or span of an unruly line, beside what is common to all
_PLANTS = Path(__file__).parent / "plants"


def random_plant(seed: int, spans: int = 6) -> Plant:
    """S_sim with one factor per parameter for the whole plant, uniform within `SPREAD`; disturbed as S_real is."""
    base = load_plant(_PLANTS / "s_sim.toml").model_copy(update={"spans": spans})
    disturbance = load_plant(_PLANTS / "s_real.toml").rollers.disturbance_m_per_s2
    generator = np.random.default_rng(seed)
    while True:
        drawn = {name: float(generator.uniform(1.0 - spread, 1.0 + spread)) for name, spread in SPREAD.items()}
        plant = scaled(base, drawn)
        p = plant.parameters()
        if (p.friction_nms_per_rad * FASTEST_M_PER_S / p.radius_m <= MOST_FRICTION_NM).all():
            rollers = plant.rollers.model_copy(update={"disturbance_m_per_s2": disturbance})
            return plant.model_copy(update={"name": f"random-{seed}", "rollers": rollers})


def unruly_plant(seed: int, spans: int = 6) -> Plant:
    """`random_plant` with rollers and spans each a little off, torque lag, dry friction, eccentricity, slow cells."""
    plant, generator = random_plant(seed, spans), np.random.default_rng([seed, 1])

    def off(values: FloatArray) -> list[float]:
        return (values * (1.0 + OF_ITSELF * generator.uniform(-1.0, 1.0, spans))).tolist()

    p, effects = plant.parameters(), plant.effects
    rollers = {name: off(getattr(p, name)) for name in ("radius_m", "inertia_kg_m2", "friction_nms_per_rad")}
    friction = {"coulomb_nm": generator.uniform(0.2, 1.5, spans).tolist()}
    eccentricity = {
        "share": generator.uniform(0.0, 2e-3, spans).tolist(),
        "phase_rad": generator.uniform(0.0, 2.0 * np.pi, spans).tolist(),
    }
    drives = {"torque_lag_s": float(generator.uniform(0.001, 0.004)), "torque_step_nm": 0.02}
    cells: dict[str, Any] = {
        "tension_corner_hz": float(1.0 / (2.0 * np.pi * generator.uniform(0.0005, 0.0015))),
        "tension_step_n": 0.0122,
        "speed_step_m_per_s": 2e-5,
    }
    return plant.model_copy(
        update={
            "name": f"unruly-{seed}",
            "web": plant.web.model_copy(update={"length_m": off(p.length_m)}),
            "rollers": plant.rollers.model_copy(update=rollers),
            "drives": plant.drives.model_copy(update=drives),
            "sensors": plant.sensors.model_copy(update=cells),
            "effects": effects.model_copy(
                update={
                    "friction": effects.friction.model_copy(update=friction),
                    "eccentricity": effects.eccentricity.model_copy(update=eccentricity),
                }
            ),
        }
    )


def scaled(plant: Plant, factors: dict[str, float]) -> Plant:
    """`plant` with parameters multiplied, each by one factor for all spans or rollers."""
    p = plant.parameters()
    of = {name: (getattr(p, name) * factor).tolist() for name, factor in factors.items()}
    web = {name: of[name] for name in ("stiffness_n", "length_m") if name in of}
    rollers = {name: of[name] for name in ("radius_m", "inertia_kg_m2", "friction_nms_per_rad") if name in of}
    return plant.model_copy(
        update={"web": plant.web.model_copy(update=web), "rollers": plant.rollers.model_copy(update=rollers)}
    )
