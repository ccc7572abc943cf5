"""Recordings of the paper's two equations under torques that are given, by an integrator of the tests' own."""

import numpy as np

from gateway.core.line import Line
from gateway.core.recording import Recording
from gateway.core.web_model import WebModel, equilibrium_torque, reference_speeds

STEP_S = 0.001


def true_model(n=6, spread=0.0, seed=0):
    """S_real, or with rollers and spans that differ."""
    generator = np.random.default_rng(seed)

    def each(value):
        return value * (1.0 + spread * generator.uniform(-1.0, 1.0, n))

    return WebModel(2200.0, each(1.2), each(0.035), each(1.0), each(15.0))


def shaken(
    line: Line, model: WebModel, duration_s=5.0, noise=None, seed=0, amplitude_nm=3.0, unwind=0.05, coulomb_nm=0.0
) -> Recording:
    """Torques move at random around those of the equilibrium at 30 N, every 50 ms, up and then down.

    `noise`: a `Noise`, or None for none.
    """
    generator = np.random.default_rng(seed)
    n, period_s = model.n, line.control.period_s
    periods = round(duration_s / period_s)
    goal = np.full(n, 30.0)
    speed = reference_speeds(model, goal, unwind)
    center = equilibrium_torque(model, goal, speed) + coulomb_nm
    dwell = max(round(0.05 / period_s), 1)
    signs = generator.choice([-1.0, 1.0], (periods // (2 * dwell) + 1, n))
    moves = np.repeat(np.stack((signs, -signs), axis=1).reshape(-1, n), dwell, axis=0)[:periods]
    torque = center + amplitude_nm * moves
    states = _integrated(model, np.concatenate((goal, speed)), torque, unwind, line, noise, generator, coulomb_nm)
    tension, rolls = states[:, :n], states[:, n:]
    unwound = np.full(periods, unwind)
    if noise is not None:
        tension = tension + noise.tension_n * generator.standard_normal(tension.shape)
        rolls = rolls + noise.speed_m_per_s * generator.standard_normal(rolls.shape)
        unwound = unwound + noise.speed_m_per_s * generator.standard_normal(periods)
    return Recording(
        period_s * np.arange(periods), tension, np.tile(goal, (periods, 1)), rolls, torque, torque, unwound,
        np.ones(periods, dtype=bool), period_s, "shaken",
    )  # fmt: skip


def _integrated(model, state, torque, unwind, line, noise, generator, coulomb_nm):
    """States (k, 2n) at the samples; RK4. The torque of a sample acts after the latency, at first the first one."""
    steps, late = round(line.control.period_s / STEP_S), round(line.control.latency_s / STEP_S)
    found = np.empty((len(torque), 2 * model.n))
    acting = np.repeat(torque, steps, axis=0)
    acting = np.concatenate((np.tile(torque[0], (late, 1)), acting))
    for k in range(len(torque) * steps):
        if k % steps == 0:
            found[k // steps] = state
        push = np.zeros(model.n)
        if noise is not None:
            push = noise.acceleration_m_per_s1_5 / np.sqrt(STEP_S) * generator.standard_normal(model.n)

        def rate(x, u=acting[k], w=push):
            return _rate(model, x, u, unwind, coulomb_nm) + np.concatenate((np.zeros(model.n), w))

        a = rate(state)
        b = rate(state + 0.5 * STEP_S * a)
        c = rate(state + 0.5 * STEP_S * b)
        d = rate(state + STEP_S * c)
        state = state + STEP_S / 6.0 * (a + 2.0 * b + 2.0 * c + d)
    return found


def _rate(model, state, torque, unwind, coulomb_nm):
    n = model.n
    tension = np.concatenate(([model.tension_before_n], state[:n], [model.tension_after_n]))
    speed = np.concatenate(([unwind], state[n:]))
    flow = tension[:-1] * speed
    stretch = (model.stiffness_n * np.diff(speed) + flow[:-1] - tension[1:-1] * speed[1:]) / model.length_m
    radius, inertia = model.radius_m, model.inertia_kg_m2
    turn = radius**2 * np.diff(tension[1:]) - model.friction_nms_per_rad * speed[1:]
    return np.concatenate((stretch, (turn + radius * (torque - coulomb_nm * np.sign(speed[1:]))) / inertia))
