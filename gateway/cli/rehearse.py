"""A line's commissioning rehearsed against a simulated plant in stepped time: which design is worth what."""

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from math import isfinite
from typing import Protocol, TypeVar

import numpy as np

from gateway.cli.rehearse_adaptations import Adapted
from gateway.cli.rehearse_designs import DESIGNS, TRUTH, Design, offered, truth_of
from gateway.cli.rehearse_gate import adapt_through_gate
from gateway.cli.rehearse_result import AdaptationResult, CaseResult, ConfigurationResult, Spread
from gateway.cli.stepped import CommandRefused, SteppedResult, periods_before, run_scenario
from gateway.cli.tiers import Tier
from gateway.cli.workers import Workers
from gateway.control.design import DesignRefused, DesignTask, task_of
from gateway.core.controller import Controller, config_hash
from gateway.core.line import Line
from gateway.core.scenario import PAPER, Scenario, ScenarioRefused, scenario_of
from sim_plant.plant import Plant

J = TypeVar("J")
R = TypeVar("R")


class RehearsalRefused(Exception):
    """Line, plant and scenarios do not go together. `reasons` has all of it."""

    def __init__(self, reasons: list[str]) -> None:
        super().__init__("; ".join(reasons))
        self.reasons = reasons


@dataclass(frozen=True)
class Case:
    """A scenario, and the line and the plant under the conditions that it is run in."""

    scenario: Scenario
    line: Line
    plant: Plant


def cases_of(line: Line, plant: Plant, scenarios: Sequence[Scenario], tier: Tier | None) -> list[Case]:
    """`scenarios` (none: both of the paper's) on `line` and `plant`, under `tier` or else under their own conditions.

    Wires and addresses are not looked at: nothing here is on a wire. Raises RehearsalRefused with every reason.
    """
    reasons: list[str] = []
    if line.n != plant.spans:
        reasons.append(f"the line has {_spans(line.n)}, the plant has {_spans(plant.spans)}: change either")
    if not scenarios and line.n != PAPER[0].n:
        reasons.append(
            f"the paper's scenarios are for {PAPER[0].n} spans, the line has {line.n}: name the TOML file of a "
            f"scenario with --scenario"
        )
    elif not scenarios:
        scenarios = PAPER
    found: list[Case] = []
    for scenario in scenarios:
        try:
            found.append(_case(line, plant, scenario, tier))
        except ScenarioRefused as refused:
            reasons.append(f"{scenario.name}: {refused}")
            continue
        reasons += _reasons_against(found[-1])
    if reasons:
        raise RehearsalRefused(reasons)
    return found


def _case(line: Line, plant: Plant, scenario: Scenario, tier: Tier | None) -> Case:
    if tier is not None:
        moved = scenario_of(scenario.moved_over(tier.move_s).model_dump())  # it may end before its move does
        return Case(moved, tier.line(line, moved), tier.plant(plant))
    return Case(scenario, _moving_as(line, scenario), plant)


def _reasons_against(case: Case) -> list[str]:
    """Why `case` cannot be run; empty where it can."""
    scenario, period_s = case.scenario, case.line.control.period_s
    reasons = scenario.reasons_against(case.line.n, case.line.limits)
    if periods_before(scenario, period_s) < 1:
        reasons.append(
            f"{scenario.name} changes at {scenario.change_at_s:g} s, before control has begun; allowed: change_at_s of "
            f"more than half a period, {0.5 * period_s:g} s"
        )
    return reasons


def _moving_as(line: Line, scenario: Scenario) -> Line:
    """A scenario that moves says how fast: `line` with the rates at which its set-points do. Steps need none."""
    if not scenario.move_s:
        return line
    control, limits = line.control, line.limits
    own = Tier(
        "", "", control.period_s, control.latency_s, limits.torque_nm, limits.torque_rate_nm_per_s, scenario.move_s
    )
    return line.model_copy(update={"moves": own.line(line, scenario).moves})


