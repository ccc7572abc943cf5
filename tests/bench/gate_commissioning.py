"""Part d of bench-gate: new lines commissioned through the gate, in stepped time; what gets through, at what worth.

Each line is run twice: as the paper's equations have it, and with lag, dry friction and rollers out of round beside.
The line's file believes S_sim throughout. The recorder at the simulated line says what became of the web. What is then
in service is run under tiers A and B (`gate_tiers`). On every second line the grade changes once it is commissioned: a
web of another stiffness, and the chain goes on from there.
"""

import asyncio
import tempfile
import time
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from gateway.cli.commission import commission
from gateway.cli.commission_result import Commissioned, Tried
from gateway.cli.commission_stepped import SteppedGate, impatient
from gateway.cli.stepped import SteppedLoop
from gateway.control.design import design_lqi, task_of
from gateway.core.controller import Controller
from gateway.core.line import Line
from sim_plant.plant import Plant
from tests.bench.control_plants import random_plant, scaled
from tests.bench.figures import Bench
from tests.bench.gate_plants import FIRST_SEED, plant_number
from tests.bench.gate_tiers import Worth, law_of, worth
from tests.bench.workers import Workers
from tests.closed_loop.recorded import demonstration_line, real_plant

GOALS = "gate-commissioning"  #: part of goals.toml
REGRADED_EVERY = 5  #: lines: on so many one sees its grade change
GRADE = 0.8  #: times the stiffness of the web


@dataclass(frozen=True)
class Chain:
    """A commissioning from its begin to its end."""

    reached: bool
    converged: bool
    text: str
    speed_m_per_s: float | None
    deployments: int
    approvals: int  #: manual acts, where a person decides each change
    tried: list[Tried]
    tension_n: tuple[float, float]  #: lowest and highest, true
    unsafe_events: int
    line_s: float  #: that the line ran


@dataclass(frozen=True)
class OfLine:
    """A line commissioned."""

    number: int
    unruly: bool
    chain: Chain
    law: str  #: of what is in service in the end
    worth: Worth
    regraded: Chain | None  #: with another web, from the change on
    processor_s: float

    @property
    def name(self) -> str:
        return f"{self.number}{' unruly' if self.unruly else ''}"


def bench_commissioning(bench: Bench, workers: Workers, numbers: Sequence[int]) -> None:
    """`numbers` of the lines, as `gate_plants` has them."""
    jobs = [(number, unruly, not unruly and k % REGRADED_EVERY == 0) for k, number in enumerate(numbers)
            for unruly in (False, True)]  # fmt: skip
    found: list[OfLine] = list(workers.each(commissioned, jobs, "lines"))
    before, bench.goals_of = bench.goals_of, GOALS
    _chains(bench, "commissioned", [one.chain for one in found])
    _tiers(bench, found)
    if regraded := [one.regraded for one in found if one.regraded is not None]:
        _chains(bench, "regraded", regraded)
    bench.goals_of = before
    bench.tables["commissioned lines"] = {
        "heads": ("line", "reached", "converged", "up to, m/s", "law", "deployments", "approvals", "tension, N",
                  "unsafe", "tier A over the oracle", "tier B, N", "over truth's design", "line, s",
                  "processor, s", "end"),
        "rows": [
            (one.name, one.chain.reached, one.chain.converged, f"{one.chain.speed_m_per_s or 0.0:.3g}", one.law,
             one.chain.deployments, one.chain.approvals, "{:.1f} to {:.1f}".format(*one.chain.tension_n),
             one.chain.unsafe_events + one.worth.unsafe_events, _told(one.worth.a_to_oracle), _told(one.worth.b_n),
             _told(one.worth.b_to_truth), round(one.chain.line_s), round(one.processor_s),
             "; ".join([one.chain.text, *one.worth.stopped])) for one in found
        ],
    }  # fmt: skip
    bench.tables["lines whose grade has changed"] = {
        "heads": ("line", "reached", "converged", "line, s", "approvals", "deployments", "unsafe", "end"),
        "rows": [
            (one.name, chain.reached, chain.converged, round(chain.line_s), chain.approvals, chain.deployments,
             chain.unsafe_events, chain.text) for one in found if (chain := one.regraded) is not None
        ],
        "note": f"a web of {GRADE:g} times the stiffness, from the first look at it to what is in service then",
    }  # fmt: skip
    refused = Counter((one.kind, one.rule or one.stage) for line in found for one in line.chain.tried if _failed(one))
    bench.tables["what was refused on the way"] = {
        "heads": ("kind", "by", "times"),
        "rows": [(*what, times) for what, times in refused.most_common()],
    }
    bench.tables["each refusal"] = {
        "heads": ("line", "candidate"),
        "rows": [(line.name, one.text) for line in found for one in line.chain.tried if _failed(one)],
    }


