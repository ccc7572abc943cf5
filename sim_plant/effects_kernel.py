"""The full model's integration: Runge-Kutta 4 at 1 ms, compiled on first use. The equations stand in `effects_model`.

It takes the span's equation and the held inputs from `physics`. numba's cache does not notice when those change:
touch this file then (a test compares both kernels).
"""

from math import cos, exp, pi, sqrt
from typing import Any

import numpy as np
from numba import njit

from sim_plant.effects_model import NEVER_SLIPS, SLIP_TIME_S
from sim_plant.physics import STEP_S, VALUE, compiled, slew, tension_rate

_FULL_TURN_RAD = 2.0 * pi
_REACH = (0.0, 0.5, 0.5, 1.0)  # of the step, along the stage before

# Each call of a compiled function counts references of every array of the model: inlined, a step takes half as long.
_inlined: Any = njit(error_model="numpy", inline="always")


@_inlined
def _slip_speed(grip, tension_up, tension_down, stiffness_up, stiffness_down):
    """How fast the web slides forward on a roller. Stiffnesses per length of the spans before and behind, N/m."""
    if grip == NEVER_SLIPS:
        return 0.0
    excess = tension_down - grip * tension_up
    if excess > 0.0:
        return excess / (SLIP_TIME_S * (stiffness_down + grip * stiffness_up))
    excess = tension_up - grip * tension_down
    if excess > 0.0:
        return -excess / (SLIP_TIME_S * (stiffness_up + grip * stiffness_down))
    return 0.0


@_inlined
def _stretch(model, i):
    """k of span i+1, spring and arm, N/m."""
    return (model.stiffness_n[i] + model.arm_stiffness_n[i]) * model.per_length_per_m[i]


@_inlined
def _web(model, condition, state, unwind_speed, tension, elastic, speed, rho):
    """From the state: `tension` T (n+2,), `elastic` e (n+1,) and the web's `speed` v (n+1,), all from index 0, and
    `rho` (n+1,), the unwinder's last."""
    n = model.radius_m.size
    tension[0] = elastic[0] = model.boundary_n[0]
    tension[n + 1] = model.boundary_n[1]
    for i in range(n):
        pull = state[i] + state[2 * n + i]
        if condition.broken[i] or (model.slack and pull < 0.0):
            pull = 0.0
        tension[i + 1] = pull
        elastic[i + 1] = pull - state[2 * n + i]
    for i in range(n + 1):
        rho[i] = 1.0
        if model.eccentricity[i] > 0.0:
            rho[i] += model.eccentricity[i] * cos(state[4 * n + i] + model.phase_rad[i])
    speed[0] = rho[n] * unwind_speed
    for i in range(n):
        speed[i + 1] = rho[i] * state[n + i]
        if i + 1 < n:
            speed[i + 1] += _slip_speed(
                condition.grip[i], tension[i + 1], tension[i + 2], _stretch(model, i), _stretch(model, i + 1)
            )


@_inlined
def _web_rate(model, condition, state, elastic, speed, rate):
    """The spans' part of `rate`: ds/dt and dq/dt."""
    n = model.radius_m.size
    arm_up = 0.0
    for i in range(n):
        arm = state[2 * n + i]
        rate[i] = rate[2 * n + i] = 0.0
        if not condition.broken[i]:
            per_length, up, down = model.per_length_per_m[i], speed[i], speed[i + 1]
            rate[i] = tension_rate(model.stiffness_n[i], per_length, elastic[i], elastic[i + 1], up, down)
            # A slack web is stretched by nobody: its arm only forgets, and has the spring to move with it.
            stiffness, forgets_per_s = model.arm_stiffness_n[i], model.arm_rate_per_s
            if model.slack and state[i] + arm < 0.0:
                forgets_per_s /= 1.0 + stiffness / model.stiffness_n[i]
                stiffness = 0.0
            rate[2 * n + i] = tension_rate(stiffness, per_length, arm_up, arm, up, down) - forgets_per_s * arm
        arm_up = arm


@_inlined
def _roller(model, state, i):
    """R, R^2/J, f/J and R/J of roller i+1 as it is now."""
    n = model.radius_m.size
    if i == n - 1 and model.area_per_length_m > 0.0:
        area = state[5 * n + 2]
        radius, grown = sqrt(area), area * area - model.radius_m[i] ** 4
        inertia = model.reel_inertia_kg_m2 + model.reel_mass_kg_per_m2 * grown
        return radius, area / inertia, model.friction_nms_per_rad / inertia, radius / inertia
    return model.radius_m[i], model.web_gain[i], model.friction_rate_per_s[i], model.torque_gain[i]


@_inlined
def _bearing(condition, i):
    """c of roller i+1."""
    return condition.wear[VALUE, i] * condition.friction[VALUE, i]


@_inlined
def _dry_friction_nm(model, bearing, i, surface_speed):
    """c F of roller i+1, without its sign."""
    coulomb, breakaway = model.coulomb_nm[i], model.breakaway_nm[i]
    bend = 0.0
    if breakaway > coulomb:
        ratio = surface_speed / model.stribeck_speed_m_per_s
        bend = (breakaway - coulomb) * exp(-ratio * ratio)
    return bearing * (coulomb + bend)


