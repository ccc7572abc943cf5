"""A Kalman predictor that shares no code with the product's: small steps, the torque lag as a state, plain matrices."""

import numpy as np

from gateway.core.recording import Recording
from gateway.core.theta import Noise, Theta

STEP_S = 1e-4


def rate(theta: Theta, x, unwind):
    """d[T; v; m]/dt without the torque's own rate: the paper's equations, roller by roller."""
    n, web = theta.n, theta.web
    found = np.zeros(2 * n)
    for i in range(n):
        tension, speed = x[i], x[n + i]
        before = x[i - 1] if i else web.tension_before_n
        slower = x[n + i - 1] if i else unwind
        after = x[i + 1] if i + 1 < n else web.tension_after_n
        radius, inertia = web.radius_m[i], web.inertia_kg_m2[i]
        found[i] = (web.stiffness_n * (speed - slower) + before * slower - tension * speed) / web.length_m[i]
        drive = x[2 * n + i] - theta.coulomb_nm[i] * np.tanh(speed / 1e-3)
        found[n + i] = (radius**2 * (after - tension) - web.friction_nms_per_rad[i] * speed + radius * drive) / inertia
    return found


def later(theta: Theta, x, sent, unwind_at, duration_s):
    """[T; v; m] after small steps of Runge-Kutta; `sent(t)` is what the drives are told, a lag before it comes."""
    n, lag = theta.n, theta.torque_lag_s

    def slope(y, held, unwind):
        torque_rate = (held - y[2 * n :]) / lag if lag else np.zeros(n)
        return np.concatenate((rate(theta, y, unwind), torque_rate))

    for t in np.arange(round(duration_s / STEP_S)) * STEP_S:
        middle = t + 0.5 * STEP_S
        held = sent(middle)  # it changes between two steps only
        if not lag:
            x = np.concatenate((x[: 2 * n], held))
        a = slope(x, held, unwind_at(t))
        b = slope(x + 0.5 * STEP_S * a, held, unwind_at(middle))
        c = slope(x + 0.5 * STEP_S * b, held, unwind_at(middle))
        d = slope(x + STEP_S * c, held, unwind_at(t + STEP_S))
        x = x + STEP_S / 6.0 * (a + 2.0 * b + 2.0 * c + d)
    return x


def sampled(theta: Theta, noise: Noise, at, unwind, period_s):
    """F by differences of the flow, Q by summing what white noise in each small step has become."""
    n = theta.n
    torque = np.zeros(n)

    def flow(x, duration_s):
        whole = later(theta, np.concatenate((x, torque)), lambda t: torque, lambda t: unwind, duration_s)
        return whole[: 2 * n]

    def jacobian(duration_s):
        size = 1e-5
        columns = [(flow(at + size * e, duration_s) - flow(at - size * e, duration_s)) / (2 * size) for e in
                   np.eye(2 * n)]  # fmt: skip
        return np.array(columns).T

    W = np.zeros((2 * n, 2 * n))
    W[n:, n:] = noise.acceleration_m_per_s1_5**2 * np.eye(n)
    stretch = (theta.web.stiffness_n - theta.web.tension_before_n) / theta.web.length_m[0]
    W[0, 0] = (stretch * noise.speed_m_per_s) ** 2 * period_s
    F, Q, slices = jacobian(period_s), np.zeros((2 * n, 2 * n)), 10
    for i in range(slices):
        spread = jacobian(round((i + 0.5) * period_s / slices / STEP_S) * STEP_S)
        Q += spread @ W @ spread.T * period_s / slices
    return F, Q


def innovations(theta: Theta, noise: Noise, recording: Recording, first: int, *, linear: bool, spread_n: float = 10.0):
    """Innovations (k, m) and their covariances (k, m, m) from sample `first` + 1 on."""
    n, period_s = theta.n, recording.period_s
    signals = np.hstack((recording.tension_n, recording.speed_m_per_s))
    seen = np.flatnonzero(~np.isnan(signals[0]))
    C = np.eye(2 * n)[seen]
    R = np.diag(np.where(seen < n, noise.tension_n, noise.speed_m_per_s) ** 2)
    start = np.where(np.isnan(signals[first]), np.hstack((recording.tension_setpoint_n[first],) * 2), signals[first])
    P = np.diag(np.where(np.isnan(signals[0]), spread_n**2, 0.0)) + C.T @ R @ C
    middle = np.where(np.isnan(signals).any(axis=0), start, signals.mean(axis=0))
    F, Q = sampled(theta, noise, middle, recording.unwind_speed_m_per_s.mean(), period_s)

    def sent_since(k):
        def sent(t):
            return recording.torque_nm[max(int(np.floor((k * period_s + t - theta.latency_s) / period_s + 1e-9)), 0)]

        return sent

    x = np.concatenate((start, recording.torque_nm[0]))
    torque = recording.torque_nm[0]
    for k in range(first):  # what the torques have become by then
        whole = later(theta, np.concatenate((start, torque)), sent_since(k), lambda t: 0.0, period_s)
        torque = whole[2 * n :]
    x = np.concatenate((start, torque))
    found, covariances = [], []
    for k in range(first, recording.samples - 1):
        begin, end = recording.unwind_speed_m_per_s[[k, k + 1 if linear else k]]
        x = later(theta, x, sent_since(k), lambda t, b=begin, e=end: b + (e - b) * t / period_s, period_s)
        P = F @ P @ F.T + Q
        S = C @ P @ C.T + R
        K = P @ C.T @ np.linalg.inv(S)
        e = signals[k + 1, seen] - C @ x[: 2 * n]
        x[: 2 * n] += K @ e
        P = (np.eye(2 * n) - K @ C) @ P
        found.append(e)
        covariances.append(S)
    return np.array(found), np.array(covariances)
