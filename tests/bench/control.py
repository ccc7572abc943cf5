"""`make bench-control`: the paper's cases under every tier, each law beside the oracle; the compute time of a step.

Every run goes through the whole cycle in stepped time (loop, envelope, in-memory link, simulated line) and is judged by
the recorder there. Designs know the model that they were made on and nothing else.
"""

import argparse
import os
from collections.abc import Callable, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from rich.progress import Progress

from gateway.cli.stepped import run_scenario
from gateway.cli.tiers import TIERS, Tier
from gateway.control.design import (
    DesignTask,
    design_lqg,
    design_lqi,
    design_lqr,
    design_mpc,
    design_pid,
    mpc_weights,
    task_of,
    without_disturbances,
)  # fmt: skip
from gateway.core.controller import Controller
from gateway.core.line import Line
from gateway.core.line_file import load_line
from gateway.core.line_template import line_template
from gateway.core.scenario import PAPER, Scenario
from gateway.core.web_model import WebModel
from sim_plant.plant import Plant, load_plant
from tests.bench.figures import Bench
from tests.bench.oracle import Terms, oracle

SEEDS = 20


def mpc_without_observer(task: DesignTask) -> Controller:
    """The paper's baseline: nothing in it takes an offset away."""
    return design_mpc(task, without_disturbances(mpc_weights(task)))


LAWS: dict[str, Callable[[DesignTask], Controller]] = {
    "PID": design_pid,
    "LQR": design_lqr,
    "LQI": design_lqi,
    "LQG": design_lqg,
    "MPC": mpc_without_observer,
    "MPC + observer": design_mpc,
}


@dataclass(frozen=True)
class Job:
    tier: Tier
    case: Scenario
    law: str
    known: str  #: the plant that the design was made on
    truth: str
    seed: int

    @property
    def row(self) -> tuple[str, str, str, str]:
        return self.tier.name, self.case.name, self.law, self.known


@dataclass(frozen=True)
class Outcome:
    rmse_n: float
    unsafe: int


def plant_named(name: str) -> Plant:
    return load_plant(f"sim_plant/plants/{name}.toml")


def belief(plant: Plant) -> WebModel:
    """What a design knows when it knows the truth."""
    p = plant.parameters()
    return WebModel(
        float(p.stiffness_n[0]), p.length_m, p.radius_m, p.inertia_kg_m2, p.friction_nms_per_rad, p.tension_before_n,
        p.tension_after_n,
    )  # fmt: skip


def line_of(tier: Tier, case: Scenario) -> Line:
    return tier.line(load_line(line_template(6, "line.toml"), "line.toml"), case)


def run(job: Job) -> Outcome:
    line = line_of(job.tier, job.case)
    config = LAWS[job.law](replace(task_of(line), model=belief(plant_named(job.known))))
    found = run_scenario(line, config, job.tier.plant(plant_named(job.truth)), job.tier.scenario(job.case), job.seed)
    return Outcome(found.rmse_n, found.unsafe_events)


def bounds(tiers: Sequence[Tier]) -> dict[tuple[str, str], float]:
    """The oracle's RMSE on S_real, by tier and case; tier B has none."""
    truth = plant_named("s_real").parameters()
    found = {}
    for tier in tiers:
        if tier.move_s:
            continue
        terms = Terms(tier.period_s, tier.latency_s, tier.torque_nm, tier.torque_rate_nm_per_s)
        for case in PAPER:
            found[tier.name, case.name] = oracle(case, truth, terms).rmse_n
            print(f"oracle, tier {tier.name}, {case.name}: {found[tier.name, case.name]:.4f} N", flush=True)
    return found


def main() -> None:
    parser = argparse.ArgumentParser(prog="make bench-control", description=__doc__)
    parser.add_argument("--seeds", type=int, default=SEEDS)
    parser.add_argument("--tiers", default=",".join(TIERS))
    parser.add_argument("--laws", default=",".join(LAWS))
    given = parser.parse_args()
    tiers = [TIERS[name] for name in given.tiers.split(",")]
    whole = set(tiers) == set(TIERS.values()) and set(given.laws.split(",")) == set(LAWS)
    bench = Bench("control" if whole else "control-part", list(range(given.seeds)))
    best = bounds(tiers)
    jobs = [
        Job(tier, case, law, known, "s_real", seed)
        for tier in tiers
        for case in PAPER
        for law in given.laws.split(",")
        for known in ("s_sim", "s_real")
        for seed in range(given.seeds)
    ]
    rows: dict[tuple[str, str, str, str], list[Outcome]] = {}
    with ProcessPoolExecutor(os.cpu_count()) as pool, Progress() as progress:
        bar = progress.add_task("runs", total=len(jobs))
        for job, outcome in zip(jobs, pool.map(run, jobs, chunksize=4), strict=True):
            rows.setdefault(job.row, []).append(outcome)
            progress.advance(bar)
    table = [told(row, outcomes, best) for row, outcomes in rows.items()]
    for entry in table:
        over = f", {entry['to_oracle']:.3f} x oracle" if entry["to_oracle"] else ""
        print(
            f"{entry['tier']:7} {entry['case']:9} {entry['law']:15} on {entry['known']:7} "
            f"{entry['rmse_n']:8.4f} N (p95 {entry['p95_n']:.4f}){over}"
        )
    bench.tables["rows"] = table
    for entry in table:
        name = "_".join(entry[key] for key in ("tier", "law", "known", "case")).lower().replace(" + ", "_")
        bench.figure(f"{name}_n", entry["rmse_n"], "N", entry["n"])
        if entry["to_oracle"]:
            bench.figure(f"{name}_to_oracle", entry["to_oracle"], "x", entry["n"])
    bench.tables["oracle"] = {f"{tier} {case}": value for (tier, case), value in best.items()}
    bench.figure("unsafe_events", sum(one.unsafe for found in rows.values() for one in found), "", len(jobs))
    bench.finish()


def told(row: tuple[str, str, str, str], outcomes: list[Outcome], best: dict[tuple[str, str], float]) -> dict[str, Any]:
    tier, case, law, known = row
    rmse = [outcome.rmse_n for outcome in outcomes]
    mean = float(np.mean(rmse))
    bound = best.get((tier, case))
    return {
        "tier": tier, "case": case, "law": law, "known": known, "rmse_n": mean,
        "p95_n": float(np.percentile(rmse, 95)), "to_oracle": mean / bound if bound else None,
        "unsafe": sum(outcome.unsafe for outcome in outcomes), "n": len(rmse),
    }  # fmt: skip


if __name__ == "__main__":
    main()
