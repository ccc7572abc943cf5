"""What a commissioned configuration is worth on its true line, under tiers A and B of the benchmark.

Tier A over the oracle (tests/bench/oracle.py), which knows the paper's equations and no other effect: on lines that
have none. Tier B as it is, and over the same law with the same factors, designed on the truth.
"""

from dataclasses import dataclass

from gateway.cli.rehearse_designs import Design, offered
from gateway.cli.stepped import CommandRefused, run_scenario
from gateway.cli.tiers import TIERS, Tier
from gateway.commissioning.candidates import Law, NotOffered, configuration, designed
from gateway.commissioning.redesign import LAWS, PREDICTIVE
from gateway.control.design import DesignRefused, task_on
from gateway.core.controller import Controller
from gateway.core.line import Line
from gateway.core.line_model import LineModel
from gateway.core.scenario import PAPER, Scenario
from sim_plant.plant import Plant
from tests.bench.oracle import Terms, by_clarabel, by_piqp, oracle
from tests.closed_loop.truths import truth_of

A, B = TIERS["A"], TIERS["B"]


@dataclass(frozen=True)
class Worth:
    """By case of the paper, as far as it could be run."""

    a_n: dict[str, float]
    a_to_oracle: dict[str, float]  #: none where the line has what the oracle does not know
    b_n: dict[str, float]
    b_to_truth: dict[str, float]
    stopped: tuple[str, ...]  #: cases that the gateway stopped, with the reason
    unsafe_events: int


def worth(line: Line, plant: Plant, config: Controller, law: Law, seed: int, *, plain: bool) -> Worth:
    """Of `config`, which was designed by `law`. `plain`: the line is as the paper's equations have it."""
    of_a, of_b = _Runs(line, plant, A, seed), _Runs(line, plant, B, seed)
    a_n, b_n = of_a.rmse_n(config), of_b.rmse_n(config)
    best = {case.name: bound_n(case, plant) for case in PAPER if case.name in a_n} if plain else {}
    on_truth: dict[str, float] = {}
    try:
        task = task_on(line, truth_of(plant, line))
        on_truth = _Runs(line, plant, B, seed).rmse_n(
            offered(Design("truth", law.name, "truth", lambda task: designed(task, law)), task)
        )
    except DesignRefused:
        pass  # the truth itself holds no such design: there is nothing to compare with
    return Worth(
        a_n, {case: a_n[case] / best[case] for case in best}, b_n,
        {case: b_n[case] / on_truth[case] for case in b_n if case in on_truth},
        (*of_a.stopped, *of_b.stopped), of_a.unsafe + of_b.unsafe,
    )  # fmt: skip


def bound_n(case: Scenario, plant: Plant) -> float:
    """The oracle's RMSE under tier A."""
    terms = Terms(A.period_s, A.latency_s, A.torque_nm, A.torque_rate_nm_per_s)
    try:
        return oracle(case, plant.parameters(), terms, by_piqp).rmse_n
    except RuntimeError:  # not solved: what it needs is an answer, not this solver's
        return oracle(case, plant.parameters(), terms, by_clarabel).rmse_n


def law_of(line: Line, model: LineModel | None, config: Controller) -> Law:
    """By which `config` was designed on `model`; of a configuration older than the model, its kind as it begins."""
    if model is not None:
        for law in (*LAWS, *PREDICTIVE):
            try:
                if configuration(line, model, model.region.speed_to_m_per_s, law) == config:
                    return law
            except NotOffered:
                continue
    return Law(config.kind if config.kind != "scheduled" else "lqi")


class _Runs:
    def __init__(self, line: Line, plant: Plant, tier: Tier, seed: int) -> None:
        self._line, self._plant, self._tier, self._seed = line, plant, tier, seed
        self.stopped: list[str] = []
        self.unsafe = 0

    def rmse_n(self, config: Controller) -> dict[str, float]:
        found: dict[str, float] = {}
        for case in PAPER:
            tier = self._tier
            try:
                run = run_scenario(
                    tier.line(self._line, case), config, tier.plant(self._plant), tier.scenario(case), self._seed
                )
            except CommandRefused as refused:
                self.stopped.append(f"tier {tier.name}, {case.name}: {refused}")
                continue
            self.unsafe += run.unsafe_events
            if run.stopped is None:
                found[case.name] = run.rmse_n
            else:
                self.stopped.append(f"tier {tier.name}, {case.name}: {run.stopped}")
        return found
