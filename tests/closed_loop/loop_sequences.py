"""Runs of the states' test: so many sequences from a seed, and what came of them."""

import traceback
from contextlib import nullcontext
from dataclasses import dataclass

from hypothesis import HealthCheck, Phase, seed, settings
from hypothesis.stateful import run_state_machine_as_test

from tests.closed_loop.loop_mutations import put_back
from tests.closed_loop.loop_states import LoopStates

STEPS = 25  #: at most, of a sequence


@dataclass(frozen=True)
class Ran:
    """`broken` is the first invariant that did not hold, with the sequence that shows it; empty: all did."""

    seed: int
    sequences: int
    periods: int
    broken: str


def run_sequences(seed_: int, sequences: int, fault: str = "", *, shrink: bool = True) -> Ran:
    """Stops at the first broken invariant. With `fault` put back, of `loop_mutations`."""

    class Counted(LoopStates):
        begun = periods = 0

        def __init__(self) -> None:
            super().__init__()
            Counted.begun += 1

        def teardown(self) -> None:
            Counted.periods += self.passed
            super().teardown()

    phases = [Phase.generate, Phase.shrink] if shrink else [Phase.generate]
    given = settings(
        max_examples=sequences, stateful_step_count=STEPS, database=None, deadline=None, phases=phases,
        suppress_health_check=list(HealthCheck), report_multiple_bugs=False, print_blob=False,
    )  # fmt: skip
    broken = ""
    with put_back(fault) if fault else nullcontext():
        try:
            run_state_machine_as_test(seed(seed_)(Counted), settings=given)
        except Exception as error:  # an invariant's, or one of the loop's own
            notes = "\n".join(getattr(error, "__notes__", []))
            last = traceback.extract_tb(error.__traceback__)[-1]
            broken = f"{type(error).__name__}: {error} ({last.name}, line {last.lineno})\n{notes}"
    return Ran(seed_, Counted.begun, Counted.periods, broken)
