"""How good a configuration is at the mean of what is believed: the figures that are compared and promised."""

from dataclasses import dataclass
from math import inf, isfinite
from typing import Literal

import numpy as np

from gateway.control.judged_courses import Judged, improvement_courses, way_of_moves
from gateway.control.rollout import Course, Rollouts, Setup, plants_of_thetas, simulate
from gateway.control.shaped_run import Way, follow
from gateway.core.controller import Controller
from gateway.core.deployment import Region
from gateway.core.signals import FloatArray
from gateway.core.theta import Noise
from gateway.core.verdict import ScenarioFigures
from safety import programme
from safety.case import Case
from safety.simulated import compared_of, judged_of, setup_of

QUIET = Noise(0.0, 0.0, 0.0)
Whose = Literal["in service", "baseline", "proposed"]


@dataclass(frozen=True)
class Figures:
    """Of one configuration in one course. Infinite: it never settled, or the line ran away."""

    rmse_n: float
    overshoot_pct: float  #: of the worst span
    settling_s: float  #: of the worst span
    effort_n2m2s: float


LOST = Figures(inf, inf, inf, inf)
Performance = dict[str, Figures]  #: by the name of the course


def performance(config: Controller, case: Case, judged: Judged) -> Performance:
    """RMSE and effort under the model's noise; overshoot and settling without, where they are no matter of luck."""
    noisy = setup_of(case.line, case.noise, case.seed, 0.0)
    quiet = setup_of(case.line, QUIET, case.seed, 0.0)
    plants = plants_of_thetas([case.believed])
    found = {
        name: _figures(
            simulate(config, plants, course, noisy), simulate(config, plants, course, quiet), course, noisy, case
        )
        for name, course in improvement_courses(judged).items()
    }
    way = way_of_moves(judged)
    return found if way is None else found | {"moves": _moved(follow(config, plants, way, quiet), way, quiet, case)}


def _moved(tensions: FloatArray, way: Way, setup: Setup, case: Case) -> Figures:
    """The tracking error of a shaped move: what else there is to know, steps tell."""
    spans = case.tension_spans
    error: FloatArray = (tensions - way.course(setup.period_s).tension_n)[:, spans]
    return Figures(_sound(float(np.sqrt(np.sum(error**2) / len(error)))), 0.0, 0.0, 0.0)


def figures_of(case: Case) -> list[ScenarioFigures]:
    """Of all configurations and courses, as the verdict has them."""
    return [
        ScenarioFigures(
            scenario=name,
            configuration=whose,
            rmse_n=_finite(one.rmse_n),
            overshoot_pct=_finite(one.overshoot_pct),
            settling_s=_finite(one.settling_s),
            effort_n2m2s=_finite(one.effort_n2m2s),
        )
        for whose, found in performances(case).items()
        for name, one in found.items()
    ]


def performances(case: Case) -> dict[Whose, Performance]:
    """In service, baseline where there is one, proposed; computed once for a case."""
    return case.once(_performances)


def _performances(case: Case) -> dict[Whose, Performance]:
    context, judged = case.context, judged_of(case)
    found: dict[Whose, Performance] = {"in service": performance(context.in_service, case, judged)}
    if context.baseline is not None:
        same = context.baseline == context.in_service
        found["baseline"] = found["in service"] if same else performance(context.baseline, case, judged)
    found["proposed"] = _of_proposed(case, judged, found["in service"])
    return found


def _of_proposed(case: Case, judged: Judged, in_service: Performance) -> Performance:
    """In the same courses."""
    if programme.fails_in_small(case):
        return dict.fromkeys(in_service, LOST)
    return performance(case.controller, case, judged)


def beside_in_service(case: Case) -> tuple[Performance, Performance]:
    """What is in service and what is proposed, no further than the former was judged for: beyond it never runs."""
    return _beside("in service", case.context.in_service, case.context.region, case)


def beside_baseline(case: Case) -> tuple[Performance, Performance] | None:
    """The baseline and what is proposed, as far as the former is a measure; None: there is none."""
    context = case.context
    return None if context.baseline is None else _beside("baseline", context.baseline, context.baseline_region, case)


def _beside(whose: Whose, config: Controller, region: Region, case: Case) -> tuple[Performance, Performance]:
    known = compared_of(case, region)
    if known is None:
        found = performances(case)
        return found[whose], found["proposed"]
    reference = performance(config, case, known)
    return reference, _of_proposed(case, known, reference)


def _figures(noisy: Rollouts, quiet: Rollouts, course: Course, setup: Setup, case: Case) -> Figures:
    spans = case.tension_spans
    scale = _scale(course)[spans]
    return Figures(
        rmse_n=_sound(float(np.sqrt(noisy.squared_error_n2[0, spans].sum()))),
        overshoot_pct=_sound((100.0 * quiet.beyond_n[0, spans] / scale).max()),
        settling_s=_sound(setup.period_s * quiet.settled[0, spans].max()),
        effort_n2m2s=_sound(noisy.effort_n2m2s[0].sum()),
    )


def _scale(course: Course) -> FloatArray:
    """What an overshoot is a share of (n,): the step; the set-point where it does not step."""
    settled: FloatArray = course.settled_at_n
    step: FloatArray = np.abs(settled[0] - course.tension_n[0])
    return np.where(step > 0.0, step, settled[0])


def _sound(value: float) -> float:
    return inf if np.isnan(value) else float(value)


def _finite(value: float) -> float | None:
    return value if isfinite(value) else None
