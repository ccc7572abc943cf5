"""Predictive control on the corners: by the law that it is where no limit is reached on all of them, by itself on some.

Its programme takes a tenth of a millisecond to a millisecond a period, a thousand times as long as a linear law.
"""

from dataclasses import replace
from math import inf

import numpy as np

from gateway.control.judged_courses import CornerCourses, programme_courses
from gateway.control.mpc_linear import unconstrained
from gateway.control.rollout import Rollouts, simulate
from gateway.core.controller_laws import MpcConfig
from gateway.core.line_limits import chatter_limit_nm, tension_bands_n
from gateway.core.line_scales import line_scales
from safety.case import Case
from safety.corner_runs import corners_held
from safety.simulated import judged_of, plants_under_stress, setup_of

WHOLE = 4  #: corners: those on which the law without limits does worst in small moves
LASTING, TAIL = 100.0, 30.0  #: moments that changes last which the programme makes, and their tail


def small_courses(case: Case) -> CornerCourses:
    """In steps that are small on this line, so that no limit is reached."""
    judged, scales = judged_of(case), line_scales(case.line)
    small = replace(
        judged,
        tension_step_n=min(judged.tension_step_n, scales.tension_n),
        speed_step_m_per_s=min(judged.speed_step_m_per_s, scales.speed_m_per_s),
    )
    return programme_courses(small)


def in_small(case: Case) -> dict[str, Rollouts]:
    """By course, on all corners that can be held there; computed once for a case."""
    return case.once(_in_small)


def fails_in_small(case: Case) -> bool:
    """Whether a programme is refused for its small moves: then what takes it many seconds decides nothing.

    What is no number is refused. Where no corner is held there are no moves, and rule `corners` has refused it.
    """
    if not isinstance(case.controller, MpcConfig):
        return False
    return case.once(_fails_in_small)


def by_itself(case: Case) -> dict[str, Rollouts]:
    """By course, of the largest steps, on `WHOLE` corners; computed once for a case."""
    return case.once(_by_itself)


def in_courses(case: Case, courses: CornerCourses) -> dict[str, Rollouts]:
    """The programme itself, on the corners that are the worst for each of `courses`; on one where they are shared.

    No course that torque holds on no corner.
    """
    setup = setup_of(case.line, case.stress_noise, case.seed, case.line.gate.stress_late_share)
    found: dict[str, Rollouts] = {}
    for name, one in courses.items():
        if not corners_held(case)[name]:
            continue
        small = in_small(case)[name]
        badness = small.tail_swing_n.max(axis=1) + small.chatter_nm.max(axis=1) + small.beyond_n.max(axis=1)
        order: list[int] = np.argsort(np.nan_to_num(badness, nan=inf))[::-1][: 1 if one.shared else WHOLE].tolist()
        kept = corners_held(case)[name]
        plants = plants_under_stress([kept[i] for i in order], case.line.gate, case.seed)
        found[name] = simulate(case.controller, plants, one.course, setup)
    return found


def _fails_in_small(case: Case) -> bool:
    (low, high), gate, spans = tension_bands_n(case.line), case.line.gate, case.tension_spans
    return not all(
        (found.tension_min_n >= low).all()
        and (found.tension_max_n <= high).all()
        and found.tail_swing_n[:, spans].max() <= gate.tail_oscillation_max_n
        and found.tail_error_n[:, spans].max() <= gate.tail_error_max_n
        and found.chatter_nm.max() <= chatter_limit_nm(case.line)
        for found in in_small(case).values()
    )


def _by_itself(case: Case) -> dict[str, Rollouts]:
    moment_s = line_scales(case.line).moment_s
    return in_courses(case, programme_courses(judged_of(case), LASTING * moment_s, TAIL * moment_s))


def _in_small(case: Case) -> dict[str, Rollouts]:
    config = case.controller
    if not isinstance(config, MpcConfig):
        raise TypeError(f"{config.kind} has no programme")
    law, gate = unconstrained(config), case.line.gate
    setup = setup_of(case.line, case.stress_noise, case.seed, gate.stress_late_share)
    held = corners_held(case)
    return {
        name: simulate(law, plants_under_stress(held[name], gate, case.seed), one.course, setup)
        for name, one in small_courses(case).items()
        if held[name]
    }
