"""How many closed loops are simulated a second. Nothing else runs beside it."""

import os
import time
from collections.abc import Callable

import numpy as np

from gateway.cli.rehearse_designs import truth_of
from gateway.cli.report import Section, Table
from gateway.cli.tiers import A
from gateway.control.rollout import Course, Effects, Plants, Setup, course_through, plants_of, simulate, with_effects
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
REAL = "with effects"  #: in the name of a row: lag, dry friction, eccentricity and late commands
VERDICT_PLANTS, VERDICT_COURSES, VERDICT_S, VERDICT_STEPS = 32, 6, 4.0, (2, 5)  #: of a gate's verdict


def rollouts(given: Given) -> Part:
    """A table by law."""
    figures: list[tuple[str, float, str, int]] = []
    table = _rollouts(given, figures)
    text = "Loops of a law on the belief model, as designs and the gate simulate them."
    return Part(Section("Rollouts", (text,), (table, _verdicts(given, figures))), figures)


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
        if law == "LQG":
            speeds = [loops_per_s(config, CASES["tension"], LOOPS, steps, real=True) for steps in (1, 10)]
            rows.append((f"{law} {REAL}", *(told(speed, 0) for speed in speeds), str(LOOPS)))
            figures.append((slug("rollouts", law, "effects_per_s"), speeds[0], "1/s", LOOPS))
            figures.append((slug("rollouts", law, "effects_1ms_per_s"), speeds[1], "1/s", LOOPS))
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


def _verdicts(given: Given, figures: list[tuple[str, float, str, int]]) -> Table:
    """How long the simulations of a verdict take."""
    config, rows = LAWS["LQG"](task_on(A, CASES["tension"], truth_of(plant_named("s_sim")))), []
    base, stepped = np.full(config.n, 30.0), 30.0 + 14.0 * (np.arange(config.n) == config.n // 2)
    parts = [(0.5, base, 0.05), (1.5, stepped, 0.05), (VERDICT_S - 2.0, base, 0.05)]
    course, plants = course_through(config.period_s, parts, 0.5), _real(_plants(VERDICT_PLANTS, config.n))
    for substeps in VERDICT_STEPS:
        setup = _setup(config, substeps, late_share=0.05)
        simulate(config, plants, course, setup)  # compiled
        took_s = min(_timed(lambda s=setup: [simulate(config, plants, course, s) for _ in range(VERDICT_COURSES)], 5))
        loops = VERDICT_PLANTS * VERDICT_COURSES
        step_ns = 1e9 * took_s / (loops * course.periods * substeps)
        rows.append((str(substeps), told(1e3 * took_s, 0), told(step_ns, 0)))
        figures.append((slug("rollouts", "verdict", f"{substeps}_steps_ms"), 1e3 * took_s, "ms", loops))
    heads = ("Steps a period", "Verdict, ms", "Plant and step, ns")
    return Table(
        f"{VERDICT_COURSES} courses of {VERDICT_S:g} s on {VERDICT_PLANTS} plants each on {os.cpu_count()} cores",
        heads, tuple(rows), numeric(heads, 0),
        note=given.made("LQG with a period of 10 ms, all effects and 5 % late commands, the best of five."),
    )  # fmt: skip


def loops_per_s(
    config: Controller, case: Scenario, count: int, substeps: int, tries: int = 3, real: bool = False
) -> float:
    """Closed loops of `ROLLOUT_S` a second, with so many steps of integration a period; of real plants, if told."""
    plants = _plants(count, config.n)
    course = course_of(case, config.period_s, ROLLOUT_S)
    setup = _setup(config, substeps, 0.05 if real else 0.0)
    if real:
        plants = _real(plants)
    simulate(config, plants, course, setup)  # compiled
    return count / min(
        _timed(lambda: simulate(config, plants, course, setup), 1 if isinstance(config, MpcConfig) else tries)
    )


def _timed(run: Callable[[], object], tries: int) -> list[float]:
    took_s: list[float] = []
    for _ in range(tries):
        began_s = time.perf_counter()
        run()
        took_s.append(time.perf_counter() - began_s)
    return took_s


def _setup(config: Controller, substeps: int, late_share: float = 0.0) -> Setup:
    return Setup(
        config.period_s, config.latency_s, substeps, A.torque_nm, A.torque_rate_nm_per_s, 0.1, 1e-4, 5e-2 * STEP_S**0.5,
        late_share=late_share,
    )  # fmt: skip


def course_of(case: Scenario, period_s: float, duration_s: float) -> Course:
    """A case as it is asked of the line, period by period."""
    time_s: FloatArray = period_s * np.arange(round(duration_s / period_s), dtype=np.float64)
    changed = int(np.searchsorted(time_s, case.change_at_s - 0.5 * period_s))
    return Course(case.setpoints_n(time_s), case.speeds_m_per_s(time_s), changed)


def _plants(count: int, n: int) -> Plants:
    """Plants of the ensemble, again and again."""
    models = [truth_of(random_plant(seed, n)) for seed in TEST[:count]]
    return plants_of([models[i % len(models)] for i in range(count)])


def _real(plants: Plants) -> Plants:
    """The same with a lag of 5 ms, 2 Nm of dry friction and 0.5 % of eccentricity."""
    each = np.ones((plants.count, plants.n))
    phase_rad = each * np.arange(plants.n)
    return with_effects(plants, Effects(np.full(plants.count, 0.005), 2.0 * each, 0.005 * each, phase_rad))
