"""How many closed loops are simulated a second. Nothing else runs beside it."""

import os
import time

import numpy as np

from gateway.cli.rehearse_designs import truth_of
from gateway.cli.report import Section, Table
from gateway.cli.tiers import A
from gateway.control.rollout import Course, Plants, Setup, plants_of, simulate
from gateway.core.controller import Controller
from gateway.core.controller_laws import MpcConfig
from gateway.core.scenario import Scenario
from gateway.core.signals import FloatArray
from sim_plant.physics import STEP_S
from tests.bench.control_plants import TEST, random_plant
from tests.bench.control_runs import CASES, LAWS, plant_named, task_on
from tests.bench.control_tables import Given, Part, numeric, slug, told

ROLLOUT_S = 10.0
LOOPS = 2000  #: simulated at once, by the compiled kernel
SLOW_LOOPS = 4  #: of a law that has none


def rollouts(given: Given) -> Part:
    """A table by law."""
    figures: list[tuple[str, float, str, int]] = []
    table = _rollouts(given, figures)
    text = "Loops of a law on the belief model, as designs and the gate simulate them."
    return Part(Section("Rollouts", (text,), (table,)), figures)


def _rollouts(given: Given, figures: list[tuple[str, float, str, int]]) -> Table:
    heads = ("Law", "10 ms steps, 1/s", "1 ms steps, 1/s", "Loops")
    rows = []
    for law in given.laws:
        config = LAWS[law](task_on(A, CASES["tension"], truth_of(plant_named("s_sim"))))
        count = SLOW_LOOPS if isinstance(config, MpcConfig) else LOOPS
        speeds = [
            loops_per_s(config, CASES["tension"], count, substeps) for substeps in (1, round(A.period_s / STEP_S))
        ]
        rows.append((law, *(told(speed, 0 if speed > 100.0 else 1) for speed in speeds), str(count)))
        figures.append((slug("rollouts", law, "per_s"), speeds[0], "1/s", count))
        figures.append((slug("rollouts", law, "1ms_per_s"), speeds[1], "1/s", count))
    return Table(
        f"Simulated closed loops of {ROLLOUT_S:g} s a second on {os.cpu_count()} cores",
        heads,
        tuple(rows),
        numeric(heads, 1),
        note=given.made(
            "The ensemble's plants, tension case, 10 ms period and latency, noise on, the best of three. Linear laws "
            "run in the compiled kernel; MPC solves its programme in every period, one plant after another."
        ),
    )


def loops_per_s(config: Controller, case: Scenario, count: int, substeps: int, tries: int = 3) -> float:
    """Closed loops of `ROLLOUT_S` a second, with so many steps of integration a period."""
    plants = _plants(count, config.n)
    course = course_of(case, config.period_s, ROLLOUT_S)
    setup = Setup(
        config.period_s, config.latency_s, substeps, A.torque_nm, A.torque_rate_nm_per_s, 0.1, 1e-4, 5e-2 * STEP_S**0.5
    )
    simulate(config, _plants(1, config.n), course, setup)  # compiled
    took_s = []
    for _ in range(1 if isinstance(config, MpcConfig) else tries):
        began_s = time.perf_counter()
        simulate(config, plants, course, setup)
        took_s.append(time.perf_counter() - began_s)
    return count / min(took_s)


def course_of(case: Scenario, period_s: float, duration_s: float) -> Course:
    """A case as it is asked of the line, period by period."""
    time_s: FloatArray = period_s * np.arange(round(duration_s / period_s), dtype=np.float64)
    changed = int(np.searchsorted(time_s, case.change_at_s - 0.5 * period_s))
    return Course(case.setpoints_n(time_s), case.speeds_m_per_s(time_s), changed)


def _plants(count: int, n: int) -> Plants:
    """Plants of the ensemble, again and again."""
    models = [truth_of(random_plant(seed, n)) for seed in TEST[:count]]
    return plants_of([models[i % len(models)] for i in range(count)])
