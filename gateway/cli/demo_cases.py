"""The paper's cases on the line that runs, in real time; once more where this computer has stalled."""

import time
from collections.abc import Awaitable, Callable, Sequence
from dataclasses import dataclass
from typing import TypeVar

from gateway.cli.demo_failed import DemoFailed
from gateway.cli.demo_operator import Operator
from gateway.core.controller import Controller
from gateway.core.messages import SelectRecipe
from gateway.core.scenario import Scenario

T = TypeVar("T")

MOST_REPEATS = 2  #: of a case, or of a start, after the line has stopped by itself


@dataclass(frozen=True)
class Window:
    """When a case ran, on CLOCK_MONOTONIC, and under which configuration."""

    case: Scenario
    config: Controller
    begin_s: float
    end_s: float


async def prove_with_repeats(operator: Operator) -> None:
    """That the line is wired as its file says: without it no start."""
    await _with_repeats(operator, operator.prove, "not proved; once more")


async def begin_with_repeats(operator: Operator) -> None:
    """From rest to a line that is being tensioned. Refused, a person reads why and tries again."""
    await _with_repeats(operator, operator.begin, "not started; once more")


async def _with_repeats(operator: Operator, do: Callable[[], Awaitable[None]], story: str) -> None:
    for _ in range(MOST_REPEATS):
        try:
            return await do()
        except DemoFailed as failed:
            await operator.recover(f"{story} ({failed})", str(failed))
    await do()


async def again_after_stops(operator: Operator, do: Callable[[], Awaitable[T]], story: str) -> T:
    """A computer that stalls, or on which the simulated devices do, stops the line, as it must; then once more.

    `story`: what is said of that. Raises DemoFailed where anything else is wrong, or the line has stopped too often.
    """
    for _ in range(MOST_REPEATS):
        try:
            return await do()
        except DemoFailed as failed:
            if not await operator.has_stopped():
                raise
            await operator.recover(f"{story}: {failed}", str(failed))
            await begin_with_repeats(operator)
    return await do()


async def settle_with_repeats(operator: Operator, tension_n: Sequence[float], speed_m_per_s: float) -> None:
    """At set-points."""
    await again_after_stops(operator, lambda: operator.wait_settled(tension_n, speed_m_per_s), "started once more")


async def run_with_repeats(operator: Operator, config: Controller, case: Scenario, period_s: float) -> Window:
    return await again_after_stops(operator, lambda: _run_case(operator, config, case, period_s), "the case once more")


async def _run_case(operator: Operator, config: Controller, case: Scenario, period_s: float) -> Window:
    progress = operator.progress
    await operator.order(SelectRecipe(name=case.name))
    progress.step(f"{case.heading.lower()}: settling at its set-points")
    await operator.wait_settled(case.tension_n, case.speed_m_per_s)
    begin_s = time.monotonic()
    progress.case(case.heading, case.duration_s)
    await operator.watch(case.change_at_s)
    for command in case.commands():
        await operator.order(command)
    await operator.watch(begin_s + case.duration_s - time.monotonic())
    end_s = time.monotonic()
    # Beyond the window, so that it is whole whenever exactly the change took effect.
    await operator.watch(4 * period_s)
    return Window(case, config, begin_s, end_s)
