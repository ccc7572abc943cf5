"""Control laws from their configurations, written from the equations in the configurations' descriptions.

With e = [T - T_ref; v - v_ref], q what is integrated, u_s torques sent and not acting yet, newest first:

    pid    u = u_ref + I - K_p e - K_d rate,            I' = I - h K_i q - a (u - u_applied)
    lqr    u = u_ref - K e - K_u (u_s - u_ref) + bump
    lqi    u = u_ref - K e - K_u (u_s - u_ref) + I,     I' = I - h K_i q - a (u - u_applied)
    lqg    x~ = p + L (y - p) - x_ref,  d' = d + L_d (y - p),  u = u_ref - d - K x~ - K_u (u_s - u_ref + d) + bump,
           p' = x_ref + F x~ + G_0 (u_applied - u_ref + d) + sum_j G_j (u_s,j - u_ref + d)

A span without a load cell has no tension error, and its speed error is integrated. What a law takes over when it is put
in charge fades with 0.1 s. Between the nodes of a schedule every matrix goes linearly with the unwinder's speed.
"""

from math import exp
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from gateway.core.controller import Controller
from gateway.core.controller_laws import LqgConfig, LqiConfig, LqrConfig, PidConfig
from gateway.core.controller_schedule import LinearConfig, ScheduledConfig
from tests.independent.truth import FloatArray
from tests.independent.truth_kernel import compiled

PID, LQR, LQI, LQG = range(4)
FADE_S = 0.1


class Law(NamedTuple):
    """Of a configuration, for the kernel. Matrices have a first axis for the nodes of a schedule; else of length 1."""

    kind: int
    period_s: float
    latency_s: float
    depth: int  #: torques in flight
    antiwindup: float
    filter_s: float
    fade: float
    nodes_m_per_s: FloatArray
    gain: FloatArray  #: (m, n, 2n)
    gain_flight: FloatArray  #: (m, n, n d)
    gain_integral: FloatArray  #: (m, n, n)
    gain_rate: FloatArray  #: (m, n, n)
    transition: FloatArray  #: (m, 2n, 2n)
    inputs: FloatArray  #: (m, 2n, n (d + 1)), side by side
    correct: FloatArray  #: (m, 3n, 2n): of the state, and of the disturbance
    draw: NDArray[np.bool_]  #: (n,)
    stiffness_n: float
    radius_m: FloatArray
    friction_nms_per_rad: FloatArray
    boundary_n: FloatArray  #: (2,)


class Memory(NamedTuple):
    """Of a law; arrays are changed in place."""

    integral_nm: FloatArray
    error_before_n: FloatArray
    rate_n_per_s: FloatArray
    predicted: FloatArray  #: (2n,)
    disturbance_nm: FloatArray  #: 0 of a law that estimates none
    sent_nm: FloatArray  #: (d, n)
    bump_nm: FloatArray


class Now(NamedTuple):
    """What a law has worked out of a sample; filled in place."""

    error: FloatArray  #: (2n,)
    controlled: FloatArray  #: (n,)
    state: FloatArray  #: (2n,) x~
    speed_ref: FloatArray
    torque_ref: FloatArray
    torque: FloatArray


def law_of(config: Controller) -> Law:
    """The law of a linear configuration or a schedule of them. Raises ValueError for another."""
    laws: list[LinearConfig] = []
    nodes = np.zeros(1)
    match config:
        case ScheduledConfig():
            laws, nodes = list(config.laws), np.array(config.speed_m_per_s)
        case PidConfig() | LqrConfig() | LqiConfig() | LqgConfig():
            laws = [config]
        case _:
            raise ValueError(f"a law of kind {config.kind} is not linear")
    first, n = laws[0], config.n
    depth = 0
    if not isinstance(first, PidConfig):
        depth = np.array(first.gain_input).reshape(n, -1).shape[1] // n
    parts = [_parts(law, n, depth) for law in laws]
    given = config.feedforward
    return Law(
        {"pid": PID, "lqr": LQR, "lqi": LQI, "lqg": LQG}[first.kind], config.period_s, config.latency_s, depth,
        float(getattr(first, "antiwindup", 0.0)), float(getattr(first, "derivative_filter_s", 1.0)),
        exp(-config.period_s / FADE_S), nodes, *(np.ascontiguousarray([part[i] for part in parts]) for i in range(7)),
        np.array([i in config.draw_spans for i in range(n)]), given.stiffness_n, np.array(given.radius_m),
        np.array(given.friction_nms_per_rad), np.array([given.tension_before_n, given.tension_after_n]),
    )  # fmt: skip


