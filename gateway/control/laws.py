"""From a controller configuration to a law that runs."""

from typing import Any

from gateway.control.law import Law
from gateway.control.lqg import Lqg
from gateway.control.lqi import Lqi
from gateway.control.lqr import Lqr
from gateway.control.pid import Pid
from gateway.control.scheduled import Scheduled, SpeedGrid
from gateway.core.controller import Controller
from gateway.core.controller_laws import LqgConfig, LqiConfig, LqrConfig, MpcConfig, PidConfig
from gateway.core.controller_schedule import ScheduledConfig

ENDLESS_S = 1e6


def untimed(config: Controller) -> Controller:
    """`config` for stepped time, in which nothing is late: what a run gives must not depend on the computer."""
    return config.model_copy(update={"time_limit_s": ENDLESS_S}) if isinstance(config, MpcConfig) else config


def make_law(config: Controller) -> Law[Any]:
    """The law that `config` describes."""
    match config:
        case PidConfig():
            return Pid(config)
        case LqrConfig():
            return Lqr(config)
        case LqiConfig():
            return Lqi(config)
        case LqgConfig():
            return Lqg(config)
        case MpcConfig():
            from gateway.control.mpc import Mpc  # the solver, for those who use it

            return Mpc(config)
        case ScheduledConfig():
            grid = SpeedGrid(config)
            return Scheduled(grid, [make_law(law) for law in grid.laws])
