"""How far a loop is from trouble: delay, decay, and what noise does to the torque. All on the sampled linear loop."""

from dataclasses import dataclass, replace
from itertools import pairwise
from math import inf, log

import numpy as np
from scipy.linalg import solve_discrete_lyapunov

from gateway.control.design.sampling import with_dead_time
from gateway.control.design.task import LEAST_DRAW_SPEED_M_PER_S, DesignRefused, DesignTask, linear
from gateway.control.linear_form import LinearForm, linear_form, without_constants
from gateway.control.sampled import Sampled
from gateway.core.controller import Controller
from gateway.core.controller_laws import MpcConfig
from gateway.core.controller_schedule import LinearConfig, ScheduledConfig, law_at
from gateway.core.signals import FloatArray

LEAST_DELAY_MARGIN_S = 0.004
DELAY_STEP_S = 0.0005
MOST_DELAY_S = 0.05  #: beyond which nobody looks


@dataclass(frozen=True)
class Margins:
    """Of a loop on the model that it was asked about."""

    spectral_radius: float  #: of one period
    decay_per_s: float  #: rate of the slowest mode; not above 0: unstable
    delay_margin_s: float  #: beyond the latency; `MOST_DELAY_S` stands for that and more
    chatter_nm: float  #: root mean square of the change of torque from period to period under noise, of the worst drive
    noise_floor_n: float  #: root of the mean squared 2-norm of the tension errors that noise leaves


def margins(config: Controller, task: DesignTask) -> Margins:
    """Margins of `config` on the model, noise and latency of `task`.

    Of a schedule the worst of each figure at its nodes and in the middle between them, each at its own speed, in place
    of the task's. (Speeds that change slowly against the loop: what a change itself does is no linear loop.)
    """
    if not isinstance(config, ScheduledConfig):
        return _margins(config, task)
    nodes = config.speed_m_per_s
    speeds = [*nodes, *(0.5 * (low + high) for low, high in pairwise(nodes))]
    each = [_margins(law_at(config, v), replace(task, unwind_speed_m_per_s=v)) for v in speeds]
    # Of numpy: Python's own extremes pass over what is no number, where it does not come first.
    return Margins(
        spectral_radius=float(np.max([found.spectral_radius for found in each])),
        decay_per_s=float(np.min([found.decay_per_s for found in each])),
        delay_margin_s=float(np.min([found.delay_margin_s for found in each])),
        chatter_nm=float(np.max([found.chatter_nm for found in each])),
        noise_floor_n=float(np.max([found.noise_floor_n for found in each])),
    )


def _margins(config: LinearConfig | MpcConfig, task: DesignTask) -> Margins:
    form, (A, B) = without_constants(linear_form(config)), linear(task)

    def radius(extra_s: float) -> float:
        plant = with_dead_time(A, B, task.period_s, task.latency_s + extra_s)
        return float(np.abs(np.linalg.eigvals(closed_loop(form, plant))).max())

    now = radius(0.0)
    if not now < 1.0:
        return Margins(now, -log(now) / task.period_s, 0.0, inf, inf)
    tolerated = 0.0
    for step in range(1, round(MOST_DELAY_S / DELAY_STEP_S) + 1):
        if not radius(step * DELAY_STEP_S) < 1.0:
            break
        tolerated = step * DELAY_STEP_S
    chatter, floor = _noise(form, with_dead_time(A, B, task.period_s, task.latency_s), task)
    return Margins(now, -log(now) / task.period_s, tolerated, chatter, floor)


def require_margin(found: Margins, least_s: float = LEAST_DELAY_MARGIN_S) -> None:
    """Raises DesignRefused for a loop that may not be offered."""
    if not found.spectral_radius < 1.0:
        raise DesignRefused(f"the loop is unstable: its spectral radius is {found.spectral_radius:.4f}")
    if not found.delay_margin_s >= least_s:
        raise DesignRefused(
            f"the loop stands only {1e3 * found.delay_margin_s:.1f} ms more delay, at least {1e3 * least_s:g} ms are "
            f"needed: more weight on torque, a slower disturbance estimate, or less latency"
        )


