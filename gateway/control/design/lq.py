"""Linear-quadratic designs: LQR, LQI, and LQG on an observer of torque disturbances."""

from typing import TypedDict

import numpy as np
from scipy.linalg import LinAlgError, solve_discrete_are

from gateway.control.design.sampling import with_dead_time
from gateway.control.design.task import DesignRefused, DesignTask, check_task, feedforward_of, linear
from gateway.control.design.weights import (
    LqgWeights,
    LqiWeights,
    LqrWeights,
    LqWeights,
    lqg_weights,
    lqi_weights,
    lqr_weights,
)
from gateway.control.sampled import Sampled
from gateway.core.controller_laws import Feedforward, LqgConfig, LqiConfig, LqrConfig, Predictor
from gateway.core.signals import FloatArray


def design_lqr(task: DesignTask, weights: LqrWeights | None = None) -> LqrConfig:
    """State feedback on the sampled model with its dead time, without integral action. Raises DesignRefused."""
    check_task(task)  # what the weights follow from must be numbers
    weights = weights or lqr_weights(task)
    gain, _ = feedback(task, weights, weights.common_torque)
    n = task.n
    return LqrConfig(**shared(task), gain_state=gain[:, : 2 * n].tolist(), gain_input=gain[:, 2 * n :].tolist())


def design_lqi(task: DesignTask, weights: LqiWeights | None = None) -> LqiConfig:
    """LQI on the sampled model with its dead time: states tension, speed, torques in flight, integrals.

    Raises DesignRefused where the Riccati equation has no stabilising solution.
    """
    check_task(task)  # what the weights follow from must be numbers
    weights = weights or lqi_weights(task)
    _check(task, weights)
    n, plant, kept = task.n, *_controlled(task)
    F, G = plant.augmented()
    states, size = F.shape[0], F.shape[0] + n
    draw = np.array(task.draw_spans, dtype=int)
    integral = np.full(n, weights.integral_per_n2s2)
    integral[draw] = weights.draw_integral_per_m2
    F_i = np.zeros((size, size))
    F_i[:states, :states] = F
    F_i[states:, states:] = np.eye(n)
    for i in range(n):
        F_i[states + i, kept.index(n + i if i in task.draw_spans else i)] = task.period_s
    G_i = np.vstack((G, np.zeros((n, n))))
    cost = np.concatenate((_state_cost(task, weights, kept), np.zeros(n * plant.depth), integral))
    gain, _ = dlqr(F_i, G_i, np.diag(cost), weights.torque_per_nm2 * np.eye(n))
    return LqiConfig(
        **shared(task),
        gain_state=_spread(gain[:, : len(kept)], kept, 2 * n).tolist(),
        gain_input=gain[:, len(kept) : states].tolist(),
        gain_integral=gain[:, states:].tolist(),
        antiwindup=weights.antiwindup,
    )


def design_lqg(task: DesignTask, weights: LqgWeights | None = None) -> LqgConfig:
    """Feedback on the estimate of `design_predictor`. Raises DesignRefused."""
    check_task(task)  # what the weights follow from must be numbers
    weights = weights or lqg_weights(task)
    gain, _ = feedback(task, weights)
    n = task.n
    return LqgConfig(
        **shared(task),
        predictor=design_predictor(task, weights),
        gain_state=gain[:, : 2 * n].tolist(),
        gain_input=gain[:, 2 * n :].tolist(),
    )


def design_predictor(task: DesignTask, weights: LqgWeights) -> Predictor:
    """The stationary Kalman filter of [x~; d], d a random walk of the intensity in `weights` (0: there is none).

    Raises DesignRefused.
    """
    n = task.n
    walks = weights.disturbance_nm_per_sqrt_s > 0.0
    A, B = linear(task)
    plant = with_dead_time(A, B, task.period_s, task.latency_s)
    whole: FloatArray = np.eye(3 * n)
    whole[: 2 * n, : 2 * n] = plant.transition
    whole[: 2 * n, 2 * n :] = np.sum(plant.inputs, axis=0)
    measured = [*task.tension_spans, *range(n, 2 * n)]
    states = 3 * n if walks else 2 * n
    F, C = whole[:states, :states], np.eye(states)[measured]
    moved = np.concatenate(
        (
            np.full(n, weights.web_noise_n_per_sqrt_s**2 * task.period_s),
            np.full(n, (weights.roller_noise * task.noise.acceleration_m_per_s1_5) ** 2 * task.period_s),
            np.full(n, weights.disturbance_nm_per_sqrt_s**2 * task.period_s),
        )
    )[:states]
    seen = np.repeat([task.noise.tension_n**2, task.noise.speed_m_per_s**2], [len(task.tension_spans), n])
    try:
        P: FloatArray = np.asarray(solve_discrete_are(F.T, C.T, np.diag(moved), np.diag(seen)), dtype=np.float64)
    except (LinAlgError, ValueError) as error:
        raise DesignRefused(f"no observer: {error}. The noise must be above 0") from error
    gain = np.zeros((3 * n, 2 * n))
    gain[:states, measured] = np.linalg.solve(C @ P @ C.T + np.diag(seen), C @ P).T
    return Predictor(
        transition=plant.transition.tolist(),
        inputs=[matrix.tolist() for matrix in plant.inputs],
        gain_state=gain[: 2 * n].tolist(),
        gain_disturbance=gain[2 * n :].tolist(),
    )