def rehearse(
    cases: Sequence[Case],
    seed: int,
    workers: int,
    tell: Callable[[str], None] = lambda text: None,
    designs: Sequence[Design] = DESIGNS,
    adaptations: int = 0,
    adapt: Callable[[Line, Plant, Scenario, int, int, Callable[[str], None]], list[Adapted]] = adapt_through_gate,
) -> tuple[list[ConfigurationResult], list[AdaptationResult]]:
    """Every design in every case, and the rounds of adaptation that have brought some of them.

    But for compute times the result does not depend on `workers` (processes). A design that is refused is not offered,
    a run that is refused is a failure; the others go on.
    """
    first = cases[0]
    rounds = adapt(first.line, first.plant, first.scenario, seed, adaptations, tell)
    with _mapped(workers) as mapped:
        tell("designing")
        tasks = [(design, _task(design, first)) for design in designs]  # the scenario plays no part in a design
        at = next((i for i, (design, _) in enumerate(tasks) if design.model == TRUTH), len(tasks))
        tasks[at:at] = [task for one in rounds for task in one.designs]
        configs = list(mapped(_designed, tasks))
        jobs = [(config, case, seed) for config in configs if not isinstance(config, str) for case in cases]
        found: list[CaseResult | str] = []
        for outcome in mapped(_run, jobs):
            found.append(outcome)
            tell(f"{len(found)} of {len(jobs)} runs")
    outcomes = iter(found)
    configurations = [_configuration(d, c, cases, outcomes) for (d, _), c in zip(tasks, configs, strict=True)]
    return _beside_truth(configurations), [one.result for one in rounds]


def _task(design: Design, case: Case) -> DesignTask:
    task = task_of(case.line)
    return replace(task, model=truth_of(case.plant)) if design.model == TRUTH else task


def _designed(job: tuple[Design, DesignTask]) -> Controller | str:
    """The configuration, or why there is none."""
    try:
        return offered(*job)
    except DesignRefused as refused:
        return str(refused)


def _run(job: tuple[Controller, Case, int]) -> CaseResult | str:
    """The figures of a run, or why there are none."""
    config, case, seed = job
    try:
        return _figures(case.scenario, run_scenario(case.line, config, case.plant, case.scenario, seed))
    except CommandRefused as refused:
        return f"the change is refused: {refused}"


def _figures(scenario: Scenario, run: SteppedResult) -> CaseResult:
    metrics = run.metrics
    p50, p99 = np.percentile(run.step_s * 1e6, (50, 99))
    return CaseResult(
        scenario=scenario.name,
        rmse_n=metrics.rmse_n,
        rmse_per_span_n=metrics.rmse_per_span_n.tolist(),
        settling_s=[_unless_never(time_s) for time_s in metrics.settling_s.tolist()],
        settling_paper_s=_unless_never(metrics.settling_paper_s),
        overshoot_pct=metrics.overshoot_pct.tolist(),
        overshoot_paper_pct=metrics.overshoot_paper_pct,
        effort_n2m2s=metrics.effort_n2m2s,
        compute_us=Spread(p50=float(p50), p99=float(p99), max=float(run.step_s.max() * 1e6)),
        tension_min_n=float(run.tension_n.min()),
        tension_max_n=float(run.tension_n.max()),
        unsafe_events=run.unsafe_events,
        stopped=run.stopped,
    )


def _configuration(
    design: Design, config: Controller | str, cases: Sequence[Case], outcomes: Iterator[CaseResult | str]
) -> ConfigurationResult:
    """Takes of `outcomes` what belongs to `config`: one for each case, none where it was refused."""
    is_offered = not isinstance(config, str)
    own = {case.scenario.name: next(outcomes) for case in cases} if is_offered else {}
    return ConfigurationResult(
        name=design.name,
        law=design.law,
        model=design.model,
        controller=config_hash(config) if is_offered else None,
        refused=None if is_offered else config,
        cases=[outcome for outcome in own.values() if not isinstance(outcome, str)],
        failures={name: outcome for name, outcome in own.items() if isinstance(outcome, str)},
    )


def _beside_truth(found: list[ConfigurationResult]) -> list[ConfigurationResult]:
    """With every RMSE over the best that a design on the truth has reached; that of a stopped line is worth nothing."""
    best: dict[str, float] = {}
    for configuration in found:
        for case in configuration.cases:
            if configuration.model == TRUTH and case.stopped is None:
                best[case.scenario] = min(case.rmse_n, best.get(case.scenario, np.inf))

    def beside(case: CaseResult) -> CaseResult:
        comparable = case.scenario in best and case.stopped is None
        return case.model_copy(
            update={"ratio_to_truth_design": case.rmse_n / best[case.scenario] if comparable else None}
        )

    return [one.model_copy(update={"cases": [beside(case) for case in one.cases]}) for one in found]


class Mapped(Protocol):
    def __call__(self, function: Callable[[J], R], jobs: Sequence[J], /) -> Iterator[R]: ...


@contextmanager
def _mapped(workers: int) -> Iterator[Mapped]:
    """`map` over processes: results in the order of the jobs, each as soon as it and those before it are there."""
    if workers == 1:
        yield map
        return
    with Workers(workers) as pool:
        yield pool.map


def _unless_never(time_s: float) -> float | None:
    return time_s if isfinite(time_s) else None


def _spans(count: int) -> str:
    return f"{count} span" if count == 1 else f"{count} spans"
