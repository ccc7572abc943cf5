"""A line of three spans at 8 m/s with a reel of 76 kg m2 at its end, and its truth, in stepped time."""

import tomllib
from typing import Any

from gateway.cli.stepped import SteppedLoop
from gateway.control.design import design_lqi, task_of
from gateway.core.line import Line
from gateway.core.line_template import line_template
from sim_plant.plant import Plant, plant_of

TOP_M_PER_S = 8.0
TENSION_N = (150.0, 150.0, 150.0)
TENSION_MIN_N, TENSION_MAX_N = 20.0, 300.0
STIFFNESS_N, LENGTH_M = 40_000.0, 1.5
RADIUS_M, INERTIA_KG_M2 = (0.15, 0.15, 0.45), (12.0, 15.0, 76.0)
FRICTION_NMS_PER_RAD = (0.2, 0.2, 0.4)
TORQUE_NM, TORQUE_RATE_NM_PER_S = 500.0, 8000.0


def reel_line(*, brakes: bool = True) -> Line:
    """With brakes for 8 s from the greatest speed, or none."""
    document: dict[str, Any] = tomllib.loads(line_template(3))
    document["limits"] |= {
        "torque_nm": TORQUE_NM, "torque_rate_nm_per_s": TORQUE_RATE_NM_PER_S, "tension_min_n": TENSION_MIN_N,
        "tension_max_n": TENSION_MAX_N, "tension_margin_n": 5.0, "speed_max_m_per_s": TOP_M_PER_S,
        "tension_step_max_n": 0.0, "speed_step_max_m_per_s": 0.0,
    }  # fmt: skip
    document["moves"] |= {
        "stop_rate_m_per_s2": 0.7, "stop_time_s": 12.0, "speed_rate_m_per_s2": 0.5, "torque_off_rate_nm_per_s": 2000.0,
    }  # fmt: skip
    document["web"]["stiffness_n"] = {"value": STIFFNESS_N, "tolerance": 0.1}
    for i in range(3):
        document["rollers"][i] |= {
            "radius_m": {"value": RADIUS_M[i], "tolerance": 0.02},
            "inertia_kg_m2": {"value": INERTIA_KG_M2[i], "tolerance": 0.1},
            "friction_nms_per_rad": {"value": FRICTION_NMS_PER_RAD[i], "tolerance": 0.3},
        }
        document["spans"][i]["length_m"] = {"value": LENGTH_M, "tolerance": 0.1}
        document["drives"][i]["rated_torque_nm"] = TORQUE_NM
        if brakes:
            document["drives"][i] |= {"braking_torque_nm": 280.0, "braking_power_w": 5000.0}
        document["load_cells"][i]["capacity_n"] = 400.0
    document["recipes"] = [{"name": "reel", "tension_n": list(TENSION_N), "speed_m_per_s": 7.0}]
    return Line.model_validate(document)


def reel_plant() -> Plant:
    """Its truth."""
    return plant_of(
        {
            "format": 1,
            "name": "reel",
            "spans": 3,
            "web": {"stiffness_n": STIFFNESS_N, "length_m": LENGTH_M},
            "rollers": {
                "radius_m": list(RADIUS_M), "inertia_kg_m2": list(INERTIA_KG_M2),
                "friction_nms_per_rad": list(FRICTION_NMS_PER_RAD), "disturbance_m_per_s2": 0.01,
            },
            "sensors": {"tension_noise_n": 0.3, "speed_noise_m_per_s": 2e-4},
            "drives": {"rated_torque_nm": TORQUE_NM, "max_torque_nm": TORQUE_NM, "torque_lag_s": 0.002},
            "plc": {"speed_ramp_m_per_s2": 2.0},
            "effects": {"slack": True},
            "recorder": {
                "torque_nm": TORQUE_NM, "torque_rate_nm_per_s": TORQUE_RATE_NM_PER_S,
                "tension_min_n": TENSION_MIN_N, "tension_max_n": TENSION_MAX_N,
            },
        }
    )  # fmt: skip


def reel_loop(*, brakes: bool = True, seed: int = 1) -> SteppedLoop:
    """A loop on it, SILENT, under the designed LQI."""
    line = reel_line(brakes=brakes)
    return SteppedLoop(line, design_lqi(task_of(line)), reel_plant(), seed)
