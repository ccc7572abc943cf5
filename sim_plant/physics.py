"""The truth of the simulated line: the paper's two equations, integrated by RK4 at 1 ms.

    dT_i/dt = EA/L_i (v_i - v_{i-1}) + 1/L_i (T_{i-1} v_{i-1} - T_i v_i)             (eq. web_tension_dynamics)
    dv_i/dt = R_i^2/J_i (T_{i+1} - T_i) - f_i/J_i v_i + R_i/J_i u_i + b_i xi_i       (eq. roller_velocity_dynamics)

Span i lies between roller i-1 and roller i, roller 0 is the unwinder at v_0; T_0 and T_{n+1} are constants. Torque
and the noise xi ~ N(0, 1) are held for each step of 1 ms. Nothing is limited here that the equations do not limit:
what a real line does beyond them is in `effects_model`.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np
from numba import njit
from numpy.typing import NDArray

FloatArray = NDArray[np.float64]

STEP_S = 0.001  #: integration step, and the grid on which everything in the simulated line happens
STEPS_PER_S = 1000

# Rows of the coefficient table that the kernel works on.
_STIFFNESS, _PER_LENGTH, _WEB_GAIN, _FRICTION_RATE, _TORQUE_GAIN, _DISTURBANCE = range(6)

# Rows of the table of held inputs; columns are the torques of rollers 1 to n, then the unwinder's speed.
VALUE, TARGET, RATE = range(3)


@dataclass(frozen=True)
class WebParameters:
    """Arrays of shape (n,), element k for roller and span k+1."""

    stiffness_n: FloatArray  #: E A
    length_m: FloatArray
    radius_m: FloatArray
    inertia_kg_m2: FloatArray
    friction_nms_per_rad: FloatArray
    disturbance_m_per_s2: FloatArray  #: b
    tension_before_n: float = 0.0  #: T_0
    tension_after_n: float = 0.0  #: T_{n+1}

    @property
    def n(self) -> int:
        return len(self.length_m)

    def coefficients(self) -> FloatArray:
        """What the kernel needs of the parameters, shape (6, n)."""
        return np.ascontiguousarray(
            np.vstack(
                (
                    self.stiffness_n,
                    1.0 / self.length_m,
                    self.radius_m**2 / self.inertia_kg_m2,
                    self.friction_nms_per_rad / self.inertia_kg_m2,
                    self.radius_m / self.inertia_kg_m2,
                    self.disturbance_m_per_s2,
                )
            )
        )

    def boundary_n(self) -> FloatArray:
        """[T_0, T_{n+1}]"""
        return np.array([self.tension_before_n, self.tension_after_n])


def equilibrium(
    parameters: WebParameters, tension_n: FloatArray, unwind_speed_m_per_s: float
) -> tuple[FloatArray, FloatArray]:
    """Speeds (m/s) and torques (Nm), each (n,), at which tensions (n,) in N and speeds stand still without noise.

    Both equations set to zero: the recursion of eq. reference_velocity (with the stiffness of each span), then the
    torque balance.
    """
    p = parameters
    upstream = np.concatenate(([p.tension_before_n], tension_n[:-1]))
    downstream = np.concatenate((tension_n[1:], [p.tension_after_n]))
    draws = np.cumprod((p.stiffness_n - upstream) / (p.stiffness_n - tension_n), dtype=np.float64)
    speed = unwind_speed_m_per_s * draws
    torque = p.friction_nms_per_rad / p.radius_m * speed - p.radius_m * (downstream - tension_n)
    return speed, torque


def derivative(
    parameters: WebParameters,
    tension_n: FloatArray,
    speed_m_per_s: FloatArray,
    torque_nm: FloatArray,
    unwind_speed_m_per_s: float,
) -> tuple[FloatArray, FloatArray]:
    """dT/dt (N/s) and dv/dt (m/s2), each (n,), without noise, from the very code that is integrated."""
    n = parameters.n
    rate = np.empty(2 * n)
    state = np.concatenate((tension_n, speed_m_per_s))
    inputs = np.append(torque_nm, unwind_speed_m_per_s)
    _state_rate(parameters.coefficients(), parameters.boundary_n(), state, inputs, np.zeros(n), rate)
    return rate[:n], rate[n:]


class PlainLine:
    """The line by these equations, for `World`: `inputs` (3, n+1) are shared with it, as `integrate` has them."""

    def __init__(self, parameters: WebParameters, inputs: FloatArray) -> None:
        n = parameters.n
        self._parameters = parameters
        self._coefficients = parameters.coefficients()
        self._boundary_n = parameters.boundary_n()
        self._inputs = inputs
        self._state = np.zeros(2 * n)
        self.tension_n = self._state[:n]  #: true values now, views (n,)
        self.speed_m_per_s = self._state[n:]
        self.surface_speed_m_per_s = self.speed_m_per_s  #: of the rollers; the web does not slip
        self.torque_nm = inputs[VALUE, :n]
        self.advance(np.empty((0, n)), np.empty((0, 3 * n + 1)))  # compiles now, not in the first millisecond

    def advance(self, noise: FloatArray, trace: FloatArray) -> None:
        """As many steps as `noise` (m, n) and `trace` (m, 3n+1) have rows; see `integrate`."""
        integrate(self._coefficients, self._boundary_n, self._state, self._inputs, noise, trace)

    def set_torque_nm(self, index: int, value: float) -> None:
        """The torque of roller `index` + 1 from now on, without lag."""
        self._inputs[:2, index] = value

    def start_at_equilibrium(self, tension_n: FloatArray, unwind_speed_m_per_s: float) -> FloatArray:
        """Put the web at its rest point. Returns the torques (n,) that hold it."""
        speed, torque = equilibrium(self._parameters, tension_n, unwind_speed_m_per_s)
        self.tension_n[:] = tension_n
        self.speed_m_per_s[:] = speed
        return torque


# numba's decorator has no types; what it returns is called as the function it decorates.
compiled: Any = njit(cache=True, error_model="numpy")


@compiled
def tension_rate(stiffness, per_length, tension_up, tension, speed_up, speed):
    """dT/dt of one span, N/s. Linear in tension: also what any share of the web's tension does (`effects_model`)."""
    return per_length * (stiffness * (speed - speed_up) + tension_up * speed_up - tension * speed)