@_inlined
def _rate(model, condition, state, demand_nm, noise, direction, tension, elastic, speed, rho, rate):
    """Fill `rate` (5n + 3,) with the derivative of the state. `direction` is the sign of each roller's motion."""
    n = model.radius_m.size
    _web_rate(model, condition, state, elastic, speed, rate)
    for i in range(n):
        w, m, bearing = state[n + i], state[3 * n + i], _bearing(condition, i)
        radius, web_gain, friction_rate, torque_gain = _roller(model, state, i)
        dry_nm = 0.0
        if model.breakaway_nm[i] > 0.0:
            dry_nm = direction[i] * _dry_friction_nm(model, bearing, i, w)
        rate[n + i] = (
            web_gain * rho[i] * (tension[i + 2] - tension[i + 1])
            - bearing * friction_rate * w
            + torque_gain * (m - dry_nm)
            + model.disturbance_m_per_s2[i] * noise[i]
        )
        if model.breakaway_nm[i] > 0.0 and direction[i] == 0.0:
            rate[n + i] = 0.0
        rate[3 * n + i] = model.lag_rate_per_s * (demand_nm[i] - m)
        rate[4 * n + i] = w / radius
    _reel_rate(model, state, speed, rho, rate)


@_inlined
def _reel_rate(model, state, speed, rho, rate):
    """The rest of `rate`: the reels' radii, the surface speed that a growing one gains, the unwinder's angle."""
    n = model.radius_m.size
    rate[5 * n + 1] = rate[5 * n + 2] = 0.0
    if model.area_per_length_m > 0.0:
        if state[5 * n + 1] > model.core_area_m2 or speed[0] < 0.0:
            rate[5 * n + 1] = -model.area_per_length_m * speed[0]
        rate[5 * n + 2] = model.area_per_length_m * speed[n]
        rate[2 * n - 1] += 0.5 * state[2 * n - 1] * rate[5 * n + 2] / state[5 * n + 2]
    rate[5 * n] = speed[0] / rho[n] / sqrt(state[5 * n + 1])


@_inlined
def _decide_motion(model, condition, state, tension, rho, direction):
    """The sign of each roller's motion in this step; 0 for one that dry friction holds."""
    n = direction.size
    for i in range(n):
        if model.breakaway_nm[i] == 0.0:
            continue
        w = state[n + i]
        if w != 0.0:
            direction[i] = 1.0 if w > 0.0 else -1.0
            continue
        radius = _roller(model, state, i)[0]
        torque = radius * rho[i] * (tension[i + 2] - tension[i + 1]) + state[3 * n + i]
        holds = abs(torque) <= _bearing(condition, i) * model.breakaway_nm[i]
        direction[i] = 0.0 if holds else 1.0 if torque > 0.0 else -1.0


@_inlined
def _end_step(model, state, direction):
    """Stop the rollers that friction has brought to rest, and keep the angles small."""
    n = direction.size
    for i in range(n):
        if model.breakaway_nm[i] > 0.0 and direction[i] * state[n + i] <= 0.0:
            state[n + i] = 0.0
    for j in range(4 * n, 5 * n + 1):
        state[j] %= _FULL_TURN_RAD


@_inlined
def _demand(model, state, held, demand_nm):
    """What the drives are asked for, in their steps; without lag it acts at once."""
    n = demand_nm.size
    for i in range(n):
        demand_nm[i] = held[i]
        if model.torque_step_nm > 0.0:
            demand_nm[i] = model.torque_step_nm * np.rint(held[i] / model.torque_step_nm)
        if model.lag_rate_per_s == 0.0:
            state[3 * n + i] = demand_nm[i]


@compiled
def integrate_full(model, condition, state, inputs, noise, trace, web):
    """As `physics.integrate`, for the full model: `state` (5n + 3,), wear and friction of the `condition` advance in
    place.

    Row r of `trace` (m, 3n+1) becomes [T, v, m, v_0], tensions, the web's speeds, the drives' torques and the web's
    speed at the unwinder at the end of step r. `web` (2n,) becomes [T, v] at the end, also when there is no step.
    """
    width, n = state.size, model.radius_m.size
    k, probe = np.zeros((4, width)), np.empty(width)
    tension, elastic, speed = np.empty(n + 2), np.empty(n + 1), np.empty(n + 1)
    rho, direction, demand_nm = np.empty(n + 1), np.zeros(n), np.empty(n)
    held = inputs[VALUE]
    _web(model, condition, state, held[n], tension, elastic, speed, rho)
    for r in range(noise.shape[0]):
        slew(inputs)
        slew(condition.wear)
        slew(condition.friction)
        _demand(model, state, held, demand_nm)
        _decide_motion(model, condition, state, tension, rho, direction)
        for stage in range(4):
            for j in range(width):
                probe[j] = state[j] + _REACH[stage] * STEP_S * k[stage - 1, j]
            _web(model, condition, probe, held[n], tension, elastic, speed, rho)
            _rate(model, condition, probe, demand_nm, noise[r], direction, tension, elastic, speed, rho, k[stage])
        for j in range(width):
            state[j] += STEP_S / 6.0 * (k[0, j] + 2.0 * k[1, j] + 2.0 * k[2, j] + k[3, j])
        _end_step(model, state, direction)
        _web(model, condition, state, held[n], tension, elastic, speed, rho)
        for i in range(n):
            trace[r, i], trace[r, n + i], trace[r, 2 * n + i] = tension[i + 1], speed[i + 1], state[3 * n + i]
        trace[r, 3 * n] = speed[0]
    for i in range(n):
        web[i], web[n + i] = tension[i + 1], speed[i + 1]
