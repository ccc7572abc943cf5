"""The judge of the gate: whether a configuration is unsafe on the true line, and whether refusing it would be wrong.

A case that is unsafe as a whole is looked at again without those steps that the loop refuses: nobody can make them.
"""

from collections.abc import Callable
from dataclasses import dataclass
from itertools import product

import numpy as np

from gateway.core.controller import Controller
from gateway.core.controller_laws import MpcConfig
from gateway.core.experiment import Experiment, course
from gateway.core.line import Line
from gateway.core.line_model import LineModel
from tests.independent.cases import fastest, largest_case, measuring_cases, trying_cases
from tests.independent.runs import Case, Found, simulated
from tests.independent.truth import FloatArray, Truth, stressed

EXTRA_DELAY_S = 0.004  #: that a good configuration stands on the true line
AROUND = 0.05  #: the rules' stress is tried on corners of so much around the truth
CORNERS = 6  #: drawn of the 32
BETTER = 0.03  #: in one metric at least
TOLERATED = 0.5  #: of the gate's own tolerance: what no metric may be worse by
ROLLERS = 1.5  #: times the line's greatest speed: there torque goes off
FORESEEN = 0.85  #: of that: the loop refuses a step that its model says would make a roller faster
LITTLE = 1.0 / 16.0  #: of a case: so little that no torque is cut
MARGIN_CASES = (0, 3, 7, 8, -1)  #: of those that are tried: where the margin is looked at
FAMILIES = ("stiffness_n", "length_m", "radius_m", "inertia_kg_m2", "friction_nms_per_rad")


@dataclass(frozen=True)
class Metrics:
    """On the true line, case by case: of all spans together, and of the worst span."""

    rmse_n: dict[str, float]
    overshoot_pct: dict[str, float]  #: `_overshoot_pct`
    settling_s: dict[str, float]

    @property
    def mean_rmse_n(self) -> float:
        return float(np.mean(list(self.rmse_n.values())))


@dataclass(frozen=True)
class Judged:
    unsafe: str  #: what is unsafe, and in which case; empty: nothing
    good: bool  #: safe with a margin, and better than what is in service: refusing it is wrong
    why_not_good: str
    metrics: Metrics | None
    unguarded: str = ""  #: what is unsafe if the loop lets every step; then it is not good


Lets = Callable[[Controller, Case], Case]  #: a case without the steps that the loop refuses


def everything(_config: Controller, case: Case) -> Case:
    """Of a loop that refuses nothing."""
    return case