def weak_spots(config: Controller, task: DesignTask, least_s: float = LEAST_DELAY_MARGIN_S) -> list[str]:
    """Speeds from standstill to the greatest of the task's limits at which the loop stands too little; empty: none."""
    fastest = task.limits.speed_max_m_per_s
    slowest = LEAST_DRAW_SPEED_M_PER_S if task.draw_spans else 0.0
    speeds = [slowest, 0.5 * fastest, fastest] if fastest > slowest else []
    found: list[str] = []
    for speed in speeds:
        at_speed = replace(task, unwind_speed_m_per_s=speed)
        if not is_stable(config, at_speed):
            found.append(f"at {speed:g} m/s the loop is unstable")
        elif not is_stable(config, at_speed, least_s):
            found.append(f"at {speed:g} m/s it stands less than {1e3 * least_s:g} ms more delay")
    return found


def is_stable(config: Controller, task: DesignTask, extra_s: float = 0.0) -> bool:
    """Whether the loop is stable on the model and at the speed of `task`, with so much more delay."""
    law = law_at(config, task.unwind_speed_m_per_s) if isinstance(config, ScheduledConfig) else config
    plant = with_dead_time(*linear(task), task.period_s, task.latency_s + extra_s)
    loop = closed_loop(without_constants(linear_form(law)), plant)
    return bool(np.abs(np.linalg.eigvals(loop)).max() < 1.0)


def closed_loop(form: LinearForm, plant: Sampled) -> FloatArray:
    """The matrix of one period of [x; z; u_{k-1}; ..; u_{k-d}], d that of `plant`."""
    F, G = plant.augmented()
    size, states, n = F.shape[0], form.states, form.n
    e = np.zeros((2 * n, size))
    e[:, : 2 * n] = np.eye(2 * n)
    of_z, of_x = form.part(form.torque, "z"), form.part(form.torque, "e") @ e
    whole = np.zeros((size + states,) * 2)
    whole[:size, :size] = F + G @ of_x
    whole[:size, size:] = G @ of_z
    whole[size:, :size] = form.part(form.state, "e") @ e + form.applied @ of_x
    whole[size:, size:] = form.part(form.state, "z") + form.applied @ of_z
    return whole


def _noise(form: LinearForm, plant: Sampled, task: DesignTask) -> tuple[float, float]:
    """Chatter in Nm and the tension errors' root mean squared 2-norm in N under `task.noise`, stationary."""
    n, loop = form.n, closed_loop(form, plant)
    size = loop.shape[0] - form.states
    seen = np.diag(np.repeat([task.noise.tension_n, task.noise.speed_m_per_s], n))
    seen[list(task.draw_spans)] = 0.0
    moved = np.zeros((size, n))
    moved[n : 2 * n] = np.eye(n) * task.noise.acceleration_m_per_s1_5 * task.period_s**0.5
    of_e = form.part(form.torque, "e")
    _, G = plant.augmented()
    entry = np.vstack((G @ of_e, form.part(form.state, "e") + form.applied @ of_e)) @ seen
    entry = np.hstack((entry, np.vstack((moved, np.zeros((form.states, n))))))
    spread: FloatArray = np.asarray(solve_discrete_lyapunov(loop, entry @ entry.T), dtype=np.float64)
    # u_k - u_{k-1} = (O M - O) X_{k-1} + (O E + D [noise now] - D [noise before]): O what X does to the torque
    out = np.hstack((of_e, np.zeros((n, size - 2 * n)), form.part(form.torque, "z")))
    direct = np.hstack((of_e @ seen, np.zeros((n, n))))
    step = out @ (loop - np.eye(len(loop)))
    change = step @ spread @ step.T + (out @ entry - direct) @ (out @ entry - direct).T + direct @ direct.T
    tension = float(np.trace(spread[:n, :n]))
    return float(np.sqrt(change.diagonal().max())), float(np.sqrt(tension))
