"""Plants with one effect on and nothing else in its way: no noise, and no more spans than needed."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from sim_plant.plant import Plant, plant_of
from sim_plant.world import World

Array = NDArray[np.float64]

STIFFNESS_N, LENGTH_M, RADIUS_M, INERTIA_KG_M2, FRICTION = 2200.0, 1.2, 0.035, 1.0, 15.0
HELD_NM = 1e6  #: break-away torque of a roller that nothing moves


def plant(spans: int = 1, **tables: Any) -> Plant:
    """The paper's line with quiet rollers and sensors. Tables are merged into it, [effects] as it is given."""
    document: dict[str, Any] = {
        "format": 1,
        "name": "test",
        "spans": spans,
        "web": {"stiffness_n": STIFFNESS_N, "length_m": LENGTH_M},
        "rollers": {
            "radius_m": RADIUS_M,
            "inertia_kg_m2": INERTIA_KG_M2,
            "friction_nms_per_rad": FRICTION,
            "disturbance_m_per_s2": 0.0,
        },
        "sensors": {"tension_noise_n": 0.0, "speed_noise_m_per_s": 0.0},
    }
    for name, table in tables.items():
        document[name] = {**document.get(name, {}), **table}
    return plant_of(document)


def free_roller(**tables: Any) -> World:
    """One roller without viscous friction, on a web that is too soft to matter."""
    soft: dict[str, Any] = {"web": {"stiffness_n": 1e-9}, "rollers": {"friction_nms_per_rad": 0.0}}
    for name, table in tables.items():
        soft[name] = {**soft.get(name, {}), **table}
    return World(plant(**soft), seed=1)


def held_span(**effects: Any) -> World:
    """One span whose far end is held for ever: what the unwinder does is all that stretches it."""
    return World(plant(effects={"friction": {"breakaway_nm": HELD_NM}, **effects}), seed=1)


def rows_of(world: World, until_s: float) -> Array:
    """The trace (m, 3n+1) of what comes until then."""
    pieces: list[Array] = []
    world.on_rows = lambda _first, rows: pieces.append(rows.copy())
    world.advance(until_s)
    world.on_rows = None
    return np.concatenate(pieces)
