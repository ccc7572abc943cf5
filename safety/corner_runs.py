"""A law on the corners of what is believed of the line, under stress, in the largest steps; once for all rules."""

from collections.abc import Sequence

from gateway.control.judged_courses import CornerCourses, Judged, corner_courses, programme_courses
from gateway.control.rollout import Course, Rollouts, simulate
from gateway.core.controller import Controller
from gateway.core.controller_laws import MpcConfig
from gateway.core.line import Line
from gateway.core.line_limits import torque_limits_nm
from gateway.core.theta import Noise, Theta
from safety.case import Case
from safety.simulated import held, judged_of, plants_under_stress, setup_of, stressed


def courses_of(case: Case) -> CornerCourses:
    """What the proposed law is put through on the corners. Computed once for a case."""
    return case.once(_courses_of)


def courses_through(
    case: Case, judged: Judged, lasting_s: float | None = None, tail_s: float | None = None
) -> CornerCourses:
    """Those of the proposed law's kind, for other steps and lasting otherwise."""
    courses = programme_courses if isinstance(case.controller, MpcConfig) else corner_courses
    return courses(judged, lasting_s, tail_s)


def corners_held(case: Case) -> dict[str, list[Theta]]:
    """By course of the largest steps: the corners that it is for and that torque holds. Computed once for a case."""
    return case.once(_corners_held)


def in_largest_steps(case: Case) -> dict[str, Rollouts]:
    """By course, on the corners that are held there; no course that none is. Computed once for a case."""
    return case.once(_in_largest_steps)


def rollouts(
    line: Line, config: Controller, thetas: Sequence[Theta], course: Course, noise: Noise, seed: int
) -> Rollouts:
    """On stressed plants."""
    setup = setup_of(line, noise, seed, line.gate.stress_late_share)
    return simulate(config, plants_under_stress(thetas, line.gate, seed), course, setup)


def _courses_of(case: Case) -> CornerCourses:
    return courses_through(case, judged_of(case))


def _corners_held(case: Case) -> dict[str, list[Theta]]:
    plants = [stressed(theta, case.line.gate) for theta in case.corners]
    courses = courses_of(case)
    return {name: held(plants, one, torque_limits_nm(case.line)) for name, one in courses.items()}


def _in_largest_steps(case: Case) -> dict[str, Rollouts]:
    courses = courses_of(case)
    return {
        name: rollouts(case.line, case.controller, kept, courses[name].course, case.stress_noise, case.seed)
        for name, kept in corners_held(case).items()
        if kept
    }
