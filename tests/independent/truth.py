"""What a line really is, for the judge of the gate: written apart from the product and from the simulated line.

Symbols: span i lies between roller i-1 and roller i, roller 0 is the unwinder. T tension (N), w mean surface speed of a
roller (m/s), phi its angle, rho = 1 + epsilon cos(phi + phase) how far it runs out of true, m the torque of its drive.

    dT_i/dt = (EA_i (v_i - v_{i-1}) + T_{i-1} v_{i-1} - T_i v_i) / L_i,            v_i = rho_i w_i
    dw_i/dt = (R_i^2 rho_i (T_{i+1} - T_i) - f_i w_i - R_i c_i w_i/sqrt(w_i^2 + s^2) + R_i g_i(m_i)) / J_i + b xi
    dm_i/dt = (u_i - m_i) / torque_lag,      dcell_i/dt = (T_i - cell_i) / cell_lag

c is Coulomb friction, of which s is the speed at which it is there by 70 %. g is backlash: the drive, of inertia J_m,
presses on one flank of its coupling. When its torque turns round it flies free through the gap, the roller gets no
torque meanwhile, and at the other flank it leaves its momentum to the roller.
"""

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from sim_plant.plant import Plant
from sim_plant.plant_fields import each

FloatArray = NDArray[np.float64]

CREEP_M_PER_S = 2e-4  #: s


# Rows of the table that the kernel works on, (t, rows, n + 1): by the names of `Truth`, a place for each roller.
(
    STIFFNESS_N,
    LENGTH_M,
    RADIUS_M,
    INERTIA_KG_M2,
    FRICTION_NMS_PER_RAD,
    DISTURBANCE_M_PER_S2,
    COULOMB_NM,
    ECCENTRICITY,
    PHASE_RAD,
    GAP_RAD,
    DRIVE_INERTIA_KG_M2,
    BOUNDARY_N,
    TORQUE_LAG_S,
    CELL_LAG_S,
    LATE_SHARE,
    JITTER_S,
    TENSION_NOISE_N,
    SPEED_NOISE_M_PER_S,
    TENSION_STEP_N,
    SPEED_STEP_M_PER_S,
    TORQUE_STEP_NM,
    UNWINDER_RADIUS_M,
) = range(22)
ROWS = (
    "stiffness_n",
    "length_m",
    "radius_m",
    "inertia_kg_m2",
    "friction_nms_per_rad",
    "disturbance_m_per_s2",
    "coulomb_nm",
    "eccentricity",
    "phase_rad",
    "gap_rad",
    "drive_inertia_kg_m2",
    "boundary_n",
    "torque_lag_s",
    "cell_lag_s",
    "late_share",
    "jitter_s",
    "tension_noise_n",
    "speed_noise_m_per_s",
    "tension_step_n",
    "speed_step_m_per_s",
    "torque_step_nm",
    "unwinder_radius_m",
)


@dataclass(frozen=True)
class Truth:
    """One line. Arrays (n,) unless told; effects are off unless they are given."""

    stiffness_n: FloatArray
    length_m: FloatArray
    radius_m: FloatArray
    inertia_kg_m2: FloatArray
    friction_nms_per_rad: FloatArray
    disturbance_m_per_s2: FloatArray
    coulomb_nm: FloatArray
    eccentricity: FloatArray  #: (n+1,), the unwinder first
    phase_rad: FloatArray  #: (n+1,)
    gap_rad: FloatArray
    drive_inertia_kg_m2: FloatArray
    boundary_n: FloatArray  #: (2,)
    torque_lag_s: float = 0.0
    cell_lag_s: float = 0.0
    late_share: float = 0.0
    jitter_s: float = 0.0
    tension_noise_n: float = 0.0
    speed_noise_m_per_s: float = 0.0
    tension_step_n: float = 0.0
    speed_step_m_per_s: float = 0.0
    torque_step_nm: float = 0.0
    unwinder_radius_m: float = 0.2

    @property
    def n(self) -> int:
        return len(self.length_m)

    def scaled(self, **factors: float) -> "Truth":
        """With parameters multiplied by name."""
        return replace(self, **{name: getattr(self, name) * factor for name, factor in factors.items()})


