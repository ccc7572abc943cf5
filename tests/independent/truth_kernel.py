"""The integration of `truth`: Runge-Kutta 4 at 1 ms for web and rollers, closed forms for lag and filter, compiled."""

from math import cos, exp, sqrt
from typing import Any, NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from tests.independent.truth import (
    BOUNDARY_N,
    CELL_LAG_S,
    COULOMB_NM,
    CREEP_M_PER_S,
    DISTURBANCE_M_PER_S2,
    DRIVE_INERTIA_KG_M2,
    ECCENTRICITY,
    FRICTION_NMS_PER_RAD,
    GAP_RAD,
    INERTIA_KG_M2,
    JITTER_S,
    LATE_SHARE,
    LENGTH_M,
    PHASE_RAD,
    RADIUS_M,
    SPEED_NOISE_M_PER_S,
    SPEED_STEP_M_PER_S,
    STIFFNESS_N,
    TENSION_NOISE_N,
    TENSION_STEP_N,
    TORQUE_LAG_S,
    TORQUE_STEP_NM,
    UNWINDER_RADIUS_M,
    FloatArray,
)

STEP_S = 0.001
SLOTS = 8  #: commands under way, at most

compiled: Any = njit(cache=True, error_model="numpy")
_inlined: Any = njit(error_model="numpy", inline="always")


class LineNow(NamedTuple):
    """Where a line is. Arrays (n,) unless told; changed in place."""

    tension_n: FloatArray
    speed_m_per_s: FloatArray
    drive_nm: FloatArray
    angle_rad: FloatArray  #: (n+1,), the unwinder first
    cell_n: FloatArray
    cell_before_n: FloatArray  #: a step ago
    speed_before_m_per_s: FloatArray
    flank: NDArray[np.int64]  #: on which the drive presses: 1, -1, 0 in the gap
    gap_rad: FloatArray  #: from the backward flank
    gap_rate_rad_per_s: FloatArray
    command_nm: FloatArray  #: that the drive has
    waiting_nm: FloatArray  #: (SLOTS, n)
    due: NDArray[np.int64]  #: (SLOTS, n), step at which it reaches the drive; -1: empty
    work: FloatArray  #: (12, n + 1)


@compiled
def begin(truths, t, tension_n, unwind_m_per_s):
    """A line at rest with itself at these tensions (n,): rollers taken for round, every drive pressing."""
    n = tension_n.size
    speed, torque = np.empty(n), np.empty(n)
    v, up = unwind_m_per_s, truths[t, BOUNDARY_N, 0]
    for i in range(n):
        v *= (truths[t, STIFFNESS_N, i] - up) / (truths[t, STIFFNESS_N, i] - tension_n[i])
        speed[i], up = v, tension_n[i]
    flank, gap = np.ones(n, np.int64), truths[t, GAP_RAD, :n].copy()
    for i in range(n):
        down = tension_n[i + 1] if i + 1 < n else truths[t, BOUNDARY_N, 1]
        radius, w = truths[t, RADIUS_M, i], speed[i]
        torque[i] = truths[t, FRICTION_NMS_PER_RAD, i] * w / radius - radius * (down - tension_n[i])
        torque[i] += truths[t, COULOMB_NM, i] * w / sqrt(w * w + CREEP_M_PER_S * CREEP_M_PER_S)
        if torque[i] < 0.0:
            flank[i], gap[i] = -1, 0.0
    return LineNow(
        tension_n.copy(), speed, torque, np.zeros(n + 1), tension_n.copy(), tension_n.copy(), speed.copy(), flank, gap,
        np.zeros(n), torque.copy(), np.zeros((SLOTS, n)), np.full((SLOTS, n), -1), np.zeros((12, n + 1)),
    )  # fmt: skip


