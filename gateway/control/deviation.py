"""Errors and the torque that needs no errors: the feed-forward part of phi, shared by all laws.

The line is flat in its tensions and the unwinder's speed: once these are given with their derivatives, so are all
roller speeds and torques. From eq. web_tension_dynamics and its derivative, roller by roller down the line,

    v_i     = (L_i dT_i + (EA - T_{i-1}) v_{i-1}) / (EA - T_i)
    dv_i    = (L_i ddT_i + (EA - T_{i-1}) dv_{i-1} - dT_{i-1} v_{i-1} + dT_i v_i) / (EA - T_i)

and from eq. roller_velocity_dynamics  u_i = J_i/R_i dv_i + f_i/R_i v_i - R_i (T_{i+1} - T_i). For set-points that stand
this is the recursion of eq. reference_velocity and the equilibrium torque.
"""

from dataclasses import dataclass

import numpy as np

from gateway.control.reference import Motion, Reference
from gateway.core.controller_laws import Feedforward
from gateway.core.signals import FloatArray
from gateway.core.web_model import WebModel, speed_ratios, web_torque


@dataclass(slots=True)
class Measured:
    """The line now: tensions (n,) in N, roller speeds (n,) and the unwinder's speed in m/s."""

    tension_n: FloatArray
    speed_m_per_s: FloatArray
    unwind_speed_m_per_s: float


@dataclass(slots=True)
class Errors:
    """Measurement minus reference, (n,) each, and the torque that keeps the reference."""

    tension_n: FloatArray  #: 0 where there is no load cell
    speed_m_per_s: FloatArray
    controlled: FloatArray  #: what is integrated: tension error in N, speed error in m/s for a draw span
    torque_nm: FloatArray  #: u_ref, as it is due when the torque acts


class Deviation:
    """Reference and errors for a law's feed-forward, draw spans (from 0), period and latency."""

    def __init__(self, feedforward: Feedforward, draw_spans: list[int], period_s: float, latency_s: float) -> None:
        self.model = web_model(feedforward)
        self._period_s = period_s
        self._torque_ahead_s = latency_s + 0.5 * period_s  #: the middle of the time for which the torque acts
        self._draw = np.array(draw_spans, dtype=np.intp)
        ones = np.ones(self.model.n)
        self._setpoints = b""  #: that the next three belong to: set-points move rarely, the unwinder always
        self._speed_ratios: FloatArray = ones
        self._friction_nm_s_per_m: FloatArray = ones
        self._web_torque_nm: FloatArray = ones

    def errors(self, measured: Measured, reference: Reference) -> Errors:
        """What is wrong now."""
        speed, torque = self._reference(reference, measured.unwind_speed_m_per_s)
        tension_error = measured.tension_n - reference.tension_n
        speed_error = measured.speed_m_per_s - speed
        controlled = tension_error
        if self._draw.size:
            tension_error[self._draw] = 0.0
            controlled = tension_error.copy()
            controlled[self._draw] = speed_error[self._draw]
        return Errors(tension_error, speed_error, controlled, torque)

    def state(self, reference: Reference, unwind_speed_m_per_s: float, ahead_s: float = 0.0) -> FloatArray:
        """The reference [T_ref; v_ref] (2n,), `ahead_s` from now as far as it is known."""
        if not reference.moving:
            speed, _ = self._standing(reference.tension_n, unwind_speed_m_per_s)
            return np.concatenate((reference.tension_n, speed))
        motion = reference.ahead(ahead_s)
        return np.concatenate((motion.tension_n, flat(self.model, motion, unwind_speed_m_per_s)[0]))

    def torque(self, reference: Reference, unwind_speed_m_per_s: float, periods: int) -> FloatArray:
        """u_ref (n,) of the torque that is computed so many periods from now (before now: negative)."""
        if not reference.moving:
            return self._standing(reference.tension_n, unwind_speed_m_per_s)[1]
        motion = reference.ahead(self._torque_ahead_s + periods * self._period_s)
        return flat(self.model, motion, unwind_speed_m_per_s)[1]

    def _reference(self, reference: Reference, unwind_speed_m_per_s: float) -> tuple[FloatArray, FloatArray]:
        """Speeds now, and the torque for when it acts, (n,) each."""
        if not reference.moving:
            return self._standing(reference.tension_n, unwind_speed_m_per_s)
        speed, _ = flat(self.model, reference.ahead(0.0), unwind_speed_m_per_s)
        return speed, self.torque(reference, unwind_speed_m_per_s, 0)

    def _standing(self, setpoint_n: FloatArray, unwind_speed_m_per_s: float) -> tuple[FloatArray, FloatArray]:
        """`flat` for set-points (n,) that stand, with what depends on them alone kept."""
        model, setpoints = self.model, setpoint_n.tobytes()
        if setpoints != self._setpoints:
            self._speed_ratios = speed_ratios(model, setpoint_n)
            self._friction_nm_s_per_m = model.friction_nms_per_rad * self._speed_ratios / model.radius_m
            self._web_torque_nm = web_torque(model, setpoint_n)
            self._setpoints = setpoints
        speed = unwind_speed_m_per_s * self._speed_ratios
        return speed, unwind_speed_m_per_s * self._friction_nm_s_per_m - self._web_torque_nm


def web_model(feedforward: Feedforward) -> WebModel:
    """The model that a feed-forward is computed from."""
    return WebModel(
        stiffness_n=feedforward.stiffness_n,
        length_m=np.array(feedforward.length_m),
        radius_m=np.array(feedforward.radius_m),
        inertia_kg_m2=np.array(feedforward.inertia_kg_m2),
        friction_nms_per_rad=np.array(feedforward.friction_nms_per_rad),
        tension_before_n=feedforward.tension_before_n,
        tension_after_n=feedforward.tension_after_n,
    )


def flat(model: WebModel, motion: Motion, unwind_speed_m_per_s: float) -> tuple[FloatArray, FloatArray]:
    """Roller speeds and torques, (n,) each, that make the tensions follow `motion`: the module's equations.

    `unwind_speed_m_per_s` is that at the reference's own instant; `motion` holds what is added until its own.
    """
    stiffness = model.stiffness_n
    speed_up = unwind_speed_m_per_s + motion.unwind_speed_change_m_per_s
    acceleration_up = motion.unwind_acceleration_m_per_s2
    tension_up, rate_up = model.tension_before_n, 0.0
    speed, acceleration = np.empty(model.n), np.empty(model.n)
    columns = (model.length_m, motion.tension_n, motion.tension_rate_n_per_s, motion.tension_acceleration_n_per_s2)
    rows = zip(*(column.tolist() for column in columns), strict=True)
    for i, (length, tension, rate, bend) in enumerate(rows):
        free = 1.0 / (stiffness - tension)
        v = (length * rate + (stiffness - tension_up) * speed_up) * free
        a = (length * bend + (stiffness - tension_up) * acceleration_up - rate_up * speed_up + rate * v) * free
        speed[i], acceleration[i] = v, a
        tension_up, rate_up, speed_up, acceleration_up = tension, rate, v, a
    inertia = model.inertia_kg_m2 / model.radius_m * acceleration
    friction = model.friction_nms_per_rad / model.radius_m * speed
    return speed, inertia + friction - web_torque(model, motion.tension_n)
