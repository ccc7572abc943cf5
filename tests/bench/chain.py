"""`make bench-chain`: the chain from the line's file to a redesign that is kept, on drawn lines; verdicts that stay.

    python -m tests.bench.chain [--parts lines,verdicts] [--lines 8] [--proposals 50] [--first-seed N] [--workers 2]

lines: a file as `r2rgate init` writes it, of 3 to 9 spans, and a random plant around S_sim, every second one with lag,
dry friction, eccentric rollers and slow load cells; the rules commission it in stepped time, through a whole gate. Told
are how many end with a redesign in service, what the others ended by, and whether anything unsafe came of it.
verdicts: a controller that chatters just as much as the gate allows, and one that is well within, each proposed often.
"""

import argparse
import asyncio
import tempfile
import time
from dataclasses import replace
from pathlib import Path
from statistics import fmean
from typing import Any

import numpy as np

from gateway.cli.commission import commission
from gateway.cli.commission_changes import first_speed_m_per_s
from gateway.cli.commission_stepped import SteppedGate, impatient
from gateway.cli.stepped import SteppedLoop
from gateway.commissioning.past import Step
from gateway.control.design import design_lqi, lqi_weights, task_of
from gateway.core.line import Line
from gateway.core.line_file import load_line
from gateway.core.line_template import line_template
from gateway.core.proposal import canonical
from safety.draws import seed_of
from safety.judge import judge
from sim_plant.drawn import random_plant, unruly_plant
from tests.bench.figures import Bench
from tests.bench.workers import Workers
from tests.safety.case_support import gains, published

FIRST_SEED = 48_000
SPANS = (3, 9)
PARTS = ("lines", "verdicts")


def line_of(seed: int) -> Line:
    spans = int(np.random.default_rng([seed, 48]).integers(SPANS[0], SPANS[1] + 1))
    return impatient(load_line(line_template(spans, "line.toml"), "line.toml"))


def commissioned(seed: int) -> dict[str, Any]:
    """One line, from `init` on; `kept`: redesigns."""
    line, began_s = line_of(seed), time.perf_counter()
    plant = (random_plant, unruly_plant)[seed % 2](seed, line.n)
    loop = SteppedLoop(line, design_lqi(task_of(line)), plant, seed)
    loop.begin_in_production(np.array(line.recipes[0].tension_n), first_speed_m_per_s(line))

    async def story() -> dict[str, Any]:
        with tempfile.TemporaryDirectory() as folder:
            async with SteppedGate(loop, Path(folder), seed) as side:
                found = await commission(line, side)
        tried = [one for one in found.tried if one.step == Step.REDESIGN]
        return {
            "seed": seed, "spans": line.n, "plant": plant.name, "kept": sum(one.stage == "kept" for one in tried),
            "redesigns": [one.text for one in tried], "tried": len(found.tried), "reached": found.reached,
            "text": found.text, "unsafe": loop.truth.recorder.unsafe_total, "line_s": loop.now_s,
        }  # fmt: skip

    return {**asyncio.run(story()), "wall_s": round(time.perf_counter() - began_s, 1)}


def verdicts(proposals: int) -> dict[str, tuple[int, int]]:
    """By controller: how often it was let through, of how many proposals. Each proposal has a reason of its own."""
    of = published()
    context, weights = of.context(), lqi_weights(of.task())
    # As it comes, its chatter is far below what is allowed, and the limit is set to just what it chatters by.
    law = design_lqi(of.task(), replace(weights, torque_per_nm2=0.5 * weights.torque_per_nm2))
    payload = canonical(gains(law, context))
    seen = [judge(payload, context, of.line, [of.recording], seed) for seed in range(5)]
    chatter_nm = fmean(one.value or 0.0 for each in seen for one in each.findings if one.rule == "corners: chatter")
    at_limit = of.line.model_copy(update={"gate": of.line.gate.model_copy(update={"chatter_max_nm": chatter_nm})})
    found: dict[str, tuple[int, int]] = {}
    for name, line in (("within", of.line), ("at its limit", at_limit)):
        passed = 0
        for number in range(proposals):
            again = canonical(gains(law, context, reason=f"try {number}"))
            passed += judge(again, context, line, [of.recording], seed_of(b"bench", again, context, line)).accepted
        found[name] = passed, proposals
    return found


def main() -> None:
    parser = argparse.ArgumentParser(prog="make bench-chain", description=(__doc__ or "").split("\n")[0])
    parser.add_argument("--parts", default=",".join(PARTS), help="with commas between them")
    parser.add_argument("--lines", type=int, default=8)
    parser.add_argument("--proposals", type=int, default=50)
    parser.add_argument("--first-seed", type=int, default=FIRST_SEED)
    parser.add_argument("--workers", type=int, default=2)
    asked = parser.parse_args()
    parts = asked.parts.split(",")
    if unknown := set(parts) - {*PARTS}:
        raise SystemExit(f"no such part: {', '.join(sorted(unknown))}; allowed: {', '.join(PARTS)}")
    bench = Bench("chain", [asked.first_seed])
    if "lines" in parts:
        seeds = range(asked.first_seed, asked.first_seed + asked.lines)
        with Workers(asked.workers) as workers:
            found = list(workers.each(commissioned, seeds, "lines"))
        bench.tables["lines"] = found
        bench.figure("kept_share", fmean(one["kept"] > 0 for one in found), "", len(found))
        bench.figure("unsafe", sum(one["unsafe"] for one in found), "", len(found))
        for one in found:
            head = f"{one['seed']}: {one['spans']} spans, {one['plant']}, {one['kept']} kept"
            print(f"{head}, {one['line_s']:.0f} s of the line, {one['wall_s']:.0f} s: {one['text']}")
            for text in () if one["kept"] else one["redesigns"]:
                print(f"    {text}")
    if "verdicts" in parts:
        for name, (passed, count) in verdicts(asked.proposals).items():
            bench.figure(f"{name.replace(' ', '_')}_same_share", max(passed, count - passed) / count, "", count)
            print(f"{name}: let through {passed} of {count} times")
    bench.finish()


if __name__ == "__main__":
    main()
