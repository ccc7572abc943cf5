"""`make bench-lifecycle`: what becomes of proposals, in any order of everything, with processes that die in between.

The state machines of tests/unit/test_deployer_life_cycle.py over many sequences: propose, judge, approve, reject,
expire, supersede, deploy, renew, keep, roll back, gateway and loop started anew, wire and disk lost, death between any
two effects. Every invariant is asked after every step. A sequence that breaks one is shrunk and printed, and counted.
"""

import argparse
import traceback

from hypothesis import HealthCheck, Phase, settings
from hypothesis.stateful import run_state_machine_as_test

from tests.bench.figures import Bench
from tests.unit.test_deployer_life_cycle import LifeCycle, TrustingLifeCycle

STEPS = 30  #: at most, of a sequence


def main() -> None:
    parser = argparse.ArgumentParser(
        prog="make bench-lifecycle", description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--sequences", type=int, default=10_000, help="of both machines together (10000)")
    given = parser.parse_args()
    bench, broken, sequences = Bench("lifecycle"), 0, 0
    for machine in (LifeCycle, TrustingLifeCycle):
        run = counting(machine)
        try:
            run_state_machine_as_test(run, settings=many(given.sequences // 2))
        except AssertionError:
            traceback.print_exc()
            broken += 1
        sequences += run.sequences
        print(f"{machine.__name__}: {run.sequences} sequences, {run.steps} steps", flush=True)
        bench.figure(f"{machine.__name__}_steps", run.steps, "", run.sequences)
    bench.figure("sequences", sequences, "", sequences)
    bench.figure("machines_with_a_broken_invariant", broken, "", sequences)
    bench.finish()


def counting(machine: type[LifeCycle]) -> type[LifeCycle]:
    class Counting(machine):
        sequences = steps = 0

        def __init__(self) -> None:
            super().__init__()
            Counting.sequences += 1

        def check_invariants(self, *args, **kwargs) -> None:
            Counting.steps += 1
            super().check_invariants(*args, **kwargs)

    return Counting


def many(examples: int) -> settings:
    return settings(
        max_examples=examples, stateful_step_count=STEPS, database=None, deadline=None,
        suppress_health_check=list(HealthCheck), phases=[Phase.generate, Phase.shrink],
    )  # fmt: skip


if __name__ == "__main__":
    main()
