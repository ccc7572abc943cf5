"""The full model of the line: the paper's two equations, and what a real line does beyond them.

Symbols as in `physics`: span i lies between roller i-1 and roller i, roller 0 is the unwinder. Every roller turns at
omega_i; w_i = omega_i R_i is its mean surface speed, v_i that of the web on it. States, each of n unless told:

    s_i   tension of the web's spring, E A epsilon, in N; s < 0 is slack
    w_i   surface speed                             q_i   tension of the web's Maxwell arm, in N
    m_i   torque of the drive, in Nm                phi_i angle, and phi_0 of the unwinder, in rad
    R_0^2, R_n^2  of the two reels

Web. Shelton's span (Shelton 1986, Dynamics of web tension control with velocity or torque control, Proc. American
Control Conference; Brandenburg 1973) with a standard linear solid (Zener 1948, Elasticity and anelasticity of metals):
a spring E A, and beside it a Maxwell arm of stiffness r E A and relaxation time tau. What the span's ends do stretches
both, what comes in and goes out carries both along, and the arm forgets:

    ds_i/dt = E A/L_i (v_i - v_{i-1}) + 1/L_i (e_{i-1} v_{i-1} - e_i v_i)
    dq_i/dt = r E A/L_i (v_i - v_{i-1}) + 1/L_i (q_{i-1} v_{i-1} - q_i v_i) - q_i/tau
    T_i = max(0, s_i + q_i)     with slack, T_i = s_i + q_i without, 0 when the web is broken;     e_i = T_i - q_i

The web cannot push. s goes on below -q as the length beyond the span, -(s + q) L/(E A), that is to be taken up before
tension comes back. Meanwhile nobody stretches the web: its stress is zero, so that what the arm forgets the spring must
give, and with d(s + q)/dt = 0 in the web itself the first term of dq_i/dt leaves -q_i/((1 + r) tau) in all: the creep
recovery of the solid. A web that is broken has T = s = q = 0 until it is spliced.

Rollers (Reid and Lin 1993, Brandenburg 1973), rho_i = 1 + epsilon_i cos(phi_i + phase_i) for an eccentric one:

    dw_i/dt = R_i^2/J_i rho_i (T_{i+1} - T_i) - c_i f_i/J_i w_i + R_i/J_i (m_i - c_i F_i) + b_i xi_i
              + w_i/R_i dR_i/dt for a reel
    dphi_i/dt = w_i/R_i
    v_i = rho_i w_i + slip_i,    v_0 = rho_0 u_0

Only the radius under the web is modulated: span lengths and wrap stay (Branca, Pagilla and Reid 2013, ASME J. Dyn.
Syst. Meas. Control 135, have them too). The unwinder is a prescribed motion, u_0 from the line PLC: its inertia acts on
nothing here.

Dry friction (Armstrong-Helouvry, Dupont and Canudas de Wit 1994, Automatica 30): Coulomb F_c, break-away F_s, and
between them Stribeck's bend, against the motion; c_i is the state of the bearing, 1 when it is new:

    F_i = sign(w_i) (F_c + (F_s - F_c) exp(-(w_i/w_s)^2))

A sign inside Runge-Kutta would chatter, and a smooth one be stiff and creep. So it is decided once per step, after
Karnopp (1985, ASME J. Dyn. Syst. Meas. Control 107): a roller at rest stays exactly at rest while |R_i rho_i (T_{i+1} -
T_i) + m_i| <= c_i F_s; else it breaks away to that side. One that comes to rest within a step, or would turn back, is
at rest at its end. xi, the scatter of what turns, moves nothing that rests.

Slip. A massless web on roller i < n is held by friction as long as (Euler, Eytelwein)

    T_i <= g_i T_{i+1}  and  T_{i+1} <= g_i T_i,    g_i = exp(mu_i theta_i)

Beyond that it slides to the tighter side at the speed that brings the ratio back to g_i in `SLIP_TIME_S`:

    slip_i = (T_{i+1} - g T_i) / (SLIP_TIME_S (k_{i+1} + g k_i)) forward,    k_i = (1 + r) E A_i/L_i;    likewise back

Reels, with the web's thickness h, width b and density d; the torque that the growing inertia takes, omega dJ/dt, is
what the web brings along:

    dR_0^2/dt = -h/pi v_0 down to the core;    dR_n^2/dt = h/pi v_n;    J_n = J_n(0) + pi/2 d b (R_n^4 - R_n(0)^4)

Drives. The torque follows its command, in multiples of the drive's step, as dm_i/dt = (u_i - m_i)/tau_m.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from sim_plant.physics import RATE, STEP_S, TARGET, FloatArray
from sim_plant.plant import Plant
from sim_plant.plant_fields import each

SLIP_TIME_S = 3.0 * STEP_S  #: as short as Runge-Kutta integrates well; the ratio exceeds its limit by this much slip
NEVER_SLIPS = np.inf  #: as a grip
PI = np.pi


class Model(NamedTuple):
    """Parameters of the kernel, which do not change. Arrays (n,), of span or roller k+1, unless told."""

    stiffness_n: FloatArray  #: E A
    per_length_per_m: FloatArray  #: 1/L
    arm_stiffness_n: FloatArray  #: r E A
    arm_rate_per_s: float  #: 1/tau
    boundary_n: FloatArray  #: [T_0, T_{n+1}]
    slack: bool
    web_gain: FloatArray  #: R^2/J
    friction_rate_per_s: FloatArray  #: f/J
    torque_gain: FloatArray  #: R/J
    disturbance_m_per_s2: FloatArray  #: b
    radius_m: FloatArray
    eccentricity: FloatArray  #: (n+1,), the unwinder's last
    phase_rad: FloatArray  #: (n+1,), the unwinder's last
    coulomb_nm: FloatArray
    breakaway_nm: FloatArray
    stribeck_speed_m_per_s: float
    torque_step_nm: float  #: 0: none
    lag_rate_per_s: float  #: 1/tau_m; 0: no lag
    area_per_length_m: float  #: h/pi; 0: the radii stay
    core_area_m2: float  #: R^2 of the unwinder's core
    reel_inertia_kg_m2: float  #: J_n(0)
    reel_mass_kg_per_m2: float  #: pi/2 d b
    friction_nms_per_rad: float  #: f_n


class Condition(NamedTuple):
    """What wear and faults change while the line runs."""

    wear: FloatArray  #: c is wear * friction; each value, target and rate per second (3, n), as the inputs of `physics`
    friction: FloatArray  #: what a fault makes of it
    grip: FloatArray  #: g (n,); NEVER_SLIPS where the web is held whatever comes
    broken: NDArray[np.bool_]  #: (n,)


def model_of(plant: Plant) -> Model:
    """The full model of a plant, whatever of it is on."""
    n, effects, drives = plant.spans, plant.effects, plant.drives
    parameters = plant.parameters()
    friction, eccentricity, relaxation = effects.friction, effects.eccentricity, effects.relaxation
    unwinder, reels = effects.unwinder, effects.reels
    coulomb = each(friction.coulomb_nm, n)
    stiffness, per_length, web_gain, friction_rate, torque_gain, disturbance = parameters.coefficients()
    return Model(
        stiffness_n=stiffness,
        per_length_per_m=per_length,
        arm_stiffness_n=relaxation.stiffness_share * stiffness,
        arm_rate_per_s=1.0 / relaxation.time_s,
        boundary_n=parameters.boundary_n(),
        slack=effects.slack,
        web_gain=web_gain,
        friction_rate_per_s=friction_rate,
        torque_gain=torque_gain,
        disturbance_m_per_s2=disturbance,
        radius_m=parameters.radius_m,
        eccentricity=np.append(each(eccentricity.share, n), unwinder.eccentricity),
        phase_rad=np.append(each(eccentricity.phase_rad, n), unwinder.phase_rad),
        coulomb_nm=coulomb,
        breakaway_nm=np.maximum(coulomb, each(friction.breakaway_nm, n)),
        stribeck_speed_m_per_s=friction.stribeck_speed_m_per_s,
        torque_step_nm=float(drives.torque_step_nm),
        lag_rate_per_s=1.0 / drives.torque_lag_s if drives.torque_lag_s > 0.0 else 0.0,
        area_per_length_m=reels.thickness_m / PI,
        core_area_m2=unwinder.core_radius_m**2,
        reel_inertia_kg_m2=float(parameters.inertia_kg_m2[-1]),
        reel_mass_kg_per_m2=0.5 * PI * reels.density_kg_per_m3 * reels.width_m,
        friction_nms_per_rad=float(parameters.friction_nms_per_rad[-1]),
    )


def condition_of(plant: Plant) -> Condition:
    """The line as it is at the start: nothing broken, bearings new, and slip as the plant's file has it."""
    n, slip = plant.spans, plant.effects.slip
    rise = each(plant.effects.friction.rise_per_s, n)
    wear, friction = np.ones((3, n)), np.ones((3, n))
    wear[TARGET], wear[RATE] = np.where(rise > 0.0, np.inf, 1.0), rise
    grip = np.full(n, NEVER_SLIPS)
    if slip.on:
        grip[:-1] = np.exp(each(slip.friction_coefficient, n) * each(slip.wrap_rad, n))[:-1]
    return Condition(wear, friction, grip, np.zeros(n, dtype=np.bool_))


class State:
    """The state vector of the kernel (5n + 3,), and its parts as views."""

    def __init__(self, plant: Plant) -> None:
        n = plant.spans
        self.vector = np.zeros(5 * n + 3)
        self.spring_n = self.vector[:n]
        self.surface_speed_m_per_s = self.vector[n : 2 * n]
        self.arm_n = self.vector[2 * n : 3 * n]
        self.torque_nm = self.vector[3 * n : 4 * n]
        self.angle_rad = self.vector[4 * n : 5 * n + 1]  #: (n+1,), the unwinder's last
        self.reel_area_m2 = self.vector[5 * n + 1 :]  #: [R_0^2, R_n^2]
        self.reel_area_m2[:] = plant.effects.unwinder.radius_m**2, plant.parameters().radius_m[-1] ** 2
