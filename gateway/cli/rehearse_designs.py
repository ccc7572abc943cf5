"""The configurations that a rehearsal compares, and what a design can know of the truth."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from gateway.control.design import (
    DesignTask,
    design_lqg,
    design_lqi,
    design_lqr,
    design_mpc,
    design_pid,
    margins,
    mpc_weights,
    require_margin,
    without_disturbances,
)
from gateway.core.controller import Controller
from gateway.core.web_model import WebModel
from sim_plant.plant import Plant

NOMINAL, TRUTH = "nominal", "truth"


@dataclass(frozen=True)
class Design:
    """How a configuration comes about."""

    name: str
    law: str
    model: str  #: NOMINAL or TRUTH
    make: Callable[[DesignTask], Controller]


def mpc_without_observer(task: DesignTask) -> Controller:
    """The paper's baseline: nothing in it takes an offset away."""
    return design_mpc(task, without_disturbances(mpc_weights(task)))


DESIGNS = (
    Design("lqr", "lqr", NOMINAL, design_lqr),  # the paper's Initial
    Design("lqi", "lqi", NOMINAL, design_lqi),
    Design("pid", "pid", NOMINAL, design_pid),
    Design("lqg", "lqg", NOMINAL, design_lqg),
    Design("mpc", "mpc", NOMINAL, mpc_without_observer),
    Design("mpc-observer", "mpc", NOMINAL, design_mpc),
    Design("truth-lqi", "lqi", TRUTH, design_lqi),
    Design("truth-mpc-observer", "mpc", TRUTH, design_mpc),
)


def offered(design: Design, task: DesignTask) -> Controller:
    """The configuration on the model of `task`. Raises DesignRefused, also where it stands too little delay."""
    config = design.make(task)
    require_margin(margins(config, task))
    return config


def truth_of(plant: Plant) -> WebModel:
    """What a design knows when it knows the truth, as far as its model has a term for it.

    Of a stiffness that differs from span to span the model has the mean, with lengths that leave E A / L as it is.
    """
    p = plant.parameters()
    stiffness_n = float(np.mean(p.stiffness_n))
    return WebModel(
        stiffness_n=stiffness_n,
        length_m=p.length_m * stiffness_n / p.stiffness_n,
        radius_m=p.radius_m,
        inertia_kg_m2=p.inertia_kg_m2,
        friction_nms_per_rad=p.friction_nms_per_rad,
        tension_before_n=p.tension_before_n,
        tension_after_n=p.tension_after_n,
    )


def without_term(plant: Plant) -> list[str]:
    """What `plant` does that the model of a design has no term for: its keys, each with what it is."""
    effects, sensors, drives = plant.effects, plant.sensors, plant.drives
    friction = effects.friction
    there: list[tuple[object, str]] = [
        (np.ptp(plant.parameters().stiffness_n), "web.stiffness_n: another in each span"),
        (effects.slack, "effects.slack: the web cannot push"),
        (_any(friction.coulomb_nm, friction.breakaway_nm), "effects.friction: dry friction of the bearings"),
        (_any(friction.rise_per_s), "effects.friction.rise_per_s: friction that grows"),
        (_any(effects.eccentricity.share), "effects.eccentricity: rollers that run out of true"),
        (effects.relaxation.stiffness_share, "effects.relaxation: a web that relaxes"),
        (effects.slip.on, "effects.slip: a web that slides on a roller"),
        (effects.unwinder.eccentricity, "effects.unwinder.eccentricity: an unwinder that runs out of true"),
        (effects.reels.thickness_m, "effects.reels: reels whose radius and inertia change"),
        (drives.torque_lag_s, "drives.torque_lag_s: torque behind its command"),
        (drives.torque_step_nm, "drives.torque_step_nm: quantised torque"),
        (drives.torque_rate_nm_per_s, "drives.torque_rate_nm_per_s: drives that ramp their torque"),
        (sensors.tension_corner_hz, "sensors.tension_corner_hz: low pass of the load cells"),
        (_any(sensors.tension_zero_n, sensors.tension_zero_per_n), "sensors.tension_zero_n: load cells with an offset"),
        (
            _any(sensors.tension_drift_n_per_s, sensors.tension_walk_n_per_sqrt_s),
            "sensors.tension_drift_n_per_s: load cells that drift",
        ),
        (sensors.tension_step_n, "sensors.tension_step_n: quantised tension"),
        (sensors.speed_step_m_per_s, "sensors.speed_step_m_per_s: quantised speed"),
        (plant.plc.speed_ramp_m_per_s2 != "step", "plc.speed_ramp_m_per_s2: a speed that follows its request late"),
    ]
    return [what for acts, what in there if acts]


def _any(*values: float | list[float]) -> bool:
    return any(np.any(value) for value in values)
