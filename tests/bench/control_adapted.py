"""A line adapted in rehearsal: experiment, model, design, and the paper's cases under it; and again."""

from dataclasses import dataclass, replace
from functools import cache

from gateway.cli.rehearse import Case, cases_of
from gateway.cli.rehearse_adaptations import IN_SERVICE, NoExperiment, adapt, first_experiment
from gateway.cli.rehearse_designs import Design, offered
from gateway.cli.stepped import CommandRefused, run_scenario
from gateway.cli.tiers import TIERS
from gateway.control.design import DesignRefused, DesignTask
from gateway.core.experiment import Experiment
from gateway.core.line_file import load_line
from gateway.core.line_template import line_template
from sim_plant.plant import Plant
from tests.bench.control_plants import FASTEST_M_PER_S
from tests.bench.control_runs import Outcome, plant_named

SPEEDS = 2  #: of an experiment, with as much time at each


@dataclass(frozen=True)
class Adaptation:
    """Names, so that it is small to send and can be looked up."""

    tier: str
    truth: str
    seed: int
    rounds: int


@dataclass(frozen=True)
class After:
    """What a round has brought."""

    data_s: float  #: at each speed, in this round, what is held out of the fit included
    structure: str
    refused: str  #: why there is no model or no controller; empty: there is one
    findings: tuple[str, ...]  #: what held-out data say against the model
    unsafe: int  #: events at the drives in the experiment
    outcomes: dict[str, Outcome]  #: by case, under MPC with observer on the model


def adapted(asked: Adaptation) -> list[After]:
    """Round by round; fewer than were asked for where one brings no model."""
    cases = _cases(asked.tier, plant_named(asked.truth))
    first = cases[0]
    experiment = _first_experiment(asked.tier)
    rounds = adapt(first.line, first.plant, first.scenario, asked.seed, asked.rounds, first=experiment)
    found: list[After] = []
    known_s = 0.0
    for one in rounds:
        result = one.result
        designs = [(design, task) for design, task in one.designs if design.law != IN_SERVICE]
        outcomes = _outcomes(*designs[0], cases, asked.seed) if designs else {}
        refused = "; ".join([*result.refused, *{outcome.refused for outcome in outcomes.values() if outcome.refused}])
        new_s, known_s = (result.data_s - known_s) / SPEEDS, result.data_s
        found.append(
            After(new_s, result.structure or "", refused, tuple(result.findings), result.unsafe_events, outcomes)
        )
    return found


def _cases(tier: str, plant: Plant) -> list[Case]:
    return cases_of(load_line(line_template(plant.spans, "line.toml"), "line.toml"), plant, [], TIERS[tier])


@cache
def _first_experiment(tier: str) -> Experiment | None:
    """It knows the line's file and nothing of the plant. None: it is refused, as it will be again."""
    first = _cases(tier, plant_named("s_real"))[0]
    try:
        return first_experiment(first.line, first.scenario)
    except NoExperiment:
        return None


def _outcomes(design: Design, task: DesignTask, cases: list[Case], seed: int) -> dict[str, Outcome]:
    # As the designs beside it: a plant of the ensemble need not hold more than the ensemble's speed.
    limits = replace(task.limits, speed_max_m_per_s=min(task.limits.speed_max_m_per_s, FASTEST_M_PER_S))
    try:
        config = offered(design, replace(task, limits=limits))
    except DesignRefused as refused:
        return {case.scenario.name: Outcome(None, refused=str(refused)) for case in cases}
    found: dict[str, Outcome] = {}
    for case in cases:
        try:
            run = run_scenario(case.line, config, case.plant, case.scenario, seed)
        except CommandRefused as refused:
            found[case.scenario.name] = Outcome(None, refused=f"the change is refused: {refused}")
        else:
            found[case.scenario.name] = Outcome(run.metrics, run.unsafe_events, stopped=run.stopped)
    return found
