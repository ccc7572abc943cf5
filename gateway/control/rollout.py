"""Closed loops on the belief model, many at once: saturation, rate limit, latency, noise, quantisation.

The plants are the nonlinear equations of `web_model`, integrated by RK4; the law is the one that runs on the line. What
is random is drawn before and shared by all plants, so that two laws meet the same noise. Linear laws go through a
compiled kernel in their `LinearForm`; `simulate_slowly` runs any law as it is, and is what the kernel is held against.
"""

from dataclasses import dataclass, field
from math import inf
from typing import Any

import numpy as np

from gateway.control.deviation import Deviation, Measured
from gateway.control.law import Law
from gateway.control.laws import make_law, untimed
from gateway.control.reference import Steady
from gateway.core.controller import Controller
from gateway.core.controller_laws import MpcConfig
from gateway.core.metrics import BAND
from gateway.core.signals import FloatArray
from gateway.core.web_model import WebModel


@dataclass(frozen=True)
class Plants:
    """Plants of equal size: (b, n) each, and the constant tensions (b, 2) ahead of and behind the line."""

    stiffness_n: FloatArray
    length_m: FloatArray
    radius_m: FloatArray
    inertia_kg_m2: FloatArray
    friction_nms_per_rad: FloatArray
    boundary_n: FloatArray

    @property
    def count(self) -> int:
        return self.length_m.shape[0]

    @property
    def n(self) -> int:
        return self.length_m.shape[1]

    def model(self, index: int) -> WebModel:
        before, after = self.boundary_n[index].tolist()
        return WebModel(
            float(self.stiffness_n[index, 0]), self.length_m[index], self.radius_m[index], self.inertia_kg_m2[index],
            self.friction_nms_per_rad[index], before, after,
        )  # fmt: skip


def plants_of(models: list[WebModel]) -> Plants:
    """Plants of a list of models."""
    n = models[0].n
    return Plants(
        np.array([np.full(n, model.stiffness_n) for model in models]),
        np.array([model.length_m for model in models]),
        np.array([model.radius_m for model in models]),
        np.array([model.inertia_kg_m2 for model in models]),
        np.array([model.friction_nms_per_rad for model in models]),
        np.array([[model.tension_before_n, model.tension_after_n] for model in models]),
    )


@dataclass(frozen=True)
class Course:
    """What is asked of the line, period by period: known to law and plant at the sample at which it happens."""

    tension_n: FloatArray  #: set-points (k, n)
    unwind_speed_m_per_s: FloatArray  #: (k,)
    changed: int = 0  #: the period of the change, from which settling time and overshoot count

    @property
    def periods(self) -> int:
        return len(self.unwind_speed_m_per_s)


@dataclass(frozen=True)
class Setup:
    """How the loop is closed. Times in s; per drive Nm and Nm/s; noise as standard deviations of a sample."""

    period_s: float
    latency_s: float
    substeps: int = 1  #: RK4 steps a period; the latency is a whole number of them
    torque_nm: float = inf
    torque_rate_nm_per_s: float = inf
    tension_noise_n: float = 0.0
    speed_noise_m_per_s: float = 0.0
    acceleration_m_per_s1_5: float = 0.0  #: intensity of the noise on the rollers
    tension_step_n: float = 0.0  #: of the measurement's quantisation; 0: none
    speed_step_m_per_s: float = 0.0
    seed: int = 0

    @property
    def step_s(self) -> float:
        return self.period_s / self.substeps

    @property
    def delay_steps(self) -> int:
        """Integration steps from a sample to the torque that it causes."""
        return round(self.latency_s / self.step_s)

    def draw(self, periods: int, n: int) -> tuple[FloatArray, FloatArray]:
        """Noise on the samples (k, 2n), and speeds (k substeps, n) that the rollers are moved by in each step."""
        generator = np.random.default_rng(self.seed)
        scale = np.repeat([self.tension_noise_n, self.speed_noise_m_per_s], n)
        samples = generator.standard_normal((periods, 2 * n)) * scale
        moved = generator.standard_normal((periods * self.substeps, n))
        return samples, moved * self.acceleration_m_per_s1_5 * self.step_s**0.5


@dataclass(frozen=True)
class Rollouts:
    """What became of each plant. Errors and tensions are true, at the samples; (b, n) unless said otherwise."""

    squared_error_n2: FloatArray  #: mean over all periods of (T - T_ref)^2
    tension_min_n: FloatArray
    tension_max_n: FloatArray
    settled: FloatArray  #: periods from the change to the last sample outside the band; inf where it never came in
    beyond_n: FloatArray  #: greatest overshoot, in the direction of the set-point's step (either, where there is none)
    torque_max_nm: FloatArray
    torque_step_max_nm: FloatArray  #: from period to period
    effort_n2m2s: FloatArray  #: integral of u^2, per drive
    tension_n: FloatArray = field(default_factory=lambda: np.empty(0))  #: (b, k, n), only where it was recorded
    torque_nm: FloatArray = field(default_factory=lambda: np.empty(0))  #: (b, k, n), as applied

    @property
    def rmse_n(self) -> FloatArray:
        """Eq. rmse of each plant, (b,)."""
        return np.sqrt(self.squared_error_n2.sum(axis=1))


