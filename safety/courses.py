"""What the figures of a verdict are figures of: tensions over time at the mean of what is believed, to be drawn.

The same plants and courses as in `performance`, without noise.
"""

from collections.abc import Callable

import numpy as np

from gateway.control.judged_courses import Judged, improvement_courses, way_of_moves
from gateway.control.rollout import plants_of_thetas, simulate
from gateway.control.shaped_run import follow
from gateway.core.controller import Controller
from gateway.core.courses import MOST_NUMBERS, MOST_POINTS, Courses, Drawn, DrawnCourse
from gateway.core.deployment import Region
from gateway.core.judge_context import JudgeContext
from gateway.core.line import Line
from gateway.core.proposal import parse_proposal, proposal_hash
from gateway.core.signals import FloatArray
from safety.case import Case
from safety.performance import QUIET
from safety.simulated import setup_of

Run = Callable[[Controller], FloatArray]  #: tensions (k, n); nan from where the line has run away


def courses_of(payload: bytes, context: JudgeContext, line: Line, region: Region) -> Courses:
    """Of a proposal of another controller that was accepted in this context for `region`.

    Raises ProposalRefused, and TypeError where it is of another kind.
    """
    proposal = parse_proposal(payload, line.gate.proposal_max_bytes)
    case = Case(line, context, proposal, proposal_hash(proposal), (), 0)
    configs: dict[Drawn, Controller] = {"in service": context.in_service, "proposed": case.controller}
    with np.errstate(all="ignore"):  # numbers that run away are told as none
        runs = _runs(case, _judged(case, region))
        most = min(MOST_POINTS, MOST_NUMBERS // (3 * line.n * len(runs)))
        return Courses(courses=[_drawn(name, *run, configs, case, most) for name, run in runs.items()])


def _judged(case: Case, region: Region) -> Judged:
    """What it was judged for, without the recordings that have shown how far the model holds."""
    limits = case.line.limits
    speed, tension, step = region.speed_max_m_per_s, region.tension_step_max_n, region.speed_step_max_m_per_s
    return Judged(
        case.line,
        case.tension_n,
        limits.speed_max_m_per_s if speed is None else speed,
        limits.tension_step_max_n if tension is None else tension,
        limits.speed_step_max_m_per_s if step is None else step,
    )


def _runs(case: Case, judged: Judged) -> dict[str, tuple[FloatArray, Run]]:
    """By scenario the set-points (k, n), and how a configuration goes through it."""
    plants, quiet = plants_of_thetas([case.believed]), setup_of(case.line, QUIET, 0, 0.0)
    found: dict[str, tuple[FloatArray, Run]] = {}
    for name, course in improvement_courses(judged).items():
        found[name] = (
            course.tension_n,
            lambda config, course=course: simulate(config, plants, course, quiet, record=True).tension_n[0],
        )
    if (way := way_of_moves(judged)) is not None:
        found["moves"] = (way.course(quiet.period_s).tension_n, lambda config: follow(config, plants, way, quiet))
    return found


def _drawn(
    name: str, setpoint_n: FloatArray, run: Run, configs: dict[Drawn, Controller], case: Case, most: int
) -> DrawnCourse:
    every = 1 if len(setpoint_n) <= most else -(-len(setpoint_n) // (most // 2))
    times = range(len(setpoint_n))
    if every > 1:
        times = [k + half for k in times[::every] for half in (0, every // 2)]
    return DrawnCourse(
        scenario=name,
        time_s=[round(k * case.line.control.period_s, 4) for k in times],
        setpoint_n=[[round(one, 3) for one in span] for span in _thinned(setpoint_n, every).T.tolist()],
        tension_n={whose: _told(_thinned(run(config), every)) for whose, config in configs.items()},
    )


def _thinned(values: FloatArray, every: int) -> FloatArray:
    """Of each `every` rows two: least and greatest of each column, in the order they came in. So no peak is lost.

    nan from where a column is; of the stretch in which it begins the first of the two is left.
    """
    if every == 1:
        return values
    count = -(-len(values) // every)
    last = np.repeat(values[-1:], count * every - len(values), axis=0)
    buckets = np.concatenate([values, last]).reshape(count, every, -1)
    known = np.isfinite(buckets)
    least = np.argmin(np.where(known, buckets, np.inf), axis=1)
    greatest = np.argmax(np.where(known, buckets, -np.inf), axis=1)
    rows = np.stack([np.minimum(least, greatest), np.maximum(least, greatest)], axis=1)
    found = np.take_along_axis(buckets, rows, axis=1)
    found[:, 1][~known.all(axis=1)] = np.nan
    return found.reshape(2 * count, -1)


def _told(tension_n: FloatArray) -> list[list[float | None]]:
    return [[round(one, 3) if np.isfinite(one) else None for one in span] for span in tension_n.T.tolist()]
