"""The runtime monitor: what unsafe configurations do to the tension, and how often healthy ones are stopped.

    python -m tests.bench.monitor [--unsafe 300] [--stressed 300] [--healthy 1000] [--first-seed N]

Unsafe: configurations that, alone, take a true tension out of its band; forced in past any judge. The truth judges.
"""

import argparse
import time
from collections import defaultdict
from collections.abc import Iterator

import numpy as np

from gateway.control.design import DesignRefused
from gateway.control.design.task import task_on
from gateway.core.line import Line
from gateway.core.messages import Command
from safety.recoverability import Recovery
from tests.bench.figures import Bench
from tests.bench.monitor_runs import (
    DESIGNS,
    Case,
    Outcome,
    draw_case,
    draw_unsafe,
    run_alone,
    run_deployed,
    run_kept,
    run_probation,
    steps_of,
)
from tests.closed_loop.recorded import demonstration_line

FIRST_SEED = 7_000_000


def cases(line: Line, first: int, stressed: bool | None) -> Iterator[tuple[Case, np.random.Generator]]:
    """Without end; `stressed` None: every other one is. Lines that no design can hold are left out."""
    seed = first
    while True:
        seed += 1
        try:
            case = draw_case(line, seed, seed % 2 == 1 if stressed is None else stressed)
        except DesignRefused:
            continue
        yield case, np.random.default_rng([seed, 2])


def unsafe_runs(line: Line, first: int, count: int, stressed: bool) -> list[tuple[str, Case, Outcome]]:
    """`count` configurations that take the tension out of its band alone, each under the monitor."""
    found: list[tuple[str, Case, Outcome]] = []
    for case, generator in cases(line, first, stressed):
        if len(found) == count:
            break
        try:
            kind, config = draw_unsafe(case, generator)
        except DesignRefused:  # no design on so wrong a model
            continue
        if run_alone(case, config).left:
            found.append((kind, case, run_deployed(case, config)))
            if len(found) % 25 == 0:
                left = sum(outcome.left for _, _, outcome in found)
                how = "with" if stressed else "without"
                print(f"  unsafe, {how} stress: {len(found)} of {count}, {left} left the band", flush=True)
    return found


def healthy_runs(line: Line, first: int, count: int) -> list[tuple[str, Case, list[Command], Outcome]]:
    """Kept configurations under the largest steps, and others on probation while set-points move."""
    found: list[tuple[str, Case, list[Command], Outcome]] = []
    for case, generator in cases(line, first, None):
        if len(found) == count:
            break
        if generator.uniform() < 0.5:
            commands = steps_of(line, generator, shaped=False)
            found.append(("kept", case, commands, run_kept(case, commands)))
        else:
            commands = steps_of(line, generator, shaped=True)
            law = ("lqi", "lqg", "pid", "lqr")[int(generator.integers(4))]
            config = DESIGNS[law](task_on(line, case.theta))
            found.append(("probation", case, commands, run_probation(case, config, commands)))
        if len(found) % 100 == 0:
            tripped = sum(bool(run[3].tripped) for run in found)
            print(f"  healthy: {len(found)} of {count}, {tripped} tripped", flush=True)
    return found


class Cost:
    """What each look of the recovery prediction takes, in processor time."""

    def __init__(self) -> None:
        self.looks_s: list[float] = []
        look = Recovery.shortfall

        def timed(*given: object, **named: object) -> object:
            began_s = time.thread_time()
            found = look(*given, **named)
            self.looks_s.append(time.thread_time() - began_s)
            return found

        Recovery.shortfall = timed


def main() -> None:
    parser = argparse.ArgumentParser(prog="python -m tests.bench.monitor")
    parser.add_argument("--unsafe", type=int, default=300)
    parser.add_argument("--stressed", type=int, default=300)
    parser.add_argument("--healthy", type=int, default=1000)
    parser.add_argument("--first-seed", type=int, default=FIRST_SEED)
    asked = parser.parse_args()
    line, bench, cost = demonstration_line(), Bench("monitor"), Cost()
    bench.seeds = [asked.first_seed, asked.first_seed + 20_000, asked.first_seed + 40_000]
    errors: list[tuple[float, float]] = []
    parts = (("", bench.seeds[0], asked.unsafe, False), ("_stressed", bench.seeds[1], asked.stressed, True))
    for name, first, count, stressed in parts:
        runs = unsafe_runs(line, first, count, stressed)
        left = [(kind, case, outcome) for kind, case, outcome in runs if outcome.left]
        bench.figure(f"left_the_band{name}_pct", 100.0 * len(left) / len(runs), "%", len(runs))
        kinds: defaultdict[str, list[int]] = defaultdict(lambda: [0, 0])
        for kind, _, outcome in runs:
            kinds[kind][0] += 1
            kinds[kind][1] += outcome.left
        bench.tables[f"unsafe{name}"] = {kind: {"runs": n, "left": away} for kind, (n, away) in sorted(kinds.items())}
        bench.tables[f"left{name}"] = [
            f"seed {case.seed}, {case.plant.name}, {kind}, good {case.good.kind}: {outcome.lowest_n:.1f} to "
            f"{outcome.highest_n:.1f} N; {outcome.tripped}"
            for kind, case, outcome in left
        ]
        errors += [outcome.error_n for _, _, outcome in runs if outcome.error_n is not None]
    healthy = healthy_runs(line, bench.seeds[2], asked.healthy)
    tripped = [run for run in healthy if run[3].tripped]
    bench.figure("false_trips", len(tripped), "runs", len(healthy))
    bench.tables["false_trips"] = [
        f"seed {case.seed}, {case.plant.name}, {how}, good {case.good.kind}, {commands}: {outcome.tripped}"
        for how, case, commands, outcome in tripped
    ]
    looks_us = 1e6 * np.array(cost.looks_s)
    bench.figure("look_p50_us", float(np.percentile(looks_us, 50)), "us", len(looks_us))
    bench.figure("look_p99_us", float(np.percentile(looks_us, 99)), "us", len(looks_us))
    lowest, highest = (np.array(errors)[:, i] for i in (0, 1)) if errors else (np.zeros(1), np.zeros(1))
    largest = np.maximum(-lowest, highest)
    bench.figure("prediction_error_p50_n", float(np.percentile(largest, 50)), "N", len(largest))
    bench.figure("prediction_error_p99_n", float(np.percentile(largest, 99)), "N", len(largest))
    bench.finish()


if __name__ == "__main__":
    main()
