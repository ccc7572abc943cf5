"""Commissioning tasks to score who decides: a line, what is true of it, and the cases in which the end is measured.

A task is a function of the seed, its number and the number of spans. The line's file believes S_sim throughout; the
plant is a random one around it, every second with lag, dry friction, eccentric rollers and slow load cells beside. All
are disturbed, and their load cells are noisy.

The line is to be adapted up to `TOP_M_PER_S`, which its file lets a first configuration go up to: so one round of
experiment, model, redesign and measurement is a whole commissioning, and two redesigns are all that is deployed.
"""

from dataclasses import dataclass

import numpy as np

from gateway.cli.commission_stepped import impatient
from gateway.cli.tiers import TIERS, Tier
from gateway.control.design import design_lqi
from gateway.control.design import task_of as design_task_of
from gateway.core.controller import Controller
from gateway.core.line import Line
from gateway.core.line_file import load_line
from gateway.core.line_template import line_template
from gateway.core.scenario import Scenario
from sim_plant.drawn import random_plant, unruly_plant
from sim_plant.plant import Plant

SPANS = 3
TOP_M_PER_S, SLOW_M_PER_S = 0.05, 0.01
MOST_DEPLOYMENTS = 2  #: of redesigns
WATCHED_S = 6.0  #: a case: its change, and more than it takes to settle
STEP_N = (12.0, 24.0)  #: of the tension case, drawn between
MIDDLE_N = 30.0
LARGEST_SEED = 2**31


@dataclass(frozen=True)
class Case:
    """A scenario under a tier's conditions."""

    scenario: Scenario
    tier: Tier

    @property
    def name(self) -> str:
        return f"{self.scenario.name}, {'moves' if self.tier.move_s else 'steps'}"


@dataclass(frozen=True)
class Task:
    number: int
    seed: int  #: of the plant, its noise and the gate
    line: Line
    plant: Plant
    cases: tuple[Case, ...]

    @property
    def begin(self) -> Controller:
        """What is in service when the task begins."""
        return design_lqi(design_task_of(self.line))


def task_of(number: int, seed: int, spans: int = SPANS) -> Task:
    """Task `number`, from 0, of the series `seed`."""
    generator = np.random.default_rng([seed, number])
    own = int(generator.integers(LARGEST_SEED))
    line = impatient(load_line(line_template(spans, "line.toml"), "line.toml"))
    line = line.model_copy(update={"gate": line.gate.model_copy(update={"first_speed_max_m_per_s": TOP_M_PER_S})})
    plant = (random_plant, unruly_plant)[number % 2](own, spans)
    scenarios = _tension(line, generator), _velocity(spans)
    cases = tuple(Case(scenario, TIERS[tier]) for scenario in scenarios for tier in ("A", "B"))
    return Task(number, own, line, plant, cases)


def _tension(line: Line, generator: np.random.Generator) -> Scenario:
    """The paper's: one span steps, towards where there is more room."""
    before = list(line.recipes[0].tension_n)
    span, step_n = int(generator.integers(line.n)), float(generator.uniform(*STEP_N))
    after = list(before)
    after[span] += step_n if before[span] <= MIDDLE_N else -step_n
    return Scenario(
        name="tension", tension_n=before, speed_m_per_s=SLOW_M_PER_S, tension_after_n=after, duration_s=WATCHED_S
    )


def _velocity(spans: int) -> Scenario:
    """The paper's: the unwinder goes from slow to the greatest speed."""
    return Scenario(
        name="velocity", tension_n=[MIDDLE_N] * spans, speed_m_per_s=SLOW_M_PER_S, speed_after_m_per_s=TOP_M_PER_S,
        duration_s=WATCHED_S,
    )  # fmt: skip