def _parts(law: LinearConfig, n: int, depth: int) -> list[FloatArray]:
    """gain, gain_flight, gain_integral, gain_rate, transition, inputs, correct; 0 where the law has none."""
    none: dict[str, tuple[int, int]] = {
        "gain": (n, 2 * n), "flight": (n, n * depth), "integral": (n, n), "rate": (n, n), "transition": (2 * n, 2 * n),
        "inputs": (2 * n, n * (depth + 1)), "correct": (3 * n, 2 * n),
    }  # fmt: skip
    given: dict[str, Any] = {}
    match law:
        case PidConfig():
            given = {"gain": law.gain_proportional, "integral": law.gain_integral, "rate": law.gain_derivative}
        case LqrConfig():
            given = {"gain": law.gain_state, "flight": law.gain_input}
        case LqiConfig():
            given = {"gain": law.gain_state, "flight": law.gain_input, "integral": law.gain_integral}
        case LqgConfig():
            model = law.predictor
            given = {
                "gain": law.gain_state, "flight": law.gain_input, "transition": model.transition,
                "inputs": np.hstack(model.inputs), "correct": np.vstack((model.gain_state, model.gain_disturbance)),
            }  # fmt: skip
    return [np.array(given.get(name, np.zeros(shape)), dtype=np.float64).reshape(shape) for name, shape in none.items()]


@compiled
def _node(law, unwind_m_per_s):
    """The node below a speed, and how far on the way to the next."""
    nodes = law.nodes_m_per_s
    if nodes.size == 1 or unwind_m_per_s <= nodes[0]:
        return 0, 0.0
    for k in range(1, nodes.size):
        if unwind_m_per_s < nodes[k]:
            return k - 1, (unwind_m_per_s - nodes[k - 1]) / (nodes[k] - nodes[k - 1])
    return nodes.size - 1, 0.0


@compiled
def _apply(matrices, low, share, i, vector):
    """Row i of the matrix between node `low` and the next, times a vector."""
    total = 0.0
    for j in range(vector.size):
        entry = matrices[low, i, j]
        if share > 0.0:
            entry += share * (matrices[low + 1, i, j] - entry)
        total += entry * vector[j]
    return total


@compiled
def _flight(matrices, low, share, i, offset, sent, torque_ref, disturbance):
    """Row i of a matrix, from column `offset` on, times the torques in flight as deviations."""
    total = 0.0
    for age in range(sent.shape[0]):
        for j in range(torque_ref.size):
            column = offset + age * torque_ref.size + j
            entry = matrices[low, i, column]
            if share > 0.0:
                entry += share * (matrices[low + 1, i, column] - entry)
            total += entry * (sent[age, j] - torque_ref[j] + disturbance[j])
    return total


@compiled
def _refer(law, setpoint, unwind, seen, now):
    """Reference speeds and torques for set-points that stand, and the errors."""
    n = setpoint.size
    speed, up = unwind, law.boundary_n[0]
    for i in range(n):
        speed *= (law.stiffness_n - up) / (law.stiffness_n - setpoint[i])
        up = setpoint[i]
        down = setpoint[i + 1] if i + 1 < n else law.boundary_n[1]
        now.speed_ref[i] = speed
        now.torque_ref[i] = law.friction_nms_per_rad[i] * speed / law.radius_m[i] - law.radius_m[i] * (
            down - setpoint[i]
        )
        now.error[i] = 0.0 if law.draw[i] else seen[i] - setpoint[i]
        now.error[n + i] = seen[n + i] - speed
        now.controlled[i] = now.error[n + i] if law.draw[i] else now.error[i]


@compiled
def _ask_observer(law, memory, setpoint, low, share, seen, now):
    """`ask` of an LQG."""
    n = setpoint.size
    correction = np.zeros(2 * n)
    for j in range(2 * n):
        correction[j] = seen[j] - memory.predicted[j]
        if j < n and law.draw[j]:
            correction[j] = 0.0
    for i in range(2 * n):
        reference = setpoint[i] if i < n else now.speed_ref[i - n]
        now.state[i] = memory.predicted[i] + _apply(law.correct, low, share, i, correction) - reference
    for i in range(n):
        memory.disturbance_nm[i] += _apply(law.correct, low, share, 2 * n + i, correction)
    for i in range(n):
        now.torque[i] = now.torque_ref[i] - memory.disturbance_nm[i] + memory.bump_nm[i]
        now.torque[i] -= _apply(law.gain, low, share, i, now.state)
        now.torque[i] -= _flight(
            law.gain_flight, low, share, i, 0, memory.sent_nm, now.torque_ref, memory.disturbance_nm
        )


