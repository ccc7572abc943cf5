"""Where a rollout begins, and what its law is told along the course."""

import numpy as np

from gateway.control.deviation import Deviation
from gateway.control.reference import Steady
from gateway.control.rollout_terms import Course, Plants
from gateway.core.controller import Controller
from gateway.core.signals import FloatArray


def start(plants: Plants, course: Course) -> tuple[FloatArray, FloatArray]:
    """State (b, 2n) and torques (b, n) of each plant's own equilibrium at the beginning of the course.

    Coulomb friction is in it. An eccentric roller has none: it begins as if it were round.
    """
    tension = np.tile(course.tension_n[0], (plants.count, 1))
    before, after = plants.boundary_n[:, :1], plants.boundary_n[:, 1:]
    # Eq. reference_velocity and dv/dt = 0, for all plants at once.
    ratios: FloatArray = (plants.stiffness_n - np.hstack((before, tension[:, :-1]))) / (plants.stiffness_n - tension)
    speeds: FloatArray = course.unwind_speed_m_per_s[0] * np.cumprod(ratios, axis=1)
    pulled: FloatArray = plants.radius_m * (np.hstack((tension[:, 1:], after)) - tension)
    torques: FloatArray = plants.friction_nms_per_rad * speeds / plants.radius_m - pulled
    if plants.effects is not None:
        torques += plants.effects.coulomb_nm * np.sign(speeds)
    return np.hstack((tension, speeds)), torques


def references(config: Controller, course: Course) -> FloatArray:
    """[T_ref; v_ref; u_ref] (k, 3n) as the law has them."""
    deviation = Deviation(config.feedforward, config.draw_spans, config.period_s, config.latency_s)
    asked = np.column_stack((course.tension_n, course.unwind_speed_m_per_s))
    # What stands for a while is computed once.
    begins = np.flatnonzero(np.concatenate(([True], (asked[1:] != asked[:-1]).any(axis=1))))
    rows: list[FloatArray] = []
    for tension, unwind in zip(course.tension_n[begins], course.unwind_speed_m_per_s[begins].tolist(), strict=True):
        reference = Steady(tension)
        state = deviation.state(reference, unwind)
        rows.append(np.concatenate((state, deviation.torque(reference, unwind, 0))))
    return np.repeat(np.array(rows), np.diff(np.append(begins, course.periods)), axis=0)
