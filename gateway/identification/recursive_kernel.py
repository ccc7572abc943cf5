"""The compiled part of the recursive estimator: one period into the filters and normal equations of all rollers.

Rows 0 .. n-1 of what is kept are rollers, rows n .. 2n-1 spans, which use the first two of four columns.
"""

from typing import Any

import numpy as np
from numba import njit

SLOW_S = 0.5  #: over which a tension's mean and variance are taken
MOVES = 9.0  #: times the variance of its noise, from which on a tension moves

# numba's decorator has no types; what it returns is called as the function it decorates.
compiled: Any = njit(cache=True, error_model="numpy")


@compiled
def age(keep, drift, information, moment, sums):
    """Let time pass: all counts `keep` times what it did, and each row's c walks by `drift` (2, 4) times N(0, 1).

    That of rollers and of spans. The walk is marginalised: M - M d d' M / (1 + d' M d), which needs no inverse, so that
    M may be singular.
    """
    n = len(sums) // 2
    product = np.empty(4)
    for row in range(2 * n):
        d = drift[row // n]
        size, met = 1.0, 0.0
        for a in range(4):
            product[a] = 0.0
            for b in range(4):
                product[a] += information[row, a, b] * d[b]
            size += product[a] * d[a]
            met += moment[row, a] * d[a]
        sums[row, 0] = keep * (sums[row, 0] - met * met / size)
        sums[row, 1] *= keep
        for a in range(4):
            moment[row, a] = keep * (moment[row, a] - product[a] * met / size)
            for b in range(4):
                information[row, a, b] = keep * (information[row, a, b] - product[a] * product[b] / size)


@compiled
def take_in(speed, tension, torque, period_s, noise, filters, information, moment, sums):
    """The period from sample [0] to [1] of `speed` (2, n+1), v_0 .. v_n, and `tension` (2, n+2), T_0 .. T_{n+1}.

    `torque` (n,) stands for what acted in it. `noise` (2, 2): for rollers and for spans, the variance of what moves one
    within a period beside its regressors, and that of a sample. `filters` (2n, 8), `information` (2n, 4, 4), `moment`
    (2n, 4) and `sums` (2n, 2) are changed.
    """
    n = torque.size
    regressor = np.empty(4)
    half_s = 0.5 * period_s
    for i in range(n):
        v = speed[0, i + 1]
        regressor[0] = -period_s * v
        regressor[1] = period_s * torque[i]
        regressor[2] = half_s * (tension[0, i + 2] - tension[0, i + 1] + tension[1, i + 2] - tension[1, i + 1])
        regressor[3] = -period_s * np.sign(v)
        _filter(i, v, speed[1, i + 1], regressor, 4, 0.0, noise[0], filters, information, moment, sums)
    for i in range(n):
        up, own = speed[0, i] + speed[1, i], speed[0, i + 1] + speed[1, i + 1]
        if i == 0:
            up = 2.0 * speed[0, 0]  # the line PLC holds what it was asked for
        flow = (tension[0, i] + tension[1, i]) * up - (tension[0, i + 1] + tension[1, i + 1]) * own
        regressor[0] = half_s * (own - up)
        regressor[1] = 0.5 * half_s * flow
        _filter(
            n + i,
            tension[0, i + 1],
            tension[1, i + 1],
            regressor,
            2,
            period_s / SLOW_S,
            noise[1],
            filters,
            information,
            moment,
            sums,
        )


@compiled
def _filter(row, before, now, regressor, columns, slow, noise, filters, information, moment, sums):
    """A step of the Kalman filter of z_{k+1} = z_k + regressor' c + w_k; its innovation is a row of least squares.

    The filter is linear, so that its prediction is p + s' c with p, s free of c: `filters` keeps p, s, and the variance
    (0: not started). The innovations are white, wherefore least squares on them is without bias. With `slow` above 0,
    z counts only while it moves by more than its noise, judged by a mean and a variance over 1 / `slow` periods.
    """
    known = np.isfinite(before) and np.isfinite(now)
    for a in range(columns):
        known = known and np.isfinite(regressor[a])
    state = filters[row]
    if not known:
        state[5] = 0.0
        return
    moves, sample = noise[0], noise[1]
    if state[5] == 0.0:
        state[:] = 0.0
        state[4], state[5], state[6] = before, sample, before
    variance = state[5] + moves
    weight = 1.0 / (variance + sample)
    gain = variance * weight
    innovation = now - state[4]
    for a in range(columns):
        state[a] += regressor[a]
    state[6] += slow * (now - state[6])
    state[7] += slow * ((now - state[6]) ** 2 - state[7])
    if slow == 0.0 or state[7] > MOVES * sample:
        for a in range(columns):
            moment[row, a] += weight * innovation * state[a]
            for b in range(columns):
                information[row, a, b] += weight * state[a] * state[b]
        sums[row, 0] += weight * innovation * innovation
        sums[row, 1] += 1.0
    for a in range(columns):
        state[a] *= 1.0 - gain
    state[4] += gain * innovation
    state[5] = variance * (1.0 - gain)