@compiled
def ask(law, memory, setpoint, unwind, seen, now):
    """Fill `now` for a sample `seen` (2n,); a disturbance that the law estimates is corrected. Torque before limits."""
    n = setpoint.size
    _refer(law, setpoint, unwind, seen, now)
    low, share = _node(law, unwind)
    if law.kind == LQG:
        _ask_observer(law, memory, setpoint, low, share, seen, now)
        return
    if law.kind == PID:
        for i in range(n):
            passed = law.filter_s / (law.filter_s + law.period_s)
            moved = (now.error[i] - memory.error_before_n[i]) / (law.filter_s + law.period_s)
            memory.rate_n_per_s[i] = passed * memory.rate_n_per_s[i] + moved
    for i in range(n):
        now.torque[i] = now.torque_ref[i] - _apply(law.gain, low, share, i, now.error)
        if law.kind == PID:
            now.torque[i] += memory.integral_nm[i] - _apply(law.gain_rate, low, share, i, memory.rate_n_per_s)
        else:
            now.torque[i] -= _flight(
                law.gain_flight, low, share, i, 0, memory.sent_nm, now.torque_ref, memory.disturbance_nm
            )
            now.torque[i] += memory.integral_nm[i] if law.kind == LQI else memory.bump_nm[i]


@compiled
def commit(law, memory, setpoint, unwind, now, applied):
    """The period is over: `applied` (n,) is what limits have left of the torque."""
    n = setpoint.size
    low, share = _node(law, unwind)
    if law.kind == LQG:
        away = np.empty(n)
        for i in range(n):
            away[i] = applied[i] - now.torque_ref[i] + memory.disturbance_nm[i]
        for i in range(2 * n):
            reference = setpoint[i] if i < n else now.speed_ref[i - n]
            memory.predicted[i] = reference + _apply(law.transition, low, share, i, now.state)
            memory.predicted[i] += _apply(law.inputs, low, share, i, away)
            memory.predicted[i] += _flight(
                law.inputs, low, share, i, n, memory.sent_nm, now.torque_ref, memory.disturbance_nm
            )
    elif law.kind == PID or law.kind == LQI:
        for i in range(n):
            step = law.period_s * _apply(law.gain_integral, low, share, i, now.controlled)
            memory.integral_nm[i] -= step + law.antiwindup * (now.torque[i] - applied[i])
    for i in range(n):
        memory.error_before_n[i] = now.error[i]
        memory.bump_nm[i] *= law.fade
        for age in range(law.depth - 1, 0, -1):
            memory.sent_nm[age, i] = memory.sent_nm[age - 1, i]
        if law.depth > 0:
            memory.sent_nm[0, i] = applied[i]


@compiled
def now_of(n):
    return Now(np.zeros(2 * n), np.zeros(n), np.zeros(2 * n), np.zeros(n), np.zeros(n), np.zeros(n))


@compiled
def engage(law, setpoint, unwind, speed, applied):
    """As after a long time in charge of a line that stands at its set-points (n,), at these speeds and torques (n,)."""
    n = setpoint.size
    seen = np.concatenate((setpoint, speed))
    sent = np.zeros((law.depth, n))
    for age in range(law.depth):
        sent[age] = applied
    memory = Memory(np.zeros(n), np.zeros(n), np.zeros(n), seen.copy(), np.zeros(n), sent, np.zeros(n))
    now = now_of(n)
    _refer(law, setpoint, unwind, seen, now)
    if law.kind == LQG:
        memory.disturbance_nm[:] = now.torque_ref - applied
    ask(law, memory, setpoint, unwind, seen, now)
    missing = applied - now.torque
    if law.kind == PID or law.kind == LQI:
        memory.integral_nm[:] = missing
    else:
        memory.bump_nm[:] = missing
    memory.rate_n_per_s[:] = 0.0
    memory.error_before_n[:] = now.error[:n]
    return memory
