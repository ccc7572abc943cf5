"""What is run: a law, designed on one plant, on another, under a tier; many side by side, each only once.

Every run goes through the whole cycle in stepped time (loop, envelope, in-memory link, simulated line) and is judged by
the recorder there. A design knows the model that it was made on and nothing else.
"""

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from functools import cache
from typing import Any, Literal

import numpy as np

from gateway.cli.rehearse_designs import mpc_without_observer, truth_of
from gateway.cli.stepped import CommandRefused, SteppedResult, run_scenario
from gateway.cli.tiers import TIERS, Tier
from gateway.control.design import (
    DesignRefused,
    DesignTask,
    design_lqg,
    design_lqi,
    design_lqr,
    design_mpc,
    design_pid,
    task_of,
)  # fmt: skip
from gateway.core.controller import Controller
from gateway.core.line import Line
from gateway.core.line_file import load_line
from gateway.core.line_template import line_template
from gateway.core.metrics import RunMetrics
from gateway.core.scenario import PAPER, Scenario
from gateway.core.signals import FloatArray
from gateway.core.web_model import WebModel
from sim_plant.physics import STEP_S, equilibrium
from sim_plant.plant import Plant, load_plant
from tests.bench.control_plants import FASTEST_M_PER_S, random_plant, stressed_plant, uneven_plant
from tests.bench.oracle import Terms, by_clarabel, by_piqp, oracle
from tests.bench.workers import Workers

Boundary = Literal["free", "continued"]  #: T_0 = T_{n+1} = 0; or those of the first and the last span
DRAWN = {"random": random_plant, "uneven": uneven_plant}
CASES = {case.name: case for case in PAPER}

# What charts show of a run: densely around the change, sparsely until the line is at rest.
TRACE_S: FloatArray = np.concatenate((np.arange(0.9, 1.5, 0.002), np.arange(1.5, 6.0, 0.02)))


LAWS: dict[str, Callable[[DesignTask], Controller]] = {
    "PID": design_pid,
    "LQR": design_lqr,
    "LQI": design_lqi,
    "LQG": design_lqg,
    "MPC": mpc_without_observer,
    "MPC + observer": design_mpc,
}


@dataclass(frozen=True)
class Job:
    """Names, so that it is small to send and can be looked up."""

    tier: str
    case: str
    law: str
    known: str  #: the plant that the design was made on
    truth: str
    seed: int
    boundary: Boundary = "free"


@dataclass(frozen=True)
class Bound:
    """A question to the oracle."""

    tier: str
    case: str
    truth: str
    boundary: Boundary = "free"


@dataclass(frozen=True)
class Trace:
    """(len(TRACE_S), n) each."""

    tension_n: FloatArray
    torque_nm: FloatArray


@dataclass(frozen=True)
class Outcome:
    metrics: RunMetrics | None  #: None: no design was offered, or the change was refused
    unsafe: int = 0
    refused: str = ""
    stopped: str | None = None  #: when and why the gateway stopped the line: an RMSE that is worth nothing
    trace: Trace | None = None  #: of the first seed on a plant of the paper

    @property
    def rmse_n(self) -> float:
        return self.metrics.rmse_n if self.metrics else float("nan")


@dataclass(frozen=True)
class Best:
    rmse_n: float
    trace: Trace


@cache
def plant_named(name: str, boundary: Boundary = "free", case: str = "") -> Plant:
    """A plant by the name of its file, `stressed`, or `random-SEED` and `uneven-SEED` of the ensemble."""
    kind, _, seed = name.partition("-")
    if kind in DRAWN:
        plant = DRAWN[kind](int(seed))
    elif name == "stressed":
        plant = stressed_plant()
    else:
        plant = load_plant(f"sim_plant/plants/{name}.toml")
    if boundary == "free":
        return plant
    tension = CASES[case].tension_n
    ends = {"tension_before_n": tension[0], "tension_after_n": tension[-1]}
    return plant.model_copy(update={"web": plant.web.model_copy(update=ends)})


def line_of(tier: Tier, case: Scenario) -> Line:
    """The line of the template, with S_sim in its file, under a tier."""
    return tier.line(load_line(line_template(case.n, "line.toml"), "line.toml"), case)


