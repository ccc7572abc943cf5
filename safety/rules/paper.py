"""The paper's filter as it is written, reported beside the verdict: it decides nothing.

    C_safe       |u| <= u_max and |du/dt| <= du_max at all times, of what the law asks for
    P_improved   ||P_proposed|| < ||P_current||, P = [e_RMSE, OS, t_s] (eqs. rmse, overshoot, settling_time)
    S_robust     max over ||dtheta|| <= eps of ||y - y_ref||_inf < delta_tol

on the model at its mean, for the course "tension". eps and delta_tol, which the paper leaves open: the gate's corners
of the model, and the largest permitted step with the tolerated overshoot of the paper's convergence criterion.
"""

from dataclasses import replace
from math import inf

import numpy as np

from gateway.control.judged_courses import corner_courses, improvement_courses
from gateway.control.rollout import Course, plants_of_thetas, simulate
from gateway.core.controller_laws import MpcConfig
from gateway.core.line_limits import torque_limits_nm
from gateway.core.verdict import RuleFinding
from safety import programme
from safety.case import Case
from safety.findings import at_most, told
from safety.performance import Figures, performances
from safety.simulated import holdable, judged_of, setup_of

RULE = "paper"
CONVERGED_OVERSHOOT = 0.2  #: of a step: eq. convergence_criteria
CORNERS, CORNERS_MPC = 8, 2  #: a predictive controller takes its time


def check(case: Case) -> list[RuleFinding]:
    """C_safe, P_improved, S_robust, and their conjunction."""
    if programme.fails_in_small(case):
        names = ("C_safe", "P_improved", "S_robust", "approve")
        return [
            told(f"paper: {name}", False, "not looked at: it is refused for its small moves already") for name in names
        ]
    found = [_safe(case), _improved(case), _robust(case)]
    passed = all(one.passed for one in found)
    return [*found, told("paper: approve", passed, f"the paper's filter would {'approve' if passed else 'reject'} it")]


def _safe(case: Case) -> RuleFinding:
    """Torque and rate of the loop on the mean model, nothing limited: what the law asks for."""
    limits, period_s = case.line.limits, case.line.control.period_s
    setup = setup_of(case.line, case.noise, case.seed, 0.0)
    free = replace(setup, torque_nm=inf, torque_rate_nm_per_s=inf)
    torque = rate = 0.0
    for course in improvement_courses(judged_of(case)).values():
        run = simulate(case.controller, plants_of_thetas([case.believed]), course, free)
        # Of numpy: Python's own maximum passes over what is no number.
        torque = float(np.maximum(torque, run.torque_max_nm.max()))
        rate = float(np.maximum(rate, run.torque_step_max_nm.max() / period_s))
    share = float(np.maximum(torque / limits.torque_nm, rate / limits.torque_rate_nm_per_s))
    text = (
        f"C_safe: the law asks for up to {torque:.1f} Nm and {rate:.0f} Nm/s; allowed: {limits.torque_nm:g} Nm and "
        f"{limits.torque_rate_nm_per_s:g} Nm/s"
    )
    return at_most("paper: C_safe", share, 1.0, "", text)


def _improved(case: Case) -> RuleFinding:
    found = performances(case)
    course = "tension" if "tension" in found["proposed"] else next(iter(found["proposed"]))
    now, proposed = _norm(found["in service"][course]), _norm(found["proposed"][course])
    text = f"P_improved: ||P|| is {proposed:.3g} in {course}; allowed: below {now:.3g}, as in service"
    return _below("paper: P_improved", proposed, now, "", text)


def _norm(figures: Figures) -> float:
    """Of what has units of its own, as the paper takes it."""
    return float(np.linalg.norm([figures.rmse_n, figures.overshoot_pct, figures.settling_s]))


def _robust(case: Case) -> RuleFinding:
    name, one = next(reversed(corner_courses(judged_of(case)).items()))
    course = one.course
    most = CORNERS_MPC if isinstance(case.controller, MpcConfig) else CORNERS
    thetas = holdable(case.corners[:most], course, torque_limits_nm(case.line))
    if not thetas:
        return told("paper: S_robust", False, "S_robust: no corner is held by the torque")
    setup = setup_of(case.line, case.noise, case.seed, 0.0)
    run = simulate(case.controller, plants_of_thetas(thetas), course, setup, record=True)
    error = float(np.nan_to_num(np.abs(run.tension_n - course.tension_n), nan=np.inf).max())
    limit = _tolerated(course)
    text = f"S_robust: tension is up to {error:.1f} N from its set-point ({name}); allowed: below {limit:.1f} N"
    return _below("paper: S_robust", error, limit, "N", text)


def _below(rule: str, value: float, limit: float, unit: str, text: str) -> RuleFinding:
    """Passed below `limit`, as the paper has it, and not at it."""
    return at_most(rule, value, limit, unit, text).model_copy(update={"passed": value < limit})


def _tolerated(course: Course) -> float:
    """The largest step and its overshoot; where there is none, the same share of the set-point."""
    step = float(np.abs(np.diff(course.tension_n, axis=0)).max(initial=0.0))
    return (1.0 + CONVERGED_OVERSHOOT) * step if step else CONVERGED_OVERSHOOT * float(course.tension_n.min())
