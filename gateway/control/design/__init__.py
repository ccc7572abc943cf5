"""From what is believed about the web to controller configurations. Design time only: the loop never imports this."""

from gateway.control.design.lq import design_lqg, design_lqi, design_lqr
from gateway.control.design.margins import Margins, is_stable, margins, require_margin, weak_spots
from gateway.control.design.mpc import design_mpc
from gateway.control.design.pid import design_pid
from gateway.control.design.schedule import design_scheduled, gains_change
from gateway.control.design.task import DesignLimits, DesignRefused, DesignTask, task_of, task_on
from gateway.control.design.weights import (
    LqgWeights,
    LqiWeights,
    LqrWeights,
    LqWeights,
    MpcWeights,
    lqg_weights,
    lqi_weights,
    lqr_weights,
    mpc_weights,
    without_disturbances,
)

__all__ = [
    "DesignLimits",
    "DesignRefused",
    "DesignTask",
    "LqWeights",
    "LqgWeights",
    "LqiWeights",
    "LqrWeights",
    "Margins",
    "MpcWeights",
    "design_lqg",
    "design_lqi",
    "design_lqr",
    "design_mpc",
    "design_pid",
    "design_scheduled",
    "gains_change",
    "is_stable",
    "lqg_weights",
    "lqi_weights",
    "lqr_weights",
    "margins",
    "mpc_weights",
    "require_margin",
    "task_of",
    "task_on",
    "weak_spots",
    "without_disturbances",
]
