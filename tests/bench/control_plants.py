"""The ensemble: random plants around S_sim, as a line that was built to the drawing of S_sim may turn out."""

import numpy as np

from sim_plant.physics import STEP_S
from sim_plant.plant import Plant, load_plant

TEST = range(10_000, 10_100)  #: seeds of the 100 test plants; weights are tuned on others, below
SPREAD = {"stiffness_n": 0.2, "inertia_kg_m2": 0.2, "length_m": 0.2, "radius_m": 0.15, "friction_nms_per_rad": 0.5}
UNEVEN = 0.1  #: of a roller or span about what is common to its line
STRESS_M_PER_S1_5 = 5e-2
FASTEST_M_PER_S, MOST_FRICTION_NM = 0.1, 50.0  #: a line whose drives could not hold it is not kept


def random_plant(seed: int, spans: int = 6) -> Plant:
    """S_sim with one factor per parameter for the whole plant, uniform within `SPREAD`; disturbed as S_real is."""
    base = load_plant("sim_plant/plants/s_sim.toml").model_copy(update={"spans": spans})
    disturbance = load_plant("sim_plant/plants/s_real.toml").rollers.disturbance_m_per_s2
    generator = np.random.default_rng(seed)
    while True:
        drawn = {name: float(generator.uniform(1.0 - spread, 1.0 + spread)) for name, spread in SPREAD.items()}
        plant = scaled(base, drawn)
        p = plant.parameters()
        if (p.friction_nms_per_rad * FASTEST_M_PER_S / p.radius_m <= MOST_FRICTION_NM).all():
            rollers = plant.rollers.model_copy(update={"disturbance_m_per_s2": disturbance})
            return plant.model_copy(update={"name": f"random-{seed}", "rollers": rollers})


def uneven_plant(seed: int, spans: int = 6) -> Plant:
    """`random_plant` with every roller and span off by up to `UNEVEN`, each parameter by itself; the web is one."""
    generator, plant = np.random.default_rng((seed, 1)), random_plant(seed, spans)
    p = plant.parameters()
    while True:
        factors = {
            name: generator.uniform(1.0 - UNEVEN, 1.0 + UNEVEN, spans) for name in SPREAD if name != "stiffness_n"
        }
        of = {name: (getattr(p, name) * factor).tolist() for name, factor in factors.items()}
        friction_nm = np.array(of["friction_nms_per_rad"]) * FASTEST_M_PER_S / np.array(of["radius_m"])
        if (friction_nm <= MOST_FRICTION_NM).all():
            rollers = plant.rollers.model_copy(update={name: of[name] for name in of if name != "length_m"})
            web = plant.web.model_copy(update={"length_m": of["length_m"]})
            return plant.model_copy(update={"name": f"uneven-{seed}", "web": web, "rollers": rollers})


def stressed_plant() -> Plant:
    """S_real whose rollers are moved by white noise of intensity 5e-2, held for 1 ms."""
    plant = load_plant("sim_plant/plants/s_real.toml")
    rollers = plant.rollers.model_copy(update={"disturbance_m_per_s2": STRESS_M_PER_S1_5 / float(np.sqrt(STEP_S))})
    return plant.model_copy(update={"name": "stressed", "rollers": rollers})


def scaled(plant: Plant, factors: dict[str, float]) -> Plant:
    """`plant` with parameters multiplied, each by one factor for all spans or rollers."""
    p = plant.parameters()
    of = {name: (getattr(p, name) * factor).tolist() for name, factor in factors.items()}
    web = {name: of[name] for name in ("stiffness_n", "length_m") if name in of}
    rollers = {name: of[name] for name in ("radius_m", "inertia_kg_m2", "friction_nms_per_rad") if name in of}
    return plant.model_copy(
        update={"web": plant.web.model_copy(update=web), "rollers": plant.rollers.model_copy(update=rollers)}
    )