@compiled
def send(truths, t, line, number, torque_nm, step, latency_steps, period_steps, chance):
    """Command `number` (from 0), sent with the sample of `step`; `chance` (n,) in [0, 1) decides which are late."""
    slot = number % SLOTS
    resolution = truths[t, TORQUE_STEP_NM, 0]
    for i in range(torque_nm.size):
        asked = torque_nm[i]
        if resolution > 0.0:
            asked = round(asked / resolution) * resolution
        line.waiting_nm[slot, i] = asked
        line.due[slot, i] = step + latency_steps
        if chance[i] < truths[t, LATE_SHARE, 0]:
            line.due[slot, i] += period_steps
        before = (number - 1) % SLOTS
        if line.due[before, i] == line.due[slot, i]:
            line.due[before, i] = -1  # overtaken: it would come with this one


@_inlined
def _rates(truths, t, tension, speed, rho, torque, unwind, noise, tension_rate, speed_rate):
    n = torque.size
    up, v_up = truths[t, BOUNDARY_N, 0], rho[0] * unwind
    for i in range(n):
        T, w, out = tension[i], speed[i], rho[i + 1]
        down = tension[i + 1] if i + 1 < n else truths[t, BOUNDARY_N, 1]
        v, radius, inertia = out * w, truths[t, RADIUS_M, i], truths[t, INERTIA_KG_M2, i]
        tension_rate[i] = (truths[t, STIFFNESS_N, i] * (v - v_up) + up * v_up - T * v) / truths[t, LENGTH_M, i]
        dry = truths[t, COULOMB_NM, i] * w / sqrt(w * w + CREEP_M_PER_S * CREEP_M_PER_S)
        pull = radius * out * (down - T)
        speed_rate[i] = (radius * (pull + torque[i] - dry) - truths[t, FRICTION_NMS_PER_RAD, i] * w) / inertia + noise[
            i
        ]
        up, v_up = T, v


@_inlined
def _coupling(truths, t, line, i, torque):
    """What the roller gets of the drive's torque; moves the drive through its gap, and hands its momentum over."""
    width = truths[t, GAP_RAD, i]
    if width <= 0.0:
        return torque
    if line.flank[i] != 0 and torque * line.flank[i] >= 0.0:
        return torque
    inertia = truths[t, DRIVE_INERTIA_KG_M2, i]
    line.flank[i] = 0
    line.gap_rate_rad_per_s[i] += torque / inertia * STEP_S
    line.gap_rad[i] += line.gap_rate_rad_per_s[i] * STEP_S
    if line.gap_rad[i] >= width or line.gap_rad[i] <= 0.0:
        line.flank[i] = 1 if line.gap_rad[i] >= width else -1
        line.gap_rad[i] = width if line.gap_rad[i] >= width else 0.0
        kick = truths[t, RADIUS_M, i] * inertia * line.gap_rate_rad_per_s[i] / truths[t, INERTIA_KG_M2, i]
        line.speed_m_per_s[i] += kick
        line.gap_rate_rad_per_s[i] = 0.0
    return 0.0


