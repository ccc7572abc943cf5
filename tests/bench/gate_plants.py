"""Lines that the gate is tried on: S_real and random ones, with what no model of the gateway has on top.

Their seeds are of no other benchmark. Even places in the list are for tuning, odd ones for the figures.
"""

import numpy as np

from sim_plant.plant import Plant
from tests.bench.control_plants import random_plant
from tests.closed_loop.recorded import per_roller, real_plant
from tests.closed_loop.truths import altered

FIRST_SEED = 61_000
SPREAD = 0.02  #: of every roller and span by itself


def plant_number(number: int) -> Plant:
    """0: S_real; else a random one around S_sim. Each with lag, dry friction, eccentricity, slow cells."""
    base = real_plant() if number == 0 else random_plant(FIRST_SEED + number)
    generator = np.random.default_rng(FIRST_SEED + number)
    n = base.spans
    return altered(
        per_roller(base, SPREAD, FIRST_SEED + number),
        {
            "drives": {"torque_lag_s": float(generator.uniform(0.001, 0.004)), "torque_step_nm": 0.02},
            "sensors": {
                "tension_corner_hz": float(1.0 / (2.0 * np.pi * generator.uniform(0.0005, 0.0015))),
                "tension_step_n": 0.0122,
                "speed_step_m_per_s": 2e-5,
            },
            "effects": {
                "friction": {"coulomb_nm": generator.uniform(0.2, 1.5, n).tolist()},
                "eccentricity": {
                    "share": generator.uniform(0.0, 2e-3, n).tolist(),
                    "phase_rad": generator.uniform(0.0, 2.0 * np.pi, n).tolist(),
                },
            },
        },
    )


def is_for_tuning(number: int) -> bool:
    """Half of the lines, by their number."""
    return number % 2 == 0 and number > 0