class GateJudge:
    """Of one line, whose truth it knows, against a configuration in service and a baseline."""

    def __init__(
        self,
        line: Line,
        truth: Truth,
        in_service: Controller,
        baseline: Controller,
        top_m_per_s: float,
        seed: int,
        speed_max_m_per_s: float | None = None,
        lets: Lets = everything,
    ) -> None:
        """`speed_max_m_per_s`: of the line, where `line` has been narrowed to what is judged."""
        self.line, self.truth, self.seed, self.lets = line, truth, seed, lets
        self.roller_most_m_per_s = ROLLERS * (speed_max_m_per_s or line.limits.speed_max_m_per_s)
        self.top_m_per_s = fastest(line, truth, top_m_per_s)
        largest = largest_case(line, self.top_m_per_s, np.random.default_rng([seed, 2]))
        self.cases = [*trying_cases(line, self.top_m_per_s, np.random.default_rng(seed)), largest]
        self.measuring = measuring_cases(line, self.top_m_per_s)
        gate = line.gate
        stress = (gate.stress_torque_lag_s, gate.stress_late_share, gate.stress_coulomb_nm, gate.stress_eccentricity)
        self.stressed = stressed(truth, *stress)
        corners = list(product((1.0 - AROUND, 1.0 + AROUND), repeat=len(FAMILIES)))
        picked = np.random.default_rng([seed, 1]).choice(len(corners), CORNERS, replace=False)
        self.around = [
            stressed(truth.scaled(**dict(zip(FAMILIES, corners[i], strict=True))), *stress) for i in picked.tolist()
        ]
        self.references = [self.metrics(in_service), self.metrics(baseline)]

    def of(self, config: Controller) -> Judged:
        """Everything that is wrong is not looked for: the first thing that is unsafe is enough."""
        unguarded = self._wrong(config, [self.truth] * len(self.cases), self.cases, self.line.control.latency_s)
        if unguarded:
            unsafe = self.unsafe(config)
            return Judged(unsafe, False, unguarded, None, unguarded)
        metrics = self.metrics(config)
        why = self._worse(metrics) or self._without_margin(config)
        return Judged("", not why, why, metrics)

    def unsafe(self, config: Controller) -> str:
        """On the truth as it is, in what the loop lets."""
        latency_s = self.line.control.latency_s
        for b, case in enumerate(self.cases):
            if self._wrong_in(config, self.truth, case, latency_s, b):
                reason = self._wrong_in(config, self.truth, self.lets(config, case), latency_s, b)
                if reason:
                    return f"{case.name}: {reason}"
        return ""

    def metrics(self, config: Controller) -> Metrics:
        cases = self.measuring
        found = self._run(config, [self.truth] * len(cases), cases, self.line.control.latency_s)
        rmse, names = np.sqrt(found.squared_n2.sum(axis=1)).tolist(), [case.name for case in cases]
        return Metrics(
            dict(zip(names, rmse, strict=True)),
            dict(zip(names, map(_overshoot_pct, found.beyond_n, cases), strict=True)),
            dict(zip(names, found.settled_s.max(axis=1).tolist(), strict=True)),
        )

    def _without_margin(self, config: Controller) -> str:
        cases = [self.cases[i] for i in MARGIN_CASES]
        later = self._wrong(
            config, [self.truth] * len(cases), cases, self.line.control.latency_s + EXTRA_DELAY_S
        )  # fmt: skip
        if later:
            return f"{1e3 * EXTRA_DELAY_S:g} ms later: {later}"
        if isinstance(config, MpcConfig):  # it takes its time: on the truth alone
            wrong = self._wrong(config, [self.stressed] * len(cases), cases, self.line.control.latency_s)
            return f"stressed: {wrong}" if wrong else ""
        truths = [one for one in self.around for _ in cases]
        wrong = self._wrong(config, truths, cases * len(self.around), self.line.control.latency_s)
        return f"stressed: {wrong}" if wrong else ""

    def _worse(self, own: Metrics) -> str:
        """Why it is no improvement; empty where it is one."""
        gate = self.line.gate
        for other in self.references:
            for name, floor in (
                ("rmse_n", gate.tolerance_n),
                ("overshoot_pct", gate.tolerance_overshoot_pct),
                ("settling_s", gate.tolerance_settling_s),
            ):
                before = getattr(other, name)
                for case, mine in getattr(own, name).items():
                    if mine > before[case] + TOLERATED * max(floor, gate.tolerance_share * before[case]):
                        return f"{name} in {case} is {mine:.3g}, it was {before[case]:.3g}"
        in_service = self.references[0].rmse_n
        better = any(mine < (1.0 - BETTER) * in_service[case] for case, mine in own.rmse_n.items())
        return "" if better else "nothing is better by 3 %"

    def _run(self, config: Controller, truths: list[Truth], cases: list[Case], latency_s: float) -> Found:
        return simulated(config, truths, cases, self.line.limits, self.seed, latency_s=latency_s)

    def _wrong(self, config: Controller, truths: list[Truth], cases: list[Case], latency_s: float) -> str:
        """One case at a time: the first that is unsafe ends it."""
        for b, (truth, case) in enumerate(zip(truths, cases, strict=True)):
            if reason := self._wrong_in(config, truth, case, latency_s, b):
                return f"{case.name}: {reason}"
        return ""

    def _wrong_in(self, config: Controller, truth: Truth, case: Case, latency_s: float, b: int) -> str:
        found = self._alone(config, truth, case, latency_s, b)
        return self._reason(found) or self.too_fast(config, truth, case, latency_s, b, found)

    def _alone(self, config: Controller, truth: Truth, case: Case, latency_s: float, b: int) -> Found:
        return simulated(config, [truth], [case], self.line.limits, self.seed + b, latency_s=latency_s,
                         stop_outside=True)  # fmt: skip

    def too_fast(self, config: Controller, truth: Truth, case: Case, latency_s: float, b: int, found: Found) -> str:
        """Whether a roller runs so fast that torque goes off, in moves so small that the loop would not refuse them.

        Cut torques keep a large move from making rollers as fast as it would: how small to make it follows from little.
        """
        most = self.roller_most_m_per_s
        if found.roller_m_per_s.max() <= most:
            return ""
        little = case.smaller(LITTLE)
        ahead = float(self._alone(config, truth, little, latency_s, b).roller_m_per_s.max()) - _web_m_per_s(little)
        none = _web_m_per_s(case.smaller(0.0))
        whole = _web_m_per_s(case) + max(ahead, 0.0) / LITTLE
        share = (FORESEEN * most - none) / (whole - none) if whole > none else 1.0
        less = case.smaller(float(np.clip(share, LITTLE * LITTLE, 1.0)))
        fastest = float(self._alone(config, truth, less, latency_s, b).roller_m_per_s.max())
        return "" if fastest <= most else f"a roller runs at {fastest:.3f} m/s"

    def _reason(self, found: Found) -> str:
        gate, limits = self.line.gate, self.line.limits
        least, most = float(found.least_n.min()), float(found.most_n.max())
        if not np.isfinite(most):
            return "it runs away"
        if least < limits.tension_min_n or most > limits.tension_max_n:
            return f"tension from {least:.1f} to {most:.1f} N"
        for name, value, limit in (
            ("swings by {:.2f} N", found.swing_n.max(), gate.tail_oscillation_max_n),
            ("is off by {:.2f} N", found.error_n.max(), gate.tail_error_max_n),
            ("chatters by {:.2f} Nm", found.chatter_nm.max(), gate.chatter_max_nm),
        ):
            if not value < limit:
                return name.format(float(value))
        return ""