def plain_truth(plant: Plant, *, quiet: bool = False) -> Truth:
    """The paper's two equations with the parameters of a plant file, its noise, and no effect. `quiet`: no noise."""
    p, n = plant.parameters(), plant.spans
    noise = {} if quiet else {
        "tension_noise_n": plant.sensors.tension_noise_n, "speed_noise_m_per_s": plant.sensors.speed_noise_m_per_s,
    }  # fmt: skip
    return Truth(
        p.stiffness_n.copy(), p.length_m.copy(), p.radius_m.copy(), p.inertia_kg_m2.copy(),
        p.friction_nms_per_rad.copy(), 0.0 * p.length_m if quiet else p.disturbance_m_per_s2.copy(), np.zeros(n),
        np.zeros(n + 1), np.zeros(n + 1), np.zeros(n), 0.05 * p.inertia_kg_m2,
        np.array([p.tension_before_n, p.tension_after_n]), **noise,
    )  # fmt: skip


def truth_of(plant: Plant) -> Truth:
    """With those effects that a plant file can say: lag, Coulomb friction, eccentricity, cells, quantisation."""
    n, effects, sensors, drives = plant.spans, plant.effects, plant.sensors, plant.drives
    corner = sensors.tension_corner_hz
    return replace(
        plain_truth(plant),
        coulomb_nm=each(effects.friction.coulomb_nm, n),
        eccentricity=np.concatenate(([effects.unwinder.eccentricity], each(effects.eccentricity.share, n))),
        phase_rad=np.concatenate(([effects.unwinder.phase_rad], each(effects.eccentricity.phase_rad, n))),
        torque_lag_s=float(drives.torque_lag_s),
        cell_lag_s=0.0 if corner is None else 1.0 / (2.0 * np.pi * corner),
        tension_step_n=float(sensors.tension_step_n),
        speed_step_m_per_s=float(sensors.speed_step_m_per_s),
        torque_step_nm=float(drives.torque_step_nm),
        unwinder_radius_m=float(effects.unwinder.radius_m),
    )


def with_unruly_effects(truth: Truth, generator: np.random.Generator) -> Truth:
    """With what no plant file says, and data hardly show: late commands, backlash, sampling jitter."""
    return replace(truth, late_share=0.05, gap_rad=generator.uniform(0.0, 1e-3, truth.n), jitter_s=1e-3)


def with_slower_cells(truth: Truth, generator: np.random.Generator) -> Truth:
    """With load cells that filter 5 to 10 ms: what the gate refuses as soon as data show it, and has not been shown."""
    return replace(truth, cell_lag_s=max(truth.cell_lag_s, float(generator.uniform(0.005, 0.010))))


def stressed(truth: Truth, lag_s: float, late_share: float, coulomb_nm: float, eccentricity: float) -> Truth:
    """With the gate's own stress beside what it has, at phases that differ from roller to roller."""
    return replace(
        truth,
        torque_lag_s=truth.torque_lag_s + lag_s,
        late_share=max(truth.late_share, late_share),
        coulomb_nm=truth.coulomb_nm + coulomb_nm,
        eccentricity=np.concatenate((truth.eccentricity[:1], np.maximum(truth.eccentricity[1:], eccentricity))),
        phase_rad=np.where(truth.phase_rad == 0.0, 2.4 * np.arange(truth.n + 1), truth.phase_rad),
    )


def stacked(truths: list[Truth]) -> FloatArray:
    """(t, rows, n + 1) for the kernel. All have as many spans."""
    table = np.zeros((len(truths), len(ROWS), max(truths[0].n + 1, 2)))
    for t, truth in enumerate(truths):
        for row, name in enumerate(ROWS):
            value = np.atleast_1d(getattr(truth, name))
            table[t, row, : len(value)] = value
    return table


def equilibrium(truth: Truth, tension_n: FloatArray, unwind_m_per_s: float) -> tuple[FloatArray, FloatArray]:
    """Speeds (n,) and torques (n,) at which nothing changes, rollers taken for round."""
    before, after = truth.boundary_n
    speeds: list[float] = []
    speed, up = unwind_m_per_s, float(before)
    for stiffness, tension in zip(truth.stiffness_n.tolist(), tension_n.tolist(), strict=True):
        speed *= (stiffness - up) / (stiffness - tension)
        speeds.append(speed)
        up = tension
    w = np.array(speeds)
    pull = np.append(tension_n[1:], after) - tension_n
    dry = truth.coulomb_nm * w / np.sqrt(w**2 + CREEP_M_PER_S**2)
    return w, truth.friction_nms_per_rad * w / truth.radius_m - truth.radius_m * pull + dry