@compiled
def _state_rate(coefficients, boundary, state, inputs, noise, rate):
    """Fill `rate` (2n,) with d[T, v]/dt at `state` [T_1 .. T_n, v_1 .. v_n] under inputs [u_1 .. u_n, v_0]."""
    n = state.size // 2
    tension_up, speed_up = boundary[0], inputs[n]
    for i in range(n):
        tension, speed = state[i], state[n + i]
        tension_down = state[i + 1] if i + 1 < n else boundary[1]
        rate[i] = tension_rate(
            coefficients[_STIFFNESS, i], coefficients[_PER_LENGTH, i], tension_up, tension, speed_up, speed
        )
        rate[n + i] = (
            coefficients[_WEB_GAIN, i] * (tension_down - tension)
            - coefficients[_FRICTION_RATE, i] * speed
            + coefficients[_TORQUE_GAIN, i] * inputs[i]
            + coefficients[_DISTURBANCE, i] * noise[i]
        )
        tension_up, speed_up = tension, speed


@compiled
def slew(inputs):
    """Move every held input towards its target by at most its rate (units per second) times the step."""
    for j in range(inputs.shape[1]):
        missing = inputs[TARGET, j] - inputs[VALUE, j]
        if missing != 0.0:
            most = inputs[RATE, j] * STEP_S
            if abs(missing) <= most:
                inputs[VALUE, j] = inputs[TARGET, j]
            elif missing > 0.0:
                inputs[VALUE, j] += most
            else:
                inputs[VALUE, j] -= most


@compiled
def integrate(coefficients, boundary, state, inputs, noise, trace):
    """Advance `state` (2n,) and `inputs` (3, n+1) in place by as many steps as `noise` (m, n) and `trace` have rows.

    Row r of `trace` (m, 3n+1) becomes [T (n), v (n), u (n), v_0]: the state at the end of step r, and the inputs
    that acted during it. `inputs` holds value, target and rate per column [u_1 .. u_n, v_0].
    """
    width = state.size
    n = width // 2
    k1, k2, k3, k4, probe = np.empty(width), np.empty(width), np.empty(width), np.empty(width), np.empty(width)
    for r in range(noise.shape[0]):
        slew(inputs)
        held, xi = inputs[VALUE], noise[r]
        _state_rate(coefficients, boundary, state, held, xi, k1)
        for j in range(width):
            probe[j] = state[j] + 0.5 * STEP_S * k1[j]
        _state_rate(coefficients, boundary, probe, held, xi, k2)
        for j in range(width):
            probe[j] = state[j] + 0.5 * STEP_S * k2[j]
        _state_rate(coefficients, boundary, probe, held, xi, k3)
        for j in range(width):
            probe[j] = state[j] + STEP_S * k3[j]
        _state_rate(coefficients, boundary, probe, held, xi, k4)
        for j in range(width):
            state[j] += STEP_S / 6.0 * (k1[j] + 2.0 * k2[j] + 2.0 * k3[j] + k4[j])
            trace[r, j] = state[j]
        for j in range(n + 1):
            trace[r, width + j] = held[j]
