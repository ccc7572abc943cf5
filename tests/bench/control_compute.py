"""What a step of each law takes. Nothing else runs beside it."""

from math import nan

import numpy as np

from gateway.cli.rehearse_designs import truth_of
from gateway.cli.report import Section, Table
from gateway.cli.stepped import SteppedResult, run_scenario
from gateway.cli.tiers import A
from gateway.core.scenario import Scenario
from gateway.core.signals import FloatArray
from gateway.loop.realtime import freeze_collector
from tests.bench.control_runs import CASES, LAWS, line_of, plant_named, task_on
from tests.bench.control_tables import FEW_SEEDS, Given, Part, numeric, seeds_told, slug, told

PAPER_MPC_MS = 0.2319
PERCENTILES = {"p50": 50.0, "p99": 99.0, "worst": 100.0}


def compute(given: Given) -> Part:
    """Step times under tier A on S_real."""
    figures: list[tuple[str, float, str, int]] = []
    steps = _steps(given, figures)
    section = Section(
        "Compute time of a step",
        (
            "A step is asking and committing: observer, reference, optimisation, and what is remembered. Six spans, "
            "N_p of MPC 15 periods, 10 ms period, whole runs of both cases; the step of the set-point drives torque "
            "and rate to their limits, which is where MPC takes its time. The paper has 0.2319 ms for MPC.",
        ),
        (steps,),
    )
    return Part(section, figures)


def p50_ms(part: Part) -> dict[str, float]:
    """C_comp by law, of what `compute` has found."""
    found = {name: value for name, value, _, _ in part.figures}
    return {law: found[name] for law in LAWS if (name := slug("compute", law, "p50_ms")) in found}


def _steps(given: Given, figures: list[tuple[str, float, str, int]]) -> Table:
    heads = ("Law", *(f"{name}, ms" for name in PERCENTILES), *(f"{name} at a limit, ms" for name in PERCENTILES))
    heads += ("at a limit, %", "the paper, ms")
    rows = []
    seeds = range(min(given.seeds, FEW_SEEDS))
    for law in given.laws:
        times_s, limited = step_times(law, [(case, seed) for case in CASES.values() for seed in seeds])
        cells = []
        for row in (times_s, times_s[limited]):
            cells += [told(1e3 * float(np.percentile(row, q)) if len(row) else nan, 4) for q in PERCENTILES.values()]
        share = told(100.0 * float(limited.mean()), 1)
        rows.append((law, *cells, share, told(PAPER_MPC_MS, 4) if law == "MPC" else ""))
        for name, q in PERCENTILES.items():
            figures.append(
                (slug("compute", law, f"{name}_ms"), 1e3 * float(np.percentile(times_s, q)), "ms", len(times_s))
            )
    return Table(
        "One step of each law, tier A",
        heads,
        tuple(rows),
        numeric(heads, 1),
        note=given.made(
            f"S_real, designs on S_sim, both cases, {seeds_told(seeds)}, one process alone. At a limit: periods in "
            f"which a torque or its rate is at its limit."
        ),
    )


def step_times(law: str, runs: list[tuple[Scenario, int]]) -> tuple[FloatArray, np.ndarray]:
    """Seconds of every step (k,) of runs (case, seed) on S_real, and whether the torque was at a limit (k,)."""
    plant = A.plant(plant_named("s_real"))
    found: list[tuple[FloatArray, np.ndarray]] = []
    for i, (case, seed) in enumerate([runs[0], *runs]):
        config = LAWS[law](task_on(A, case, truth_of(plant_named("s_sim"))))
        freeze_collector()
        result = run_scenario(line_of(A, case), config, plant, case, seed)
        if i:  # the first is for caches and compiled code
            found.append(
                (result.step_s, at_limit(result, A.period_s, A.latency_s, A.torque_nm, A.torque_rate_nm_per_s))
            )
    return np.concatenate([times for times, _ in found]), np.concatenate([limited for _, limited in found])


def at_limit(result: SteppedResult, period_s: float, latency_s: float, most_nm: float, rate: float) -> np.ndarray:
    """Whether the torque that each period has caused is at its limit, or as far from the one before as it may be."""
    began_s = period_s * np.arange(len(result.step_s)) + latency_s + 0.5 * period_s
    rows = np.minimum(np.searchsorted(result.time_s, began_s), len(result.time_s) - 1)
    torque = result.torque_nm[rows]
    change = np.abs(np.diff(torque, axis=0, prepend=torque[:1]))
    near = 1.0 - 1e-6
    limited = (np.abs(torque) >= near * most_nm) | (change >= near * rate * period_s)
    return np.any(limited, axis=1)
