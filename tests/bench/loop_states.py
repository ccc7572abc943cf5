"""`make bench-loop-states`: the loop's states in any order of commands, faults, cancellations, cuts and deaths.

The state machine of tests/closed_loop/loop_states.py over many sequences, in tasks with a seed of their own; then the
faults that the loop once had, each put back, and how many sequences it takes to find it. What a task has found is
written at once to `out/bench/loop-states.jsonl`: `--go-on` runs only what is not there yet.
"""

import argparse
import json
import os
from dataclasses import asdict, replace
from functools import partial
from pathlib import Path

from tests.bench.figures import Bench
from tests.bench.workers import Workers
from tests.closed_loop.loop_mutations import FAULTS, FOUND_WITHIN
from tests.closed_loop.loop_sequences import STEPS, Ran, run_sequences

SEQUENCES = 20_000
TASK = 250  #: sequences of one seed
FOUND = Path("out/bench/loop-states.jsonl")
#: One of them is put back in two ways: its two halves break two invariants.
OLD_FAULTS = 6


def main() -> None:
    parser = argparse.ArgumentParser(
        prog="make bench-loop-states", description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--sequences", type=int, default=SEQUENCES)
    parser.add_argument("--seed", type=int, default=1, help="of the first task; the others count on (1)")
    parser.add_argument("--workers", type=int, default=min(2, os.cpu_count() or 1))
    parser.add_argument("--go-on", action="store_true", help="with what an earlier run has left")
    given = parser.parse_args()
    seeds = [given.seed + k for k in range(-(-given.sequences // TASK))]
    before = _found_before() if given.go_on else {}
    with Workers(given.workers) as workers:
        runs = [before[seed] for seed in seeds if seed in before]
        for ran in workers.each(_run, [seed for seed in seeds if seed not in before], "tasks"):
            runs.append(ran)
            _note([*runs])
        faults = list(workers.each(partial(_find, given.seed), list(FAULTS), "faults put back"))
    _report(given.seed, runs, faults)


def _report(seed: int, runs: list[Ran], faults: list[tuple[str, Ran]]) -> None:
    bench = Bench("loop-states", [seed], libraries=("hypothesis", "numpy"))
    sequences = sum(ran.sequences for ran in runs)
    broken = [ran for ran in runs if ran.broken]
    lost = [fault for fault, ran in faults if not ran.broken]
    bench.figure("sequences", sequences, "", sequences)
    bench.figure("periods", sum(ran.periods for ran in runs), "", sequences)
    bench.figure("broken_invariants", len(broken), "", sequences)
    bench.figure("old_faults_not_found", len(lost), "", len(faults))
    bench.figure("sequences_until_found", max(ran.sequences for _, ran in faults), "", len(faults))
    bench.tables["faults put back"] = [
        {"fault": fault, "sequences": ran.sequences, "broken": ran.broken.partition("\n")[0][:200]}
        for fault, ran in faults
    ]
    bench.tables["broken"] = [asdict(ran) for ran in broken]
    for row in bench.tables["faults put back"]:
        print(f"{row['sequences']:>6}  {row['fault']}: {row['broken'] or 'NOT FOUND'}")
    for ran in broken:
        print(f"seed {ran.seed}: {ran.broken}")
    bench.finish()


def _run(seed: int) -> Ran:
    return run_sequences(seed, TASK)


def _find(seed: int, fault: str) -> tuple[str, Ran]:
    ran = run_sequences(seed, FOUND_WITHIN, fault, shrink=False)
    return fault, replace(ran, broken=ran.broken.partition("\n")[0])


def _note(runs: list[Ran]) -> None:
    FOUND.parent.mkdir(parents=True, exist_ok=True)
    FOUND.write_text("".join(json.dumps(asdict(ran) | {"task": TASK, "steps": STEPS}) + "\n" for ran in runs))


def _found_before() -> dict[int, Ran]:
    """By seed. Tasks of another size are run anew."""
    if not FOUND.exists():
        return {}
    rows = [json.loads(line) for line in FOUND.read_text().splitlines()]
    fitting = [row for row in rows if (row.pop("task"), row.pop("steps")) == (TASK, STEPS)]
    return {row["seed"]: Ran(**row) for row in fitting}


if __name__ == "__main__":
    main()