@compiled
def advance(truths, t, line, step, unwind, pushed_nm, noise, most_nm):
    """One step. `pushed_nm` (n,): torque that disturbs; `noise` (n,): standard normal; `most_nm`: the drive's limit."""
    n = line.tension_n.size
    work = line.work
    rho, torque, noise_rate = work[0], work[1, :n], work[2, :n]
    T0, w0, T1, w1 = line.tension_n, line.speed_m_per_s, work[3, :n], work[4, :n]
    for i in range(n):
        line.cell_before_n[i] = line.cell_n[i]
        line.speed_before_m_per_s[i] = w0[i]
        for slot in range(SLOTS):
            if line.due[slot, i] == step:
                line.command_nm[i] = min(max(line.waiting_nm[slot, i], -most_nm), most_nm)
    # Two commands may be due together: the one sent last counts, and slots go round.
    lag = truths[t, TORQUE_LAG_S, 0]
    half = exp(-0.5 * STEP_S / lag) if lag > 0.0 else 0.0
    rho[0] = 1.0 + truths[t, ECCENTRICITY, 0] * cos(line.angle_rad[0] + truths[t, PHASE_RAD, 0])
    line.angle_rad[0] += STEP_S * unwind / truths[t, UNWINDER_RADIUS_M, 0]
    for i in range(n):
        missing = (line.drive_nm[i] - line.command_nm[i]) * half
        middle = line.command_nm[i] + missing
        line.drive_nm[i] = line.command_nm[i] + missing * half
        torque[i] = _coupling(truths, t, line, i, middle) + pushed_nm[i]
        noise_rate[i] = truths[t, DISTURBANCE_M_PER_S2, i] * noise[i]
        turned = w0[i] / truths[t, RADIUS_M, i]
        angle = line.angle_rad[i + 1] + 0.5 * STEP_S * turned
        rho[i + 1] = 1.0
        if truths[t, ECCENTRICITY, i + 1] > 0.0:
            rho[i + 1] += truths[t, ECCENTRICITY, i + 1] * cos(angle + truths[t, PHASE_RAD, i + 1])
        line.angle_rad[i + 1] += STEP_S * turned
    kT1, kT2, kT3, kT4 = work[5, :n], work[6, :n], work[7, :n], work[8, :n]
    kw1, kw2, kw3, kw4 = work[9, :n], work[10, :n], work[11, :n], np.empty(n)
    _rates(truths, t, T0, w0, rho, torque, unwind, noise_rate, kT1, kw1)
    for i in range(n):
        T1[i], w1[i] = T0[i] + 0.5 * STEP_S * kT1[i], w0[i] + 0.5 * STEP_S * kw1[i]
    _rates(truths, t, T1, w1, rho, torque, unwind, noise_rate, kT2, kw2)
    for i in range(n):
        T1[i], w1[i] = T0[i] + 0.5 * STEP_S * kT2[i], w0[i] + 0.5 * STEP_S * kw2[i]
    _rates(truths, t, T1, w1, rho, torque, unwind, noise_rate, kT3, kw3)
    for i in range(n):
        T1[i], w1[i] = T0[i] + STEP_S * kT3[i], w0[i] + STEP_S * kw3[i]
    _rates(truths, t, T1, w1, rho, torque, unwind, noise_rate, kT4, kw4)
    filtered = truths[t, CELL_LAG_S, 0]
    share = 1.0 - exp(-STEP_S / filtered) if filtered > 0.0 else 1.0
    for i in range(n):
        before = T0[i]
        T0[i] += STEP_S / 6.0 * (kT1[i] + 2.0 * kT2[i] + 2.0 * kT3[i] + kT4[i])
        w0[i] += STEP_S / 6.0 * (kw1[i] + 2.0 * kw2[i] + 2.0 * kw3[i] + kw4[i])
        seen = 0.5 * (before + T0[i]) if filtered > 0.0 else T0[i]
        line.cell_n[i] += share * (seen - line.cell_n[i])


@compiled
def sample(truths, t, line, chance, noise, seen):
    """Fill `seen` (2n,) with what cells and encoders say. `chance` in [0, 1): how old it is; `noise` (2n,) normal."""
    n = line.tension_n.size
    age = chance * truths[t, JITTER_S, 0] / STEP_S
    for i in range(n):
        tension = line.cell_n[i] - age * (line.cell_n[i] - line.cell_before_n[i])
        speed = line.speed_m_per_s[i] - age * (line.speed_m_per_s[i] - line.speed_before_m_per_s[i])
        tension += truths[t, TENSION_NOISE_N, 0] * noise[i]
        speed += truths[t, SPEED_NOISE_M_PER_S, 0] * noise[n + i]
        fine = truths[t, TENSION_STEP_N, 0]
        seen[i] = round(tension / fine) * fine if fine > 0.0 else tension
        fine = truths[t, SPEED_STEP_M_PER_S, 0]
        seen[n + i] = round(speed / fine) * fine if fine > 0.0 else speed
