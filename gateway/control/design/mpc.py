"""Design of the model predictive controller: its weights, its horizon, what it costs at the end."""

from dataclasses import dataclass, replace
from math import isfinite

from gateway.control.design.lq import LqgWeights, design_predictor, feedback, shared
from gateway.control.design.task import DesignRefused, DesignTask
from gateway.core.controller_laws import MpcConfig

NO_LIMIT = 1e6  #: Nm and N: for a limit that is not given


@dataclass(frozen=True)
class MpcWeights(LqgWeights):
    """As `LqgWeights`, and the weight of tension beyond its limits."""

    torque_per_nm2: float = 1.0e-3
    disturbance_nm_per_sqrt_s: float = 1.0
    tension_limit_per_n2: float = 10.0


DEFAULT_BLOCKS = (1, 1, 1, 1, 2, 3, 6)
FALLBACK_TORQUE_PER_NM2 = 0.06
TIME_SHARE = 0.3  #: of a period that a solution may take; half of it may go before the samples are in


def design_mpc(
    task: DesignTask, weights: MpcWeights | None = None, blocks: tuple[int, ...] = DEFAULT_BLOCKS
) -> MpcConfig:
    """MPC whose cost beyond the horizon is that of the linear feedback without limits.

    Raises DesignRefused.
    """
    weights = weights or MpcWeights()
    if not blocks or min(blocks) < 1:
        raise DesignRefused(f"the horizon's blocks are {list(blocks)}; allowed: one or more, each of 1 period or more")
    n, limits = task.n, task.limits
    _, remaining = feedback(task, weights)
    # The feedback of the problem itself is too eager for limits that it does not know of.
    fallback, _ = feedback(task, replace(weights, torque_per_nm2=max(weights.torque_per_nm2, FALLBACK_TORQUE_PER_NM2)))
    state = [weights.tension_per_n2] * n + [weights.speed_per_m2_s2] * n
    for i in task.draw_spans:
        state[i], state[n + i] = 0.0, weights.draw_speed_per_m2_s2
    return MpcConfig(
        **shared(task),
        predictor=design_predictor(task, weights.disturbance_nm_per_sqrt_s),
        weight_state=state,
        weight_torque=[weights.torque_per_nm2] * n,
        weight_terminal=remaining.tolist(),
        blocks=list(blocks),
        torque_nm=min(limits.torque_nm, NO_LIMIT),
        torque_rate_nm_per_s=min(limits.torque_rate_nm_per_s, NO_LIMIT),
        tension_min_n=limits.tension_min_n,
        tension_max_n=min(limits.tension_max_n, NO_LIMIT),
        weight_tension_limit=weights.tension_limit_per_n2 if isfinite(limits.tension_max_n) else 0.0,
        fallback_state=fallback[:, : 2 * n].tolist(),
        fallback_input=fallback[:, 2 * n :].tolist(),
        time_limit_s=TIME_SHARE * task.period_s,
    )
