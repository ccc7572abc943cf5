"""Closed loops for the rules: stressed plants, and how the loop is closed around them."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from gateway.control.judged_courses import CornerCourse, Judged
from gateway.control.rollout import Course, Plants, Setup, plants_of_thetas
from gateway.core.deployment import Region
from gateway.core.line import Gate, Line
from gateway.core.line_limits import has_own_torques, torque_limits_nm
from gateway.core.line_scales import longest_step_of, runaway_n
from gateway.core.signals import FloatArray
from gateway.core.theta import Noise, Theta
from gateway.core.web_model import equilibrium_torque, reference_speeds
from safety.case import Case

HOLDABLE = 0.95  #: of the torque limit, at equilibrium: beyond it nobody could bring the line back


def judged_of(case: Case) -> Judged:
    """What the proposal is judged for."""
    return Judged(case.line, case.tension_n, case.speed_max_m_per_s, case.tension_step_n, case.speed_step_m_per_s)


def compared_of(case: Case, region: Region) -> Judged | None:
    """How far what was judged for `region` is a measure for the proposal; None: in all that this is judged for."""
    judged = judged_of(case)
    known = judged.within(region)
    return None if known is judged else known


def stressed(theta: Theta, gate: Gate) -> Theta:
    """With the lag and the Coulomb friction that every simulated line has, where the model knows of less."""
    return replace(
        theta,
        coulomb_nm=np.maximum(theta.coulomb_nm, gate.stress_coulomb_nm),
        torque_lag_s=max(theta.torque_lag_s, gate.stress_torque_lag_s),
    )


def plants_under_stress(thetas: Sequence[Theta], gate: Gate, seed: int) -> Plants:
    """Stressed, and with rollers out of round."""
    return plants_out_of_round([stressed(theta, gate) for theta in thetas], gate, seed)


def plants_out_of_round(thetas: Sequence[Theta], gate: Gate, seed: int) -> Plants:
    """Each roller from another angle on."""
    phases = np.random.default_rng([seed, 2]).uniform(0.0, 2.0 * np.pi, (len(thetas), thetas[0].n))
    return plants_of_thetas(thetas, gate.stress_eccentricity, phases)


def setup_of(line: Line, noise: Noise, seed: int, late_share: float, longest_step_s: float | None = None) -> Setup:
    """The loop of the line; latencies are those of the plants, rounded up to whole steps of the integration.

    No step is longer than `longest_step_s`; without it as long as the line lets it be.
    """
    if longest_step_s is None:
        longest_step_s = longest_step_of(line)
    period_s, limits = line.control.period_s, line.limits
    return Setup(
        period_s=period_s,
        latency_s=0.0,
        substeps=max(1, round(np.ceil(period_s / longest_step_s - 1e-9))),
        torque_nm=torque_limits_nm(line) if has_own_torques(line) else limits.torque_nm,
        torque_rate_nm_per_s=limits.torque_rate_nm_per_s,
        runaway_n=runaway_n(line),
        tension_noise_n=noise.tension_n,
        speed_noise_m_per_s=noise.speed_m_per_s,
        acceleration_m_per_s1_5=noise.acceleration_m_per_s1_5,
        seed=seed,
        late_share=late_share,
    )


def holdable(thetas: Sequence[Theta], course: Course, torque_nm: float | FloatArray) -> list[Theta]:
    """Those that the torque holds wherever the course stands: beyond that no controller can, and none is to blame."""
    ends = [0, *(course.changes[1:] - 1).tolist()]
    asked = np.unique(np.column_stack([course.unwind_speed_m_per_s[ends], course.tension_n[ends]]), axis=0)
    greatest = float(np.max(torque_nm))
    return [theta for theta in thetas if _needed_nm(theta, asked, greatest / torque_nm) <= HOLDABLE * greatest]


def held(thetas: Sequence[Theta], one: CornerCourse, torque_nm: float | FloatArray) -> list[Theta]:
    """Those that a course is for and that the torque holds; where there are none of both, one that it holds."""
    return holdable(one.of(thetas), one.course, torque_nm) or holdable(thetas, one.course, torque_nm)[:1]


def _needed_nm(theta: Theta, asked: FloatArray, share: float | FloatArray) -> float:
    """The greatest torque at equilibria, each a row (1 + n,): the unwinder's speed, and set-points.

    `share` (n,): times what each drive's torque counts, where drives differ.
    0 where it is no number, so that the plant is not left out.
    """
    needed = 0.0
    for row in asked:
        tension = row[1:]
        speed = reference_speeds(theta.web, tension, float(row[0]))
        torque = equilibrium_torque(theta.web, tension, speed) + theta.coulomb_nm * np.sign(speed)
        most = float(np.abs(torque * share).max())
        if np.isnan(most):  # simulated, it is refused; left out, nobody would look at it
            return 0.0
        needed = max(needed, most)
    return needed