def simulate(config: Controller, plants: Plants, course: Course, setup: Setup, *, record: bool = False) -> Rollouts:
    """The loop of `config` on each plant, from the plant's own equilibrium with the law engaged there.

    Raises ValueError for a period that is not the law's, or a course or plants of another size.
    """
    _check(config, plants, course, setup)
    if isinstance(config, MpcConfig):
        return simulate_slowly(config, plants, course, setup, record=record)
    from gateway.control.rollout_kernel import run  # compiled code, for those who use it

    return run(config, plants, course, setup, record=record)


def simulate_slowly(
    config: Controller, plants: Plants, course: Course, setup: Setup, *, record: bool = False
) -> Rollouts:
    """As `simulate`, with the law itself, plant by plant."""
    _check(config, plants, course, setup)
    samples, moved = setup.draw(course.periods, plants.n)
    tensions, torques = np.empty((2, plants.count, course.periods, plants.n))
    for b in range(plants.count):
        law = make_law(untimed(config))
        tensions[b], torques[b] = run_law(law, plants.model(b), course, setup, samples, moved)
    return rollouts_of(tensions, torques, course, setup, record=record)


def start(plants: Plants, course: Course) -> tuple[FloatArray, FloatArray]:
    """State (b, 2n) and torques (b, n) of each plant's own equilibrium at the beginning of the course."""
    tension = np.tile(course.tension_n[0], (plants.count, 1))
    before, after = plants.boundary_n[:, :1], plants.boundary_n[:, 1:]
    # Eq. reference_velocity and dv/dt = 0, for all plants at once.
    ratios: FloatArray = (plants.stiffness_n - np.hstack((before, tension[:, :-1]))) / (plants.stiffness_n - tension)
    speeds: FloatArray = course.unwind_speed_m_per_s[0] * np.cumprod(ratios, axis=1)
    pulled: FloatArray = plants.radius_m * (np.hstack((tension[:, 1:], after)) - tension)
    return np.hstack((tension, speeds)), plants.friction_nms_per_rad * speeds / plants.radius_m - pulled


def references(config: Controller, course: Course) -> FloatArray:
    """[T_ref; v_ref; u_ref] (k, 3n) as the law has them."""
    deviation = Deviation(config.feedforward, config.draw_spans, config.period_s, config.latency_s)
    asked = np.column_stack((course.tension_n, course.unwind_speed_m_per_s))
    # What stands for a while is computed once.
    begins = np.flatnonzero(np.concatenate(([True], (asked[1:] != asked[:-1]).any(axis=1))))
    rows: list[FloatArray] = []
    for tension, unwind in zip(course.tension_n[begins], course.unwind_speed_m_per_s[begins].tolist(), strict=True):
        reference = Steady(tension)
        state = deviation.state(reference, unwind)
        rows.append(np.concatenate((state, deviation.torque(reference, unwind, 0))))
    return np.repeat(np.array(rows), np.diff(np.append(begins, course.periods)), axis=0)


def rollouts_of(tensions: FloatArray, torques: FloatArray, course: Course, setup: Setup, *, record: bool) -> Rollouts:
    """The same from recordings (b, k, n)."""
    error = tensions - course.tension_n
    after, band = error[:, course.changed :], BAND * course.tension_n[-1]
    direction = step_direction(course)
    beyond = np.where(direction == 0.0, np.abs(after), direction * after).max(axis=1)
    outside = np.abs(after) > band
    last = after.shape[1] - np.argmax(outside[:, ::-1], axis=1)
    settled = np.where(outside.any(axis=1), last, 0).astype(np.float64)
    settled[outside[:, -1]] = inf
    steps = np.abs(np.diff(torques, axis=1)).max(axis=1, initial=0.0)
    return Rollouts(
        np.mean(error**2, axis=1), tensions.min(axis=1), tensions.max(axis=1), settled, np.maximum(beyond, 0.0),
        np.abs(torques).max(axis=1), steps, setup.period_s * np.sum(torques**2, axis=1),
        tensions if record else np.empty(0), torques if record else np.empty(0),
    )  # fmt: skip


def step_direction(course: Course) -> FloatArray:
    """-1, 0 or 1 for each span (n,): where its set-point has gone from the first period to the last."""
    return np.sign(course.tension_n[-1] - course.tension_n[0])