def _chains(bench: Bench, name: str, found: Sequence[Chain]) -> None:
    count = len(found)
    bench.figure(name, sum(one.reached for one in found), "", count)
    bench.figure(f"{name}_pct", 100.0 * float(np.mean([one.reached for one in found])), "%", count)
    bench.figure(f"{name}_converged_pct", 100.0 * float(np.mean([one.converged for one in found])), "%", count)
    bench.figure(f"{name}_unsafe_events", sum(one.unsafe_events for one in found), "", count)
    bench.figure(f"{name}_lowest_n", min(one.tension_n[0] for one in found), "N", count)
    bench.figure(f"{name}_highest_n", max(one.tension_n[1] for one in found), "N", count)
    bench.figure(f"{name}_line_p50_s", float(np.median([one.line_s for one in found])), "s", count)
    bench.figure(f"{name}_approvals_p50", float(np.median([one.approvals for one in found])), "", count)
    bench.figure(f"{name}_deployments_p50", float(np.median([one.deployments for one in found])), "", count)


def _tiers(bench: Bench, found: Sequence[OfLine]) -> None:
    """S_real by itself, as the paper has it; all others together."""
    real = [one.worth for one in found if one.number == 0 and not one.unruly]
    others = [one.worth for one in found if one.number > 0]
    for case in ("tension", "velocity"):
        for one in real:
            for name, of, unit in (("a_to_oracle", one.a_to_oracle, "x"), ("b_n", one.b_n, "N")):
                if case in of:
                    bench.figure(f"s_real_{name}_{case}", of[case], unit, 1)
        for name in ("a_to_oracle", "b_to_truth"):
            ratios = [of[case] for one in others if case in (of := getattr(one, name))]
            if ratios:
                bench.figure(f"{name}_{case}_p50", float(np.median(ratios)), "x", len(ratios))
                bench.figure(f"{name}_{case}_p95", float(np.percentile(ratios, 95)), "x", len(ratios))
    bench.figure("tiers_stopped", sum(len(one.worth.stopped) for one in found), "", len(found))
    bench.figure("tiers_unsafe_events", sum(one.worth.unsafe_events for one in found), "", len(found))


def _told(by_case: dict[str, float]) -> str:
    return ", ".join(f"{case} {value:.3f}" for case, value in by_case.items())


def commissioned(job: tuple[int, bool, bool]) -> OfLine:
    """Of a line of six spans that runs its first recipe when it begins; number, unruly, whether its grade changes."""
    number, unruly, regrade = job
    line, plant, began_s = impatient(demonstration_line()), plant_of(number, unruly), time.process_time()

    async def run() -> OfLine:
        loop = producing(line, plant, design_lqi(task_of(line)), number)
        with tempfile.TemporaryDirectory() as folder:
            async with SteppedGate(loop, Path(folder), number) as side:
                found = _chain(side, await commission(line, side))
                now = await side.now()
            law = law_of(line, now.model, now.in_service)
            regraded = None
            if regrade and found.reached:
                other = scaled(plant, {"stiffness_n": GRADE})
                again = producing(line, other, now.in_service, number + 1)
                async with SteppedGate(again, Path(folder), number + 1, before=side) as then:
                    await then.line_changed("a web of another stiffness")
                    regraded = _chain(then, await commission(line, then))
        what = worth(line, plant, now.in_service, law, number, plain=not unruly)
        return OfLine(number, unruly, found, law.text, what, regraded, time.process_time() - began_s)

    return asyncio.run(run())


def producing(line: Line, plant: Plant, config: Controller, seed: int) -> SteppedLoop:
    """A line that runs its first recipe."""
    recipe = line.recipes[0]
    loop = SteppedLoop(line, config, plant, seed)
    loop.begin_in_production(np.array(recipe.tension_n), recipe.speed_m_per_s)
    return loop


def _chain(side: SteppedGate, found: Commissioned) -> Chain:
    truth = side.loop.truth.recorder
    tension = truth.recording().tension_n
    return Chain(
        found.reached, found.converged, found.text, found.speed_m_per_s, side.loop.cycle.configurations.epoch,
        side.approvals, found.tried, (float(tension.min()), float(tension.max())), truth.unsafe_total, side.loop.now_s,
    )  # fmt: skip


def plant_of(number: int, unruly: bool) -> Plant:
    if unruly:
        return plant_number(number)
    return real_plant() if number == 0 else random_plant(FIRST_SEED + number)


def _failed(one: Tried) -> bool:
    return one.stage not in ("kept", "done") or bool(one.why)
