"""Whether rollers stay below the speed at which the envelope takes torque off, in steps that the loop lets happen.

A roller runs ahead by L/EA dT/dt while it tensions its span, and by as much again for each span before it: on a slow
line that is more than its own speed. With an accepted model the loop foresees it and refuses such a step
(`gateway.loop.guard`). A configuration is looked at on the corners under stress, in whole steps; where these are too
fast, in steps as large as the model lets them be. Before that nobody foresees anything: the region of a first
configuration has the steps that pass.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from gateway.control.judged_courses import SLOW_ALONE, CornerCourse, CornerCourses
from gateway.control.mpc_linear import unconstrained
from gateway.control.rollout import Rollouts, plants_of_thetas, simulate
from gateway.core.controller_laws import MpcConfig
from gateway.core.line_limits import torque_limits_nm
from gateway.core.line_scales import line_scales
from gateway.core.theta import Noise
from gateway.core.verdict import RuleFinding
from safety import programme
from safety.case import Case
from safety.corner_runs import courses_through, in_largest_steps, rollouts
from safety.findings import at_most, told
from safety.limits import envelope_limits
from safety.simulated import held, judged_of, setup_of, stressed

RULE = "roller speed"
SPEED_CHANGE = "speed change"  #: the course whose steps are of the speed; those of the others are of tensions
SMALL = 1.0 / 16.0  #: of the largest step: at first nothing is cut
TRIES = 3
BELOW = 0.97  #: of the step that the one before lets expect
JUDGED = 0.95  #: of the speed at which torque goes off: corners are not all that the line may be
LASTING = 30.0  #: moments of a change: by then rollers run as fast as the web again, or never
QUIET = Noise(0.0, 0.0, 0.0)

Fastest = Callable[[str, CornerCourse], float]  #: the greatest speed of any roller in a course of this name, either way


@dataclass(frozen=True)
class Let:
    """By course: the share of its largest step that passes on the corners, or that the loop lets; nan: none does."""

    share: dict[str, float]
    fastest_m_per_s: dict[str, float]  #: with that step, on the corners

    def of_tension(self) -> float:
        return min((share for name, share in self.share.items() if name != SPEED_CHANGE), default=1.0)

    def of_speed(self) -> float:
        return self.share[SPEED_CHANGE]


def check(case: Case) -> list[RuleFinding]:
    """The fastest roller on the corners: a first configuration's as the monitor has it, else where torque goes off."""
    if programme.fails_in_small(case):
        return [told(RULE, False, "not looked at: it is refused for its small moves already")]
    found, limits = steps_let(case), envelope_limits(case.line)
    if not found.share or not all(np.isfinite(list(found.share.values()))):
        return [told(RULE, False, _too_quick(case, "no step at all"))]
    alone = [share for name, share in found.share.items() if SLOW_ALONE in name]
    single = case.tension_step_n * min(alone, default=1.0)
    # A law that does not let even a small step of one span on a slow line is too quick for the line.
    if single < min(line_scales(case.line).tension_n, case.tension_step_n):
        return [told(RULE, False, _too_quick(case, f"a step of {single:.2g} N of one span"))]
    name, value = max(found.fastest_m_per_s.items(), key=lambda pair: pair[1])
    if value == np.inf:
        return [told(RULE, False, f"on a plant that the line may be rollers run away, or none is held ({name})")]
    allowed = limits.roller_speed_watched_m_per_s if case.first else JUDGED * limits.roller_speed_m_per_s
    text = (
        f"a roller runs at up to {value:.3g} m/s ({name}, {found.share[name]:.0%} of the largest step); allowed: "
        f"{allowed:.3g} m/s, of {limits.roller_speed_m_per_s:.3g} m/s at which torque goes off"
    )
    return [at_most(RULE, value, allowed, "m/s", text)]


def steps_let(case: Case) -> Let:
    """Computed once for a case."""
    return case.once(_steps_let)