def feedback(task: DesignTask, weights: LqWeights, common_torque: float = 1.0) -> tuple[FloatArray, FloatArray]:
    """K (n, 2n + n d) on [x~; torques in flight], and the matrix P of the cost that remains.

    Torque that all rollers give alike has `common_torque` times the weight. Raises DesignRefused.
    """
    _check(task, weights)
    n, plant, kept = task.n, *_controlled(task)
    F, G = plant.augmented()
    cost = np.concatenate((_state_cost(task, weights, kept), np.zeros(n * plant.depth)))
    effort = weights.torque_per_nm2 * (np.eye(n) - (1.0 - common_torque) / n)
    gain, remaining = dlqr(F, G, np.diag(cost), effort)
    columns = [*kept, *range(2 * n, 2 * n + n * plant.depth)]
    whole = np.zeros((2 * n + n * plant.depth,) * 2)
    whole[np.ix_(columns, columns)] = remaining
    return _spread(gain, columns, whole.shape[0]), whole


def dlqr(F: FloatArray, G: FloatArray, Q: FloatArray, R: FloatArray) -> tuple[FloatArray, FloatArray]:
    """K of u = -K x that minimises sum x'Qx + u'Ru, and its P. Raises DesignRefused where none stabilises."""
    try:
        P: FloatArray = np.asarray(solve_discrete_are(F, G, Q, R), dtype=np.float64)
    except (LinAlgError, ValueError) as error:
        text = f"the Riccati equation has no stabilising solution ({error}): check the model's parameters"
        raise DesignRefused(text) from error
    gain: FloatArray = np.asarray(np.linalg.solve(R + G.T @ P @ G, G.T @ P @ F), dtype=np.float64)
    radius = np.abs(np.linalg.eigvals(F - G @ gain)).max()
    if not radius < 1.0:
        raise DesignRefused(f"the closed loop would have a spectral radius of {radius:.4f}, it must stay below 1")
    return gain, P


class Shared(TypedDict):
    """The fields that every law has."""

    period_s: float
    latency_s: float
    draw_spans: list[int]
    feedforward: Feedforward


def shared(task: DesignTask) -> Shared:
    """Those of a task."""
    return {
        "period_s": task.period_s,
        "latency_s": task.latency_s,
        "draw_spans": list(task.draw_spans),
        "feedforward": feedforward_of(task.model),
    }


def _check(task: DesignTask, weights: LqWeights) -> None:
    check_task(task)
    values = vars(weights)
    wrong = [
        f"{name} is {value}; allowed: 0 and above, finite" for name, value in values.items() if not 0 <= value < np.inf
    ]
    if not weights.torque_per_nm2 > 0.0:
        wrong.append(f"torque_per_nm2 is {weights.torque_per_nm2}; allowed: above 0")
    if not values.get("common_torque", 1.0) > 0.0:
        wrong.append("common_torque is 0; allowed: above 0")
    if not (weights.tension_per_n2 > 0.0 or weights.speed_per_m2_s2 > 0.0):
        wrong.append("tension_per_n2 and speed_per_m2_s2 are both 0: there is nothing to control")
    if wrong:
        raise DesignRefused("; ".join(wrong))


def _controlled(task: DesignTask) -> tuple[Sampled, list[int]]:
    """The sampled plant without the tensions of draw spans, and the states (of 2n) that it has.

    A draw span's tension is not measured: it acts as a disturbance.
    """
    kept = [*task.tension_spans, *range(task.n, 2 * task.n)]
    A, B = linear(task)
    return with_dead_time(A[np.ix_(kept, kept)], B[kept], task.period_s, task.latency_s), kept


def _state_cost(task: DesignTask, weights: LqWeights, kept: list[int]) -> FloatArray:
    cost = np.repeat([weights.tension_per_n2, weights.speed_per_m2_s2], task.n)
    cost[[task.n + i for i in task.draw_spans]] = weights.draw_speed_per_m2_s2
    return cost[kept]


def _spread(gain: FloatArray, columns: list[int], width: int) -> FloatArray:
    """`gain` with its columns at `columns` of `width`, zero elsewhere."""
    whole = np.zeros((gain.shape[0], width))
    whole[:, columns] = gain
    return whole
