"""Whether an experiment may move the line: with the controller in service, on the corners of what the line may be.

No valid model is needed: without one the corners are those of the line's file.
"""

from collections.abc import Iterator

import numpy as np

from gateway.control.prediction import Unpredictable
from gateway.control.rollout import Course
from gateway.core.controller_laws import MpcConfig
from gateway.core.experiment import Experiment, course, reasons_against
from gateway.core.line_limits import tension_bands_n, torque_limits_nm
from gateway.core.line_scales import line_scales
from gateway.core.theta import Theta
from gateway.core.verdict import RuleFinding
from safety.believed import prior_corners
from safety.case import Case
from safety.corner_runs import rollouts
from safety.findings import at_least, at_most, told
from safety.limits import envelope_limits
from safety.rules.validity import check as check_validity
from safety.simulated import holdable, stressed

RULE, LIMITS_RULE, ABORT_RULE = "experiment", "experiment: limits", "experiment: abort"
LEG = 400.0  #: moments of a leg are simulated; what comes after is more of the same
CORNERS_MPC, LEG_MPC = 4, 125.0  #: with a predictive controller, which takes a millisecond a period


def check_limits(case: Case) -> list[RuleFinding]:
    """Set-points, steps, rates, speeds and duration against the line's limits."""
    state = case.context.state
    reasons = reasons_against(case.experiment, case.line, case.tension_n, state.speed_m_per_s)
    if reasons:
        return [told(LIMITS_RULE, False, text) for text in reasons]
    return [told(LIMITS_RULE, True, f"it takes {case.experiment.duration_s:g} s within the limits of the line")]


def check_abort(case: Case) -> list[RuleFinding]:
    """It ends before a tension leaves its band, wherever the set-points stand."""
    limits, allowed_n = case.line.limits, case.experiment.abort.deviation_n
    low_n, high_n = tension_bands_n(case.line)
    most = float(np.minimum(case.tension_n - low_n, high_n - case.tension_n).min())
    text = (
        f"it is aborted when a tension is {allowed_n:g} N from where it stood; allowed: up to {most:g} N, which is the "
        f"nearest limit of {limits.tension_min_n:g} to {limits.tension_max_n:g} N"
    )
    return [at_most(ABORT_RULE, allowed_n, most, "N", text)]


def check_corners(case: Case) -> list[RuleFinding]:
    """Peak deviation on the worst corner, against the abort condition; tension against its band."""
    plants, where = _plants(case)
    asked = _course(case, case.experiment)
    kept = holdable([stressed(theta, case.line.gate) for theta in plants], asked, torque_limits_nm(case.line))
    if not kept:
        return [told(RULE, False, f"none of {len(plants)} {where} is held by the torque at these speeds: go slower")]
    if isinstance(case.context.in_service, MpcConfig):
        kept = kept[:CORNERS_MPC]
    found = rollouts(case.line, case.context.in_service, kept, asked, case.stress_noise, case.seed)
    low_n, high_n = tension_bands_n(case.line)
    below, above = (found.tension_min_n - low_n).min(axis=0), (high_n - found.tension_max_n).min(axis=0)
    span, other = int(below.argmin()), int(above.argmin())  # what is no number is the least of all
    least, most = float(low_n[span]), float(high_n[other])
    lowest, highest = float(found.tension_min_n[:, span].min()), float(found.tension_max_n[:, other].max())
    # Of numpy: Python's own maximum passes over what is no number, where it does not come first.
    away_n = np.maximum(case.tension_n - found.tension_min_n, found.tension_max_n - case.tension_n)
    deviation = float(away_n.max())
    abort_n = case.experiment.abort.deviation_n
    fastest, envelope = float(found.roller_speed_max_m_per_s.max()), envelope_limits(case.line)
    # The monitor watches it, too, with what noise adds.
    allowed = envelope.roller_speed_in_step_m_per_s(float(asked.unwind_speed_m_per_s.max()))
    on = f"on {len(kept)} {where}" + (f", {len(plants) - len(kept)} left out" if len(kept) < len(plants) else "")
    return [
        at_most(
            f"{RULE}: deviation", deviation, abort_n, "N",
            f"tension goes up to {deviation:.1f} N from where it stood ({on}); allowed: {abort_n:g} N, where it aborts",
        ),
        at_least(
            f"{RULE}: lowest tension", lowest, least, "N",
            f"tension falls to {lowest:.1f} N ({on}); allowed: down to {least:g} N",
        ),
        at_most(
            f"{RULE}: highest tension", highest, most, "N",
            f"tension rises to {highest:.1f} N ({on}); allowed: up to {most:g} N",
        ),
        at_most(
            f"{RULE}: roller speed", fastest, allowed, "m/s",
            f"a roller runs at up to {fastest:.3g} m/s ({on}); allowed: {allowed:.3g} m/s, of "
            f"{envelope.roller_speed_m_per_s:.3g} m/s at which torque goes off: smaller or slower moves",
        ),
    ]  # fmt: skip


def _plants(case: Case) -> tuple[list[Theta], str]:
    """Corners of the accepted model where recent data bear it out, else of the line's file."""
    if not case.first and _borne_out(case):
        return case.corners, "corners of the accepted model"
    return prior_corners(case.line, case.latency_s, case.seed), "corners of the line's file"


def _borne_out(case: Case) -> bool:
    try:
        return all(finding.passed for finding in check_validity(case))
    except (Unpredictable, ValueError, ArithmeticError):
        return False  # a model that cannot be looked at is none that may be believed


def _course(case: Case, experiment: Experiment) -> Course:
    """Its begin of each leg, with the way from speed to speed at the line's rate."""
    most = LEG_MPC if isinstance(case.context.in_service, MpcConfig) else LEG
    most_s = most * line_scales(case.line).moment_s
    legs = [leg.model_copy(update={"duration_s": min(leg.duration_s, most_s)}) for leg in experiment.legs]
    shorter = experiment.model_copy(update={"legs": legs})
    state, period_s = case.context.state, case.line.control.period_s
    asked = list(course(shorter, case.tension_n, state.speed_m_per_s, period_s))
    reach = case.line.moves.speed_rate_m_per_s2 * period_s
    speeds = list(_ramped(state.speed_m_per_s, [speed for _, speed in asked], reach))
    return Course(np.array([tension for tension, _ in asked]), np.array(speeds))


def _ramped(now: float, asked: list[float], reach: float) -> Iterator[float]:
    for goal in asked:
        now += min(max(goal - now, -reach), reach)
        yield now
