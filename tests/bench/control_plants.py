"""The ensemble: random plants around S_sim, as a line that was built to the drawing of S_sim may turn out."""

import numpy as np

from sim_plant.drawn import FASTEST_M_PER_S, MOST_FRICTION_NM, SPREAD, random_plant, scaled
from sim_plant.physics import STEP_S
from sim_plant.plant import Plant, load_plant

__all__ = [
    "FASTEST_M_PER_S", "MOST_FRICTION_NM", "SPREAD", "TEST", "random_plant", "scaled", "stressed_plant", "uneven_plant",
]  # fmt: skip

TEST = range(10_000, 10_100)  #: seeds of the 100 test plants; weights are tuned on others, below
UNEVEN = 0.1  #: of a roller or span about what is common to its line
STRESS_M_PER_S1_5 = 5e-2


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
