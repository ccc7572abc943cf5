"""From what is believed about the web to controller configurations. Design time only: the loop never imports this."""

from dataclasses import dataclass
from math import floor

import numpy as np
from scipy.linalg import LinAlgError, expm, solve_discrete_are

from gateway.core.controller import Feedforward, LqiConfig, PidConfig
from gateway.core.line import Line
from gateway.core.signals import FloatArray
from gateway.core.web_model import WebModel, linearise, nominal_model, reference_speeds


class DesignRefused(Exception):
    """No controller can be offered; the text says why."""


@dataclass(frozen=True)
class DesignTask:
    """What a design is made for. Tensions (n,) in N and a speed in m/s fix the operating point."""

    model: WebModel
    period_s: float
    latency_s: float
    tension_n: FloatArray
    unwind_speed_m_per_s: float
    draw_spans: tuple[int, ...] = ()


@dataclass(frozen=True)
class LqiWeights:
    """Weights per squared deviation. Chosen on 60 random plants around S_sim (EA, J, L +-20 %, R +-15 %, f +-50 %),
    both cases of the benchmark at 10 ms period and latency: the smallest sum of RMSEs whose peaks stay below 52 N."""

    tension_per_n2: float = 1.0
    speed_per_m2_s2: float = 0.0
    integral_per_n2s2: float = 1000.0
    draw_speed_per_m2_s2: float = 4.0e4  #: of a draw span, in place of the tension's weight
    draw_integral_per_m2: float = 4.0e6
    torque_per_nm2: float = 0.06
    antiwindup: float = 0.4


def task_of(line: Line) -> DesignTask:
    """The design task of a line: its nominal model at the first recipe's tensions and half the greatest speed."""
    return DesignTask(
        model=nominal_model(line),
        period_s=line.control.period_s,
        latency_s=line.control.latency_s,
        tension_n=np.array(line.recipes[0].tension_n),
        unwind_speed_m_per_s=0.5 * line.limits.speed_max_m_per_s,
        draw_spans=tuple(i for i, span in enumerate(line.spans) if span.control == "draw"),
    )


def design_lqi(task: DesignTask, weights: LqiWeights | None = None) -> LqiConfig:
    """LQI on the sampled model with its dead time: states tension, speed, torques in flight, integrals.

    Raises DesignRefused where the Riccati equation has no stabilising solution.
    """
    weights = weights or LqiWeights()
    n = task.model.n
    tensions = np.array([i for i in range(n) if i not in task.draw_spans], dtype=int)
    kept = np.concatenate((tensions, np.arange(n, 2 * n)))
    speed = reference_speeds(task.model, task.tension_n, task.unwind_speed_m_per_s)
    A, B = linearise(task.model, task.tension_n, speed, task.unwind_speed_m_per_s)
    # A draw span's tension is not measured: it acts as a disturbance that the integral on its roller's speed removes.
    F, G, states, depth = _augment(A[np.ix_(kept, kept)], B[kept], task.period_s, task.latency_s)

    draw = np.array(task.draw_spans, dtype=int)
    cost = np.zeros(F.shape[0] + n)
    cost[: len(tensions)] = weights.tension_per_n2
    cost[len(tensions) : states] = weights.speed_per_m2_s2
    cost[len(tensions) + draw] = weights.draw_speed_per_m2_s2
    cost[F.shape[0] :] = weights.integral_per_n2s2
    cost[F.shape[0] + draw] = weights.draw_integral_per_m2

    controlled = np.zeros((n, F.shape[0]))
    for i in range(n):
        column = len(tensions) + i if i in task.draw_spans else int(np.searchsorted(tensions, i))
        controlled[i, column] = task.period_s
    size = F.shape[0] + n
    F_i = np.zeros((size, size))
    F_i[: F.shape[0], : F.shape[0]] = F
    F_i[F.shape[0] :, : F.shape[0]] = controlled
    F_i[F.shape[0] :, F.shape[0] :] = np.eye(n)
    G_i = np.vstack((G, np.zeros((n, n))))

    gain = _dlqr(F_i, G_i, np.diag(cost), weights.torque_per_nm2 * np.eye(n))
    gain_state = np.zeros((n, 2 * n))
    gain_state[:, kept] = gain[:, :states]
    return LqiConfig(
        period_s=task.period_s,
        draw_spans=list(task.draw_spans),
        feedforward=feedforward_of(task.model),
        gain_state=gain_state.tolist(),
        gain_input=gain[:, states : states + n * depth].tolist(),
        gain_integral=gain[:, states + n * depth :].tolist(),
        antiwindup=weights.antiwindup,
    )