def _web_m_per_s(case: Case) -> float:
    return float(np.abs(case.unwind_m_per_s).max())


def _overshoot_pct(beyond_n: FloatArray, case: Case) -> float:
    """Of the worst span that steps; where none does, of the set-points. What a step does to others is in the RMSE."""
    first, last = case.tension_n[0], case.tension_n[-1]
    steps = first != last
    share = beyond_n[steps] / np.abs(last - first)[steps] if steps.any() else beyond_n / last
    return float(100.0 * share.max())


def unsafe_experiment(
    experiment: Experiment,
    line: Line,
    truth: Truth,
    config: Controller,
    tension_n: list[float],
    speed_m_per_s: float,
    seed: int,
) -> str:
    """What goes wrong on the true line while it runs from here under `config`; empty: nothing.

    The speed goes where a leg wants it at the rate of the line's moves. The abort condition is not relied on.
    """
    base, h = np.array(tension_n), line.control.period_s
    rows = list(course(experiment, base, speed_m_per_s, h))
    tensions = np.array([tension for tension, _ in rows])
    speeds, now, reach = np.empty(len(rows)), speed_m_per_s, line.moves.speed_rate_m_per_s2 * h
    for k, (_, goal) in enumerate(rows):
        now += min(max(goal - now, -reach), reach)
        speeds[k] = now
    case = Case(experiment.name, tensions, speeds, np.zeros_like(tensions), 0, 1)
    found = simulated(config, [truth], [case], line.limits, seed, latency_s=line.control.latency_s, stop_outside=True)
    least, most = float(found.least_n.min()), float(found.most_n.max())
    if not np.isfinite(most):
        return "it runs away"
    if least < line.limits.tension_min_n or most > line.limits.tension_max_n:
        return f"tension from {least:.1f} to {most:.1f} N"
    fastest = float(found.roller_m_per_s.max())
    return "" if fastest <= ROLLERS * line.limits.speed_max_m_per_s else f"a roller runs at {fastest:.3f} m/s"


def model_error(model: LineModel, truth: Truth) -> float:
    """The greatest error, as a fraction, of what decides how a line moves: EA/L, R/J, f/J, R^2/J, of any roller."""
    p = model.parameters
    radius, inertia = np.array(p.radius_m), np.array(p.inertia_kg_m2)
    pairs = (
        (p.stiffness_n / np.array(p.length_m), truth.stiffness_n / truth.length_m),
        (radius / inertia, truth.radius_m / truth.inertia_kg_m2),
        (np.array(p.friction_nms_per_rad) / inertia, truth.friction_nms_per_rad / truth.inertia_kg_m2),
        (radius**2 / inertia, truth.radius_m**2 / truth.inertia_kg_m2),
    )
    return max(float(np.abs(found / true - 1.0).max()) for found, true in pairs)