def task_on(tier: Tier, case: Scenario, model: WebModel) -> DesignTask:
    """The line's own design task on `model`. A plant of the ensemble need not hold more than the ensemble's speed."""
    task = task_of(line_of(tier, case))
    return replace(task, model=model, limits=replace(task.limits, speed_max_m_per_s=FASTEST_M_PER_S))


def run(job: Job) -> Outcome:
    """One run. A design that is refused is an outcome too, and a line that is stopped before anything has changed."""
    tier, case = TIERS[job.tier], CASES[job.case]
    known, truth = (plant_named(name, job.boundary, job.case) for name in (job.known, job.truth))
    try:
        config = LAWS[job.law](task_on(tier, case, truth_of(known)))
    except DesignRefused as refusal:
        return Outcome(None, refused=str(refusal))
    try:
        found = run_scenario(line_of(tier, case), config, tier.plant(truth), tier.scenario(case), job.seed)
    except CommandRefused as refused:
        return Outcome(None, refused=str(refused))
    traced = job.seed == 0 and job.boundary == "free" and job.truth.partition("-")[0] not in DRAWN
    return Outcome(found.metrics, found.unsafe_events, stopped=found.stopped, trace=_trace(found) if traced else None)


def bound(asked: Bound) -> Best:
    """The oracle's answer. It knows literal steps only."""
    tier, case = TIERS[asked.tier], CASES[asked.case]
    plant = plant_named(asked.truth, asked.boundary, asked.case).parameters()
    terms = Terms(tier.period_s, tier.latency_s, tier.torque_nm, tier.torque_rate_nm_per_s)
    try:
        found = oracle(case, plant, terms, by_piqp)
    except RuntimeError:  # not solved: what it needs is an answer, not this solver's
        found = oracle(case, plant, terms, by_clarabel)
    _, rest = equilibrium(plant, np.array(case.tension_n), case.speed_m_per_s)
    # From the change on there is a row a millisecond, the first of them a millisecond after it.
    since = np.round((TRACE_S - case.change_at_s) / STEP_S).astype(int)
    tension = np.vstack((case.tension_n, found.tension_n))
    torque = np.vstack((rest, np.repeat(found.torque_nm, terms.steps, axis=0)))
    rows = np.clip(since, 0, len(found.tension_n))
    beyond = since > len(found.tension_n)
    shown = [np.where(beyond[:, None], np.nan, values[rows]) for values in (tension, torque)]
    return Best(found.rmse_n, Trace(*shown))


def _trace(found: SteppedResult) -> Trace:
    rows = np.searchsorted(found.time_s, TRACE_S - 0.5 * STEP_S)
    return Trace(found.tension_n[rows], found.torque_nm[rows])


class Runs(Workers):
    """Runs in other processes. What was run before is not run again. Use as a context."""

    def __init__(self, workers: int | None = None) -> None:
        super().__init__(workers)
        self._outcomes: dict[Job, Outcome] = {}
        self._bests: dict[Bound, Best] = {}
        self._others: dict[Callable[[Any], Any], dict[Any, Any]] = {}

    def of(self, jobs: Sequence[Job], title: str) -> list[Outcome]:
        """Outcomes of `jobs`, in their order."""
        return _all(self._outcomes, jobs, self.each, run, title)

    def best(self, asked: Sequence[Bound], title: str = "oracle") -> list[Best]:
        """The oracle's answers, in the order of the questions."""
        return _all(self._bests, asked, self.each, bound, title)

    def every(self, function: Callable[[Any], Any], asked: Sequence[Any], title: str) -> list[Any]:
        """`function` of each of `asked`, in their order."""
        return _all(self._others.setdefault(function, {}), asked, self.each, function, title)

    @property
    def made(self) -> dict[Job, Outcome]:
        """Everything that has been run so far."""
        return self._outcomes


def _all(
    known: dict[Any, Any], wanted: Sequence[Any], each: Callable[..., Iterable[Any]], function: Any, title: str
) -> list[Any]:
    missing = [one for one in dict.fromkeys(wanted) if one not in known]
    if missing:
        known.update(zip(missing, each(function, missing, title), strict=True))
    return [known[one] for one in wanted]
