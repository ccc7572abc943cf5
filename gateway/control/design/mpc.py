"""Design of the model predictive controller: its weights, its horizon, what it costs at the end."""

from dataclasses import replace
from math import floor, isfinite

from gateway.control.design.lq import design_predictor, feedback, shared
from gateway.control.design.task import DesignRefused, DesignTask, check_task
from gateway.control.design.weights import MpcWeights, lqi_weights, mpc_weights
from gateway.core.controller_laws import MpcConfig

NO_LIMIT = 1e6  #: Nm and N: for a limit that is not given


HORIZON_S = 0.15  #: that the blocks cover, as far as there are periods in it
BLOCKS = 7
#: Of the band between the limits of tension, at either end, which the plan keeps clear of: noise, and a plant that is
#: not quite the model, take it beyond what it planned.
ROOM = 0.12
TIME_SHARE = 0.3  #: of a period that a solution may take; half of it may go before the samples are in


def design_mpc(task: DesignTask, weights: MpcWeights | None = None, blocks: tuple[int, ...] | None = None) -> MpcConfig:
    """MPC whose cost beyond the horizon is that of the linear feedback without limits.

    Raises DesignRefused.
    """
    check_task(task)
    weights = weights or mpc_weights(task)
    blocks = default_blocks(task.period_s) if blocks is None else blocks
    if not blocks or min(blocks) < 1:
        raise DesignRefused(f"the horizon's blocks are {list(blocks)}; allowed: one or more, each of 1 period or more")
    n, limits = task.n, task.limits
    bounded = isfinite(limits.tension_max_n)
    room_n = ROOM * (limits.tension_max_n - limits.tension_min_n) if bounded else 0.0
    _, remaining = feedback(task, weights)
    cautious = lqi_weights(task).torque_per_nm2
    # The feedback of the problem itself is too eager for limits that it does not know of.
    fallback, _ = feedback(task, replace(weights, torque_per_nm2=max(weights.torque_per_nm2, cautious)))
    state = [weights.tension_per_n2] * n + [weights.speed_per_m2_s2] * n
    for i in task.draw_spans:
        state[i], state[n + i] = 0.0, weights.draw_speed_per_m2_s2
    return MpcConfig(
        **shared(task),
        predictor=design_predictor(task, weights),
        weight_state=state,
        weight_torque=[weights.torque_per_nm2] * n,
        weight_terminal=remaining.tolist(),
        blocks=list(blocks),
        torque_nm=min(limits.torque_nm, NO_LIMIT),
        torque_rate_nm_per_s=min(limits.torque_rate_nm_per_s, NO_LIMIT),
        tension_min_n=limits.tension_min_n + room_n,
        tension_max_n=min(limits.tension_max_n - room_n, NO_LIMIT),
        weight_tension_limit=weights.tension_limit_per_n2 if bounded else 0.0,
        fallback_state=fallback[:, : 2 * n].tolist(),
        fallback_input=fallback[:, 2 * n :].tolist(),
        time_limit_s=TIME_SHARE * task.period_s,
    )


def default_blocks(period_s: float) -> tuple[int, ...]:
    """Seven blocks over 0.15 s, each about half as long as the one behind it, but a period at least.

    The first torque is planned period by period, what comes late only roughly; the size of the problem does not depend
    on the period. 10 ms: 1, 1, 1, 1, 2, 3, 6.
    """
    periods = round(HORIZON_S / period_s)
    last = 1
    while sum(_halved(last + 1)) <= periods:
        last += 1
    return _halved(last)


def _halved(last: int) -> tuple[int, ...]:
    return (1, *(max(1, floor(last / 2**k + 0.5)) for k in reversed(range(BLOCKS - 1))))
