"""The paper's figures of configurations under identical conditions: the same model, cases, noise and seed for all."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from math import inf

import numpy as np

from gateway.commissioning.ground import course_of
from gateway.commissioning.suite import suite_of
from gateway.control.design import DesignRefused, design_mpc, task_on
from gateway.control.rollout import Course, Rollouts, plants_of_thetas, simulate
from gateway.core.controller import Controller, config_hash
from gateway.core.deployment import Region
from gateway.core.line import Line
from gateway.core.line_model import LineModel, noise_of, theta_of
from gateway.core.metrics import RunMetrics, run_metrics
from gateway.core.scenario import PAPER, Scenario
from gateway.core.signals import FloatArray
from gateway.core.theta import Noise, Theta, nominal_theta
from safety.simulated import setup_of

SEED = 1
QUIET = Noise(0.0, 0.0, 0.0)


@dataclass(frozen=True)
class Named:
    """A configuration that controlled the line."""

    name: str  #: Initial, Adapt1 ...
    hash: str
    controller: Controller
    region: Region | None  #: for which it was judged; None: it was not, or that is not known
    unjudged: str = "not judged: the line was started with it"  #: what to say then


@dataclass(frozen=True)
class Simulated:
    """A configuration in a case. Shapes (k, n); metrics are infinite where the line ran away."""

    tension_n: FloatArray
    torque_nm: FloatArray
    rmse_n: float
    overshoot_pct: float  #: of the worst span
    settling_s: float  #: of the worst span; inf: never
    effort_n2m2s: float


@dataclass(frozen=True)
class Conditions:
    """Identical for all configurations."""

    line: Line
    model: LineModel | None  #: None: the line's file

    @property
    def noise(self) -> Noise:
        return Noise() if self.model is None else noise_of(self.model) or Noise()

    @property
    def theta(self) -> Theta:
        """As it is believed to be."""
        return nominal_theta(self.line) if self.model is None else theta_of(self.model)

    @property
    def reference(self) -> Named | None:
        """The paper's other baseline: predictive control that is designed on this very model; None: there is none."""
        try:
            controller = design_mpc(task_on(self.line, self.theta, self.noise))
        except DesignRefused:
            return None
        return Named("MPC baseline", config_hash(controller), controller, None, "never proposed: a reference")

    def run(self, controller: Controller, case: Scenario) -> Simulated:
        """RMSE, effort and courses under noise; overshoot and settling without, where they are no matter of luck."""
        course = course_of(case, self.line.control.period_s)
        noisy, quiet = (self._rollouts(controller, course, noise) for noise in (self.noise, QUIET))
        if noisy.diverged[0] or quiet.diverged[0]:
            return Simulated(noisy.tension_n[0], noisy.torque_nm[0], inf, inf, inf, inf)
        of_noisy, of_quiet = (self._metrics(one, course) for one in (noisy, quiet))
        return Simulated(
            noisy.tension_n[0], noisy.torque_nm[0], of_noisy.rmse_n, float(of_quiet.overshoot_pct.max(initial=0.0)),
            float(of_quiet.settling_s.max(initial=0.0)), of_noisy.effort_n2m2s,
        )  # fmt: skip

    def _rollouts(self, controller: Controller, course: Course, noise: Noise) -> Rollouts:
        latency_s = max(self.theta.latency_s, self.line.control.latency_s)
        plants = plants_of_thetas([replace(self.theta, latency_s=latency_s)])
        return simulate(controller, plants, course, setup_of(self.line, noise, SEED, 0.0), record=True)

    def _metrics(self, run: Rollouts, course: Course) -> RunMetrics:
        """Of spans with a load cell: a draw span's tension no controller keeps."""
        period_s = self.line.control.period_s
        time_s = time_of(course, period_s)
        spans = [i for i, span in enumerate(self.line.spans) if span.control == "tension"]
        changed_s = (course.changed - 0.5) * period_s
        return run_metrics(time_s, run.tension_n[0][:, spans], course.tension_n[:, spans], run.torque_nm[0], changed_s)


def time_of(course: Course, period_s: float) -> FloatArray:
    """(k,), from the start of the case."""
    return np.arange(course.periods, dtype=np.float64) * period_s


def cases_of(line: Line) -> tuple[Scenario, ...]:
    """The paper's where the line can run them, else steps of tension and speed as large as its limits allow."""
    fits = not any(case.reasons_against(line.n, line.limits) for case in PAPER)
    return PAPER if fits else suite_of(line)


def simulated(
    conditions: Conditions, named: Sequence[Named], cases: Sequence[Scenario], tell: Callable[[str], None]
) -> dict[str, list[Simulated | str]]:
    """By case, in the order of `named`; a sentence where a configuration cannot be simulated."""
    found: dict[str, list[Simulated | str]] = {case.name: [] for case in cases}
    for case in cases:
        for one in named:
            tell(f"simulating {one.name}, {case.heading.lower()}")
            try:
                found[case.name].append(conditions.run(one.controller, case))
            except ValueError as error:  # of another period, or another number of spans
                found[case.name].append(str(error))
    return found