def _steps_let(case: Case) -> Let:
    """Whole steps first, on the corners. What is too fast there is looked at as the loop would let it."""
    limits, courses = envelope_limits(case.line), _courses(case, 1.0)
    foreseen, on_corners = _looks(case)
    whole_steps = _in_whole_steps(case, courses, on_corners)
    passes = limits.roller_speed_watched_m_per_s if case.first else JUDGED * limits.roller_speed_m_per_s
    share, fastest = dict.fromkeys(courses, 1.0), {name: whole_steps.get(name, np.inf) for name in courses}
    for name, one in courses.items():
        if fastest[name] <= passes:
            continue
        if case.first:  # nobody foresees anything: corners are all there is to go by
            share[name], fastest[name] = _smaller(case, name, one, on_corners, passes)
            continue
        allowed = limits.roller_speed_in_step_m_per_s(float(one.course.unwind_speed_m_per_s.max()))
        if not foreseen(name, one) <= allowed:
            share[name], _ = _smaller(case, name, one, foreseen, allowed)
        if share[name] < 1.0:
            fastest[name] = on_corners(name, _courses(case, share[name])[name])
    return Let(share, fastest)


def _in_whole_steps(case: Case, courses: CornerCourses, on_corners: Fastest) -> dict[str, float]:
    """By course, on the corners; in most cases rule `corners` has simulated them already."""
    if not isinstance(case.controller, MpcConfig):
        return {name: _greatest(found) for name, found in in_largest_steps(case).items()}
    if case.first:  # a programme is looked at on some corners only, which is too few where nobody foresees anything
        return {name: on_corners(name, one) for name, one in courses.items()}
    return {name: _greatest(found) for name, found in programme.by_itself(case).items()}


def _smaller(case: Case, name: str, whole: CornerCourse, fastest: Fastest, allowed: float) -> tuple[float, float]:
    """Share of a step that is too large, and the speed that rollers reach with it; nan and infinite: there is none.

    Cut torques keep a large step from moving rollers as fast as it would: the share follows from a small one.
    """
    web = float(whole.course.unwind_speed_m_per_s.max())
    share, value = SMALL, fastest(name, _courses(case, SMALL)[name])
    for _ in range(TRIES):
        share = min(share * BELOW * (allowed - web) / (value - web), BELOW)  # the whole step has been found too large
        if not share > 0.0:  # nan, too: a line that runs away
            break
        value = fastest(name, _courses(case, share)[name])
        if value <= allowed:
            return share, value
    return np.nan, np.inf


def _courses(case: Case, share: float) -> CornerCourses:
    """With a share of the largest steps; as long as rollers run ahead."""
    judged = judged_of(case)
    smaller = replace(
        judged,
        tension_step_n=share * judged.tension_step_n,
        speed_step_m_per_s=share * judged.speed_step_m_per_s,
    )
    return courses_through(case, smaller, LASTING * line_scales(case.line).moment_s, 0.0)


def _looks(case: Case) -> tuple[Fastest, Fastest]:
    """As the loop foresees it, on the mean; and on the corners."""
    config, corners = case.controller, [stressed(theta, case.line.gate) for theta in case.corners]
    law = unconstrained(config) if isinstance(config, MpcConfig) else config
    mean, setup = plants_of_thetas([case.believed]), setup_of(case.line, QUIET, case.seed, 0.0)

    def on_corners(name: str, one: CornerCourse) -> float:
        kept = held(corners, one, torque_limits_nm(case.line))
        return _greatest(rollouts(case.line, law, kept, one.course, case.stress_noise, case.seed)) if kept else np.inf

    if isinstance(config, MpcConfig) and not case.first:  # under its limits it goes otherwise than without them
        return (
            lambda name, one: _greatest(simulate(config, mean, one.course, setup)),
            lambda name, one: max(map(_greatest, programme.in_courses(case, {name: one}).values()), default=np.inf),
        )
    return lambda name, one: _greatest(simulate(law, mean, one.course, setup)), on_corners


def _greatest(found: Rollouts) -> float:
    """Infinite where one is no number: a maximum over courses would pass over it."""
    greatest = float(found.roller_speed_max_m_per_s.max())
    return np.inf if np.isnan(greatest) else greatest


def _too_quick(case: Case, what: str) -> str:
    limits = envelope_limits(case.line)
    return (
        f"{what} keeps rollers below {limits.roller_speed_watched_m_per_s:.3g} m/s, of "
        f"{limits.roller_speed_m_per_s:.3g} m/s at which torque goes off: a calmer law is needed"
    )