def design_pid(task: DesignTask) -> PidConfig:
    """Cascade in matrix form, as a web-handling engineer would set it up: a speed loop per roller, tension trim on the
    draw of each span, passed on to every roller downstream so that spans behind it keep their draw.

    Bandwidths follow from the dead time (latency and half a period of hold): speed 0.5 / dead time, tension a third of
    it, integral time four times the tension loop's: chosen on the same kind of plants as `LqiWeights`.
    """
    model, n = task.model, task.model.n
    dead_time_s = task.latency_s + 0.5 * task.period_s
    speed_bandwidth = 0.5 / dead_time_s
    tension_bandwidth = speed_bandwidth / 3.0
    speed_gain = model.inertia_kg_m2 * speed_bandwidth / model.radius_m
    # Speed that removes 1 N of span j within the tension loop's time constant, at every roller from j on.
    trim = np.tril(np.ones((n, n))) * (model.length_m / model.stiffness_n) * tension_bandwidth
    tension_gain = speed_gain[:, None] * trim
    integral_gain = tension_gain * tension_bandwidth / 4.0
    for i in task.draw_spans:
        tension_gain[:, i] = 0.0
        integral_gain[:, i] = 0.0
        integral_gain[i, i] = speed_gain[i] * speed_bandwidth / 4.0
    return PidConfig(
        period_s=task.period_s,
        draw_spans=list(task.draw_spans),
        feedforward=feedforward_of(model),
        gain_proportional=np.hstack((tension_gain, np.diag(speed_gain))).tolist(),
        gain_integral=integral_gain.tolist(),
        # Roller speed is the derivative of tension up to a constant, and far less noisy: its gain does the work.
        gain_derivative=np.zeros((n, n)).tolist(),
        derivative_filter_s=5.0 * task.period_s,
        antiwindup=0.05,
    )


def feedforward_of(model: WebModel) -> Feedforward:
    """The feed-forward part of phi for a model."""
    return Feedforward(
        stiffness_n=model.stiffness_n,
        radius_m=model.radius_m.tolist(),
        friction_nms_per_rad=model.friction_nms_per_rad.tolist(),
        tension_before_n=model.tension_before_n,
        tension_after_n=model.tension_after_n,
    )


def sampled(A: FloatArray, B: FloatArray, time_s: float) -> tuple[FloatArray, FloatArray]:
    """exp(A t) and its integral times B: the zero-order hold over `time_s`."""
    states, inputs = B.shape
    block = np.zeros((states + inputs, states + inputs))
    block[:states, :states] = A
    block[:states, states:] = B
    exponential: FloatArray = np.asarray(expm(block * time_s), dtype=np.float64)
    return exponential[:states, :states], exponential[:states, states:]


def _augment(
    A: FloatArray, B: FloatArray, period_s: float, latency_s: float
) -> tuple[FloatArray, FloatArray, int, int]:
    """F, G of the sampled system with its dead time, the number of physical states, and of torques in flight.

    A torque computed from the sample at k h acts from k h + latency = (k + m) h + tau on, 0 <= tau < h: over a period
    the torque of m+1 periods ago acts for tau, then that of m periods ago.
    """
    states, inputs = B.shape
    whole = floor(latency_s / period_s + 1e-9)
    rest_s = max(latency_s - whole * period_s, 0.0)
    rest_s = 0.0 if rest_s < 1e-9 else rest_s
    depth = whole + (1 if rest_s else 0)
    Ad, _ = sampled(A, B, period_s)
    A_late, B_late = sampled(A, B, period_s - rest_s)
    F = np.zeros((states + inputs * depth, states + inputs * depth))
    G = np.zeros((states + inputs * depth, inputs))
    F[:states, :states] = Ad

    def acts(periods_ago: int, effect: FloatArray) -> None:
        if periods_ago == 0:
            G[:states] += effect
        else:
            F[:states, states + inputs * (periods_ago - 1) : states + inputs * periods_ago] += effect

    acts(whole, B_late)
    if rest_s:
        acts(whole + 1, A_late @ sampled(A, B, rest_s)[1])
    if depth:
        G[states : states + inputs] = np.eye(inputs)
    for age in range(1, depth):
        rows = slice(states + inputs * age, states + inputs * (age + 1))
        F[rows, states + inputs * (age - 1) : states + inputs * age] = np.eye(inputs)
    return F, G, states, depth


def _dlqr(F: FloatArray, G: FloatArray, Q: FloatArray, R: FloatArray) -> FloatArray:
    """K of u = -K x that minimises sum x'Qx + u'Ru; raises DesignRefused where there is none that stabilises."""
    try:
        P: FloatArray = np.asarray(solve_discrete_are(F, G, Q, R), dtype=np.float64)
    except (LinAlgError, ValueError) as error:
        text = f"the Riccati equation has no stabilising solution ({error}): check the model's parameters"
        raise DesignRefused(text) from error
    gain: FloatArray = np.asarray(np.linalg.solve(R + G.T @ P @ G, G.T @ P @ F), dtype=np.float64)
    radius = np.abs(np.linalg.eigvals(F - G @ gain)).max()
    if not radius < 1.0:
        raise DesignRefused(f"the closed loop would have a spectral radius of {radius:.4f}, it must stay below 1")
    return gain