def limited(setup: Setup, asked_nm: FloatArray, before_nm: FloatArray) -> FloatArray:
    """The torque (n,) that the envelope lets through."""
    reach = setup.torque_rate_nm_per_s * setup.period_s
    held = np.minimum(np.maximum(asked_nm, -setup.torque_nm), setup.torque_nm)
    return np.minimum(np.maximum(held, before_nm - reach), before_nm + reach)


def run_law(
    law: Law[Any], model: WebModel, course: Course, setup: Setup, samples: FloatArray, moved: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Tensions and torques (k, n) of one plant, with noise as `Setup.draw` gives it."""
    n = model.n
    alone = plants_of([model])
    (state,), (applied,) = start(alone, course)
    acting = [applied] * (setup.delay_steps // setup.substeps + 2)
    steps = np.array([setup.tension_step_n] * n + [setup.speed_step_m_per_s] * n)
    tensions, torques, memory = np.empty((course.periods, n)), np.empty((course.periods, n)), None
    for k, unwind in enumerate(course.unwind_speed_m_per_s.tolist()):
        tensions[k] = state[:n]
        seen = quantised(state + samples[k], steps)
        measured, reference = Measured(seen[:n], seen[n:], unwind), Steady(course.tension_n[k])
        if memory is None:
            memory = law.engage(measured, reference, applied)
        decision = law.ask(memory, measured, reference)
        applied = limited(setup, decision.torque_nm, applied)
        memory = law.commit(memory, decision, applied)
        torques[k] = applied
        acting.append(applied)
        for j in range(setup.substeps):
            age = -(-(setup.delay_steps - j) // setup.substeps)  # periods ago that the acting torque was computed
            torque = acting[-1 - max(age, 0)]
            state = rk4(model, state, torque, unwind, setup.step_s)
            state[n:] += moved[k * setup.substeps + j]
    return tensions, torques


def quantised(values: FloatArray, steps: FloatArray) -> FloatArray:
    """`values` on a grid of `steps`; where that is 0, as they are."""
    fine = steps == 0.0
    return np.where(fine, values, np.round(values / np.where(fine, 1.0, steps)) * steps)


def rk4(
    model: WebModel, state: FloatArray, torque_nm: FloatArray, unwind_speed_m_per_s: float, step_s: float
) -> FloatArray:
    """[T; v] (2n,) a step later, with torque (n,) and unwinder held."""
    k1 = rate(model, state, torque_nm, unwind_speed_m_per_s)
    k2 = rate(model, state + 0.5 * step_s * k1, torque_nm, unwind_speed_m_per_s)
    k3 = rate(model, state + 0.5 * step_s * k2, torque_nm, unwind_speed_m_per_s)
    k4 = rate(model, state + step_s * k3, torque_nm, unwind_speed_m_per_s)
    return state + step_s / 6.0 * (k1 + 2.0 * k2 + 2.0 * k3 + k4)


def rate(model: WebModel, state: FloatArray, torque_nm: FloatArray, unwind_speed_m_per_s: float) -> FloatArray:
    """d[T; v]/dt (2n,): eqs. web_tension_dynamics and roller_velocity_dynamics."""
    n = model.n
    tension = np.concatenate(([model.tension_before_n], state[:n], [model.tension_after_n]))
    speed = np.concatenate(([unwind_speed_m_per_s], state[n:]))
    stretch = model.stiffness_n * np.diff(speed)
    carried = tension[:n] * speed[:n] - tension[1 : n + 1] * speed[1:]
    pulled = model.radius_m**2 * (tension[2:] - tension[1 : n + 1])
    turned = pulled - model.friction_nms_per_rad * speed[1:] + model.radius_m * torque_nm
    return np.concatenate(((stretch + carried) / model.length_m, turned / model.inertia_kg_m2))


def _check(config: Controller, plants: Plants, course: Course, setup: Setup) -> None:
    wrong: list[str] = []
    if abs(config.period_s - setup.period_s) > 1e-12:
        wrong.append(f"the law's period is {config.period_s:g} s, the loop's {setup.period_s:g} s")
    if config.n != plants.n or course.tension_n.shape != (course.periods, plants.n):
        wrong.append(f"law, plants and course have {config.n}, {plants.n} and {course.tension_n.shape[1]} spans")
    if course.periods == 0 or not 0 <= course.changed < course.periods:
        wrong.append(f"the course has {course.periods} periods and its change at {course.changed}")
    if abs(setup.delay_steps * setup.step_s - setup.latency_s) > 1e-9:
        wrong.append(f"a latency of {setup.latency_s:g} s is no whole number of steps of {setup.step_s:g} s")
    if wrong:
        raise ValueError("; ".join(wrong))
