"""Part d of bench-gate: new lines commissioned through the gate, in stepped time; what gets through, at what worth.

Each line is run twice: as the paper's equations have it, and with lag, dry friction and rollers out of round beside.
The line's file believes S_sim throughout. The recorder at the simulated line says what became of the web.
"""

import asyncio
import tempfile
import time
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from gateway.cli.commission import Tried, commission
from gateway.cli.commission_stepped import SteppedGate
from gateway.cli.stepped import CommandRefused, SteppedLoop, run_scenario
from gateway.control.design import DesignRefused, design_lqi, task_of, task_on
from gateway.core.controller import Controller
from gateway.core.line import Line
from gateway.core.scenario import PAPER
from sim_plant.plant import Plant
from tests.bench.control_plants import random_plant
from tests.bench.figures import Bench
from tests.bench.gate_plants import FIRST_SEED, plant_number
from tests.bench.identify_runs import Workers
from tests.closed_loop.recorded import demonstration_line, real_plant
from tests.closed_loop.truths import truth_of


@dataclass(frozen=True)
class OfLine:
    """A line commissioned."""

    number: int
    unruly: bool
    reached: bool
    text: str
    speed_m_per_s: float | None
    deployments: int
    tried: list[Tried]
    tension_n: tuple[float, float]  #: lowest and highest, true
    unsafe_events: int
    ratios: dict[str, float]  #: by scenario: RMSE over that of an LQI designed on the truth
    line_s: float  #: that the line ran
    processor_s: float

    @property
    def name(self) -> str:
        return f"{self.number}{' unruly' if self.unruly else ''}"


def bench_commissioning(bench: Bench, workers: Workers, numbers: Sequence[int]) -> None:
    """`numbers` of the lines, as `gate_plants` has them."""
    jobs = [(number, unruly) for number in numbers for unruly in (False, True)]
    found: list[OfLine] = list(workers.each(commissioned, jobs, "lines"))
    bench.figure("commissioned", sum(one.reached for one in found), "", len(found))
    bench.figure("commissioned_pct", 100.0 * float(np.mean([one.reached for one in found])), "%", len(found))
    bench.figure("commissioning_unsafe_events", sum(one.unsafe_events for one in found), "", len(found))
    bench.figure("commissioning_lowest_n", min(one.tension_n[0] for one in found), "N", len(found))
    bench.figure("commissioning_highest_n", max(one.tension_n[1] for one in found), "N", len(found))
    ratios = [ratio for one in found if one.reached for ratio in one.ratios.values()]
    if ratios:
        bench.figure("commissioned_rmse_over_truth_p50", float(np.median(ratios)), "", len(ratios))
        bench.figure("commissioned_rmse_over_truth_max", max(ratios), "", len(ratios))
    bench.tables["commissioned lines"] = {
        "heads": ("line", "reached", "up to, m/s", "deployments", "tension, N", "unsafe", "RMSE over truth's design",
                  "line, s", "processor, s", "end"),
        "rows": [
            (one.name, one.reached, f"{one.speed_m_per_s or 0.0:.3g}", one.deployments,
             f"{one.tension_n[0]:.1f} to {one.tension_n[1]:.1f}", one.unsafe_events,
             ", ".join(f"{name} {ratio:.3f}" for name, ratio in one.ratios.items()), round(one.line_s),
             round(one.processor_s), one.text) for one in found
        ],
    }  # fmt: skip
    refused = Counter((one.kind, one.rule or one.stage) for line in found for one in line.tried if _failed(one))
    bench.tables["what was refused on the way"] = {
        "heads": ("kind", "by", "times"),
        "rows": [(*what, times) for what, times in refused.most_common()],
    }
    bench.tables["each refusal"] = {
        "heads": ("line", "candidate"),
        "rows": [(line.name, one.text) for line in found for one in line.tried if _failed(one)],
    }


def commissioned(job: tuple[int, bool]) -> OfLine:
    """Of a line of six spans that runs its first recipe when it begins."""
    number, unruly = job
    line, plant, began_s = demonstration_line(), plant_of(number, unruly), time.process_time()
    recipe = line.recipes[0]
    loop = SteppedLoop(line, design_lqi(task_of(line)), plant, number)
    loop.begin_in_production(np.array(recipe.tension_n), recipe.speed_m_per_s)

    async def run() -> OfLine:
        with tempfile.TemporaryDirectory() as folder:
            async with SteppedGate(loop, Path(folder), number) as side:
                found = await commission(line, side)
                in_service, deployments = (await side.now()).in_service, side.deployer.book.epoch
        truth = loop.truth.recorder
        tension = truth.recording().tension_n
        return OfLine(
            number, unruly, found.reached, found.text, found.speed_m_per_s, deployments, found.tried,
            (float(tension.min()), float(tension.max())), truth.unsafe_total,
            beside_truth(line, plant, in_service, number), loop.now_s, time.process_time() - began_s,
        )  # fmt: skip

    return asyncio.run(run())


def plant_of(number: int, unruly: bool) -> Plant:
    if unruly:
        return plant_number(number)
    return real_plant() if number == 0 else random_plant(FIRST_SEED + number)


def beside_truth(line: Line, plant: Plant, config: Controller, seed: int) -> dict[str, float]:
    """By scenario of the paper; without those that one of the two cannot run."""
    found: dict[str, float] = {}
    try:
        on_truth = design_lqi(task_on(line, truth_of(plant, line)))
        for scenario in PAPER:
            own, best = (run_scenario(line, one, plant, scenario, seed) for one in (config, on_truth))
            if own.stopped is None and best.stopped is None:
                found[scenario.name] = own.rmse_n / best.rmse_n
    except (CommandRefused, DesignRefused):
        return found
    return found


def _failed(one: Tried) -> bool:
    return one.stage not in ("kept", "done") or bool(one.why)
