"""Design of laws over a range of speeds, and how much their gains change over it."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from gateway.control.design.lq import shared
from gateway.control.design.task import DesignRefused, DesignTask
from gateway.core.controller_laws import MpcConfig
from gateway.core.controller_schedule import LinearConfig, ScheduledConfig, parts, wrong_speeds
from gateway.core.signals import FloatArray


def design_scheduled(
    task: DesignTask, design: Callable[[DesignTask], LinearConfig | MpcConfig], speeds_m_per_s: list[float]
) -> ScheduledConfig:
    """What `design` makes of the task at each speed of the unwinder (ascending, m/s), in place of the task's own.

    Raises DesignRefused for speeds that are no schedule, for MPC, and for what `design` refuses, with the speed.
    """
    if wrong := wrong_speeds(speeds_m_per_s):
        raise DesignRefused(wrong)
    laws: list[LinearConfig] = []
    for speed in speeds_m_per_s:
        try:
            law = design(replace(task, unwind_speed_m_per_s=speed))
        except DesignRefused as refused:
            raise DesignRefused(f"at {speed:g} m/s: {refused}") from refused
        if isinstance(law, MpcConfig):
            raise DesignRefused("mpc has no schedule: its programme belongs to one model; allowed: pid, lqr, lqi, lqg")
        laws.append(law)
    return ScheduledConfig(**shared(task), speed_m_per_s=speeds_m_per_s, laws=laws)


def gains_change(config: ScheduledConfig) -> dict[str, float]:
    """By how much each matrix changes over the nodes: the greatest distance of two, by the greatest norm (Frobenius).

    What acts on tensions and speeds is looked at apart, for its units differ. 0: the same at all speeds.
    """
    of_nodes = [_blocks(law) for law in config.laws]
    found: dict[str, float] = {}
    for name in of_nodes[0]:
        values = np.array([blocks[name].ravel() for blocks in of_nodes])
        apart = np.linalg.norm(values[:, None] - values[None, :], axis=2).max()
        greatest = np.linalg.norm(values, axis=1).max()
        found[name] = float(apart / greatest) if greatest > 0.0 else 0.0
    return found


def _blocks(law: LinearConfig) -> dict[str, FloatArray]:
    found: dict[str, FloatArray] = {}
    for name, value in parts(law).items():
        if name in ("gain_state", "gain_proportional"):
            found[f"{name} on tension"], found[f"{name} on speed"] = value[:, : law.n], value[:, law.n :]
        else:
            found[name] = value
    return found
