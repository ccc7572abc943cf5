"""Closed loops on the belief model, many at once: saturation, rate limit, latency, noise, quantisation; and, where
plants have `Effects`, torque lag, Coulomb friction, eccentricity and commands that come late.

The plants are the nonlinear equations of `web_model`, integrated by RK4; the law is the one that runs on the line. What
is random is drawn before and shared by all plants, so that two laws meet the same noise. Linear laws go through a
compiled kernel in their `LinearForm`; `simulate_slowly` runs any law as it is, and is what the kernel is held against.
"""

from itertools import pairwise
from math import inf

import numpy as np

from gateway.control.laws import make_law, untimed
from gateway.control.rollout_line import rate, rk4
from gateway.control.rollout_slow import LineOf, limited, plain_line, rollouts_of, run_law, run_plant
from gateway.control.rollout_start import references, start
from gateway.control.rollout_terms import (
    RUNAWAY_N,
    Course,
    Effects,
    Plants,
    Rollouts,
    Setup,
    course_through,
    no_effects,
    plants_of,
    plants_of_thetas,
    with_effects,
)
from gateway.core.controller import Controller
from gateway.core.controller_laws import MpcConfig

__all__ = [
    "RUNAWAY_N",
    "Course",
    "Effects",
    "Plants",
    "Rollouts",
    "Setup",
    "course_through",
    "limited",
    "no_effects",
    "plants_of",
    "plants_of_thetas",
    "rate",
    "references",
    "rk4",
    "run_law",
    "simulate",
    "simulate_slowly",
    "start",
    "with_effects",
]


def simulate(config: Controller, plants: Plants, course: Course, setup: Setup, *, record: bool = False) -> Rollouts:
    """The loop of `config` on each plant, from the plant's own equilibrium with the law engaged there.

    MPC runs plant by plant: a second of a line takes some tenths of one. (`mpc_linear` has what runs fast of it.)
    Raises ValueError for a period that is not the law's, or a course or plants of another size.
    """
    _check(config, plants, course, setup)
    from gateway.control.rollout_batch import run  # compiled code, for those who use it
    from gateway.control.rollout_compiled_line import CompiledLine

    if isinstance(config, MpcConfig):
        return _plant_by_plant(config, plants, course, setup, CompiledLine, record=record)
    return run(config, plants, course, setup, record=record)


def simulate_slowly(
    config: Controller, plants: Plants, course: Course, setup: Setup, *, record: bool = False
) -> Rollouts:
    """As `simulate`, with the law itself and nothing compiled, plant by plant: what `simulate` is held against."""
    _check(config, plants, course, setup)
    return _plant_by_plant(config, plants, course, setup, plain_line, record=record)


def _plant_by_plant(
    config: Controller, plants: Plants, course: Course, setup: Setup, line_of: LineOf, *, record: bool
) -> Rollouts:
    """A plant that has run away is left at once. One law engages on each: it keeps nothing of the plant before."""
    law = make_law(untimed(config))
    drawn = (*setup.draw(course.periods, plants.n), setup.late(course.periods, plants.n))
    stepped = np.empty((plants.count, course.periods * setup.substeps, 2 * plants.n))
    torques = np.empty((plants.count, course.periods, plants.n))
    for b in range(plants.count):
        stepped[b], torques[b] = run_plant(law, plants, b, course, setup, drawn, line_of)
    return rollouts_of(stepped, torques, course, setup, record=record)


def _check(config: Controller, plants: Plants, course: Course, setup: Setup) -> None:
    wrong: list[str] = []
    if not abs(config.period_s - setup.period_s) <= 1e-12:
        wrong.append(f"the law's period is {config.period_s:g} s, the loop's {setup.period_s:g} s")
    if config.n != plants.n or course.tension_n.shape != (course.periods, plants.n):
        wrong.append(f"law, plants and course have {config.n}, {plants.n} and {course.tension_n.shape[1]} spans")
    changes = course.changes.tolist()
    if course.periods == 0 or changes[0] < 0 or not all(a < b for a, b in pairwise(changes)):
        wrong.append(f"the course has {course.periods} periods and changes at {changes[:-1]}; allowed: ascending")
    if not 0 <= course.tail <= course.periods:
        wrong.append(f"the course has {course.periods} periods and a tail of {course.tail}")
    if not 0.0 <= setup.late_share <= 1.0:
        wrong.append(f"a share of {setup.late_share:g} of the commands is late; allowed: 0 to 1")
    if not abs(setup.delay_steps * setup.step_s - setup.latency_s) <= 1e-9:
        wrong.append(f"a latency of {setup.latency_s:g} s is no whole number of steps of {setup.step_s:g} s")
    if plants.effects is not None:
        wrong += _wrong_effects(plants.effects, (plants.count, plants.n))
    if wrong:
        raise ValueError("; ".join(wrong))


def _wrong_effects(effects: Effects, shape: tuple[int, int]) -> list[str]:
    each = {"coulomb_nm": effects.coulomb_nm, "eccentricity": effects.eccentricity, "phase_rad": effects.phase_rad}
    plant = {"torque_lag_s": effects.torque_lag_s}
    if effects.latency_s is not None:
        plant["latency_s"] = effects.latency_s
    wrong = [f"{name} is {v.shape}, it must be {shape}" for name, v in each.items() if v.shape != shape]
    wrong += [f"{name} is {v.shape}, it must be {shape[:1]}" for name, v in plant.items() if v.shape != shape[:1]]
    for name, values in (each | plant).items():
        least = -inf if name == "phase_rad" else 0.0
        most = 1.0 if name == "eccentricity" else inf
        if not ((values >= least) & (values < most)).all():
            wrong.append(f"{name} goes from {values.min():g} to {values.max():g}; allowed: {least:g} to below {most:g}")
    return wrong
