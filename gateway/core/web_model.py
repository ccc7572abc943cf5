"""The gateway's belief about the web: the paper's two equations, equilibrium and linearisation.

State x = [T_1 .. T_n, v_1 .. v_n] in N and m/s, input u in Nm, v_0 the unwinder's speed in m/s.

    dT_i/dt = EA/L_i (v_i - v_{i-1}) + 1/L_i (T_{i-1} v_{i-1} - T_i v_i)             (eq. web_tension_dynamics)
    dv_i/dt = R_i^2/J_i (T_{i+1} - T_i) - f_i/J_i v_i + R_i/J_i u_i                  (eq. roller_velocity_dynamics)

T_0 and T_{n+1} are constants of the line. The truth of the simulated line is written apart from this file.
"""

from dataclasses import dataclass

import numpy as np

from gateway.core.line import Line
from gateway.core.signals import FloatArray


@dataclass(frozen=True)
class WebModel:
    """Plant parameters theta, one entry per span or roller."""

    stiffness_n: float  #: E A
    length_m: FloatArray  #: (n,)
    radius_m: FloatArray  #: (n,)
    inertia_kg_m2: FloatArray  #: (n,)
    friction_nms_per_rad: FloatArray  #: (n,)
    tension_before_n: float = 0.0  #: T_0
    tension_after_n: float = 0.0  #: T_{n+1}

    @property
    def n(self) -> int:
        return len(self.length_m)


def nominal_model(line: Line) -> WebModel:
    """The model of the line's file, at the nominal value of every parameter."""
    return WebModel(
        stiffness_n=line.web.stiffness_n.value,
        length_m=np.array([span.length_m.value for span in line.spans]),
        radius_m=np.array([roller.radius_m.value for roller in line.rollers]),
        inertia_kg_m2=np.array([roller.inertia_kg_m2.value for roller in line.rollers]),
        friction_nms_per_rad=np.array([roller.friction_nms_per_rad.value for roller in line.rollers]),
        tension_before_n=line.web.tension_before_n,
        tension_after_n=line.web.tension_after_n,
    )


def reference_speeds(model: WebModel, tension_n: FloatArray, unwind_speed_m_per_s: float) -> FloatArray:
    """Speeds v_1 .. v_n (m/s) that keep the tensions (N): the recursion of eq. reference_velocity."""
    return unwind_speed_m_per_s * speed_ratios(model, tension_n)


def speed_ratios(model: WebModel, tension_n: FloatArray) -> FloatArray:
    """The same per unwinder speed: v_i / v_0 (n,), the product of (EA - T_{k-1}) / (EA - T_k) up to k = i."""
    ratios: FloatArray = (model.stiffness_n - model.tension_before_n) / (model.stiffness_n - tension_n)
    return ratios


def equilibrium_torque(model: WebModel, tension_n: FloatArray, speed_m_per_s: FloatArray) -> FloatArray:
    """Torques u_1 .. u_n (Nm) at which the rollers keep their speeds: dv_i/dt = 0."""
    friction = model.friction_nms_per_rad * speed_m_per_s / model.radius_m
    return friction - web_torque(model, tension_n)


def web_torque(model: WebModel, tension_n: FloatArray) -> FloatArray:
    """Torques (n,) in Nm that the web exerts on the rollers, driving them: R_i (T_{i+1} - T_i)."""
    downstream = np.concatenate((tension_n[1:], [model.tension_after_n]))
    return model.radius_m * (downstream - tension_n)


def linearise(
    model: WebModel, tension_n: FloatArray, speed_m_per_s: FloatArray, unwind_speed_m_per_s: float
) -> tuple[FloatArray, FloatArray]:
    """A (2n, 2n) and B (2n, n) of dx/dt = A x + B u around tensions (n,) in N and speeds (n,) in m/s."""
    n = model.n
    A = np.zeros((2 * n, 2 * n))
    B = np.zeros((2 * n, n))
    upstream_speed = np.concatenate(([unwind_speed_m_per_s], speed_m_per_s[:-1]))
    for i in range(n):
        length = model.length_m[i]
        radius, inertia = model.radius_m[i], model.inertia_kg_m2[i]
        A[i, i] = -speed_m_per_s[i] / length
        A[i, n + i] = (model.stiffness_n - tension_n[i]) / length
        if i > 0:
            A[i, i - 1] = upstream_speed[i] / length
            A[i, n + i - 1] = (tension_n[i - 1] - model.stiffness_n) / length
        A[n + i, i] = -(radius**2) / inertia
        if i < n - 1:
            A[n + i, i + 1] = radius**2 / inertia
        A[n + i, n + i] = -model.friction_nms_per_rad[i] / inertia
        B[n + i, i] = radius / inertia
    return A, B
