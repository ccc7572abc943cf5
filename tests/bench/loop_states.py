"""`make bench-loop-states`: the loop's states in any order of commands, faults, cancellations, cuts and deaths.

The state machine of tests/closed_loop/loop_states.py over many sequences, in tasks with a seed of their own; then the
faults that the loop once had, each put back, and how many sequences it takes to find it. What a task has found is
written at once to `out/bench/loop-states.jsonl`: `--go-on` runs only what is not there yet.
"""

import argparse
import os
from dataclasses import asdict, replace
from functools import partial
from pathlib import Path

from tests.bench.figures import Bench
from tests.bench.kept_rows import KeptRows
from tests.bench.workers import Workers
from tests.closed_loop.loop_mutations import FAULTS, FOUND_WITHIN
from tests.closed_loop.loop_sequences import STEPS, Ran, run_sequences

SEQUENCES = 20_000
TASK = 250  #: sequences of one seed
FOUND = Path("out/bench/loop-states.jsonl")
_SIZE = {"task": TASK, "steps": STEPS}
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
    kept = KeptRows(FOUND, given.go_on)
    before = _by_seed(kept)
    with Workers(given.workers) as workers:
        for ran in workers.as_done(_run, [seed for seed in seeds if seed not in before], "tasks"):
            kept.add(asdict(ran) | _SIZE)
        faults = list(workers.each(partial(_find, given.seed), list(FAULTS), "faults put back"))
    found = _by_seed(kept)
    _report(given.seed, [found[seed] for seed in seeds], faults, kept.made_by())


def _report(seed: int, runs: list[Ran], faults: list[tuple[str, Ran]], made_by: dict[str, int]) -> None:
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
    bench.tables["tasks by program"] = made_by
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


def _by_seed(kept: KeptRows) -> dict[int, Ran]:
    """Tasks of another size are run anew."""
    fitting = [row for row in kept if row.items() >= _SIZE.items()]
    return {row["seed"]: Ran(**{key: value for key, value in row.items() if key not in _SIZE}) for row in fitting}


if __name__ == "__main__":
    main()
