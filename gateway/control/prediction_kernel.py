"""The compiled predictor: the line between two samples, the Kalman gains along a recording, and the innovations."""

# pyright: standard
# (numba infers the types of what it compiles; there is nothing to annotate them with)

from math import exp, sqrt, tanh
from typing import Any

import numpy as np
from numba import njit

_compiled: Any = njit(cache=True, error_model="numpy", fastmath={"contract"})
# LLVM sees through an inlined function that its arrays do not overlap.
_inlined: Any = njit(error_model="numpy", fastmath={"contract"}, inline="always")

#: Rows of the coefficients (6, n): EA, 1/L, R^2/J, f/J, R/J and c R/J.
_STIFFNESS, _PER_LENGTH, _WEB, _FRICTION, _TORQUE, _COULOMB = range(6)
#: Of the table of times: lag, latency, period, width of the friction's sign in m/s, longest step of the integration.
_LAG, _LATENCY, _PERIOD, _WIDTH, _STEP = range(5)


@_inlined
def _rate(coefficients, boundary, width, round_, unwind, given, state, probe, rate):
    """d[T; w]/dt, where the speeds are w + `given`: what the torque has added since the step began.

    The web runs at `round_` times a roller's mean surface speed, and pulls at as much of its mean radius.
    """
    n = coefficients.shape[1]
    for i in range(n):
        probe[i] = state[n + i] + given[i]
    for i in range(n):
        tension_up = state[i - 1] if i > 0 else boundary[0]
        speed_up = round_[i - 1] * probe[i - 1] if i > 0 else unwind
        tension_down = state[i + 1] if i + 1 < n else boundary[1]
        tension, speed, web_speed = state[i], probe[i], round_[i] * probe[i]
        rate[i] = coefficients[_PER_LENGTH, i] * (
            coefficients[_STIFFNESS, i] * (web_speed - speed_up) + tension_up * speed_up - tension * web_speed
        )
        pulled = coefficients[_WEB, i] * round_[i] * (tension_down - tension)
        rate[n + i] = pulled - coefficients[_FRICTION, i] * speed
        if coefficients[_COULOMB, i] > 0.0:
            rate[n + i] -= coefficients[_COULOMB, i] * tanh(speed / width)


@_inlined
def _impulse(coefficients, lag, fade, span, acting, sent, given):
    """R/J times the integral of the torque over `span` seconds, exactly. `fade` is exp(-span / lag)."""
    for i in range(acting.size):
        given[i] = coefficients[_TORQUE, i] * (sent[i] * span + (acting[i] - sent[i]) * lag * (1.0 - fade))


@_inlined
def _step(coefficients, boundary, width, lag, span, fades, round_, unwinds, acting, sent, state, work):
    """One step of RK4 over `span` seconds. The torque, a lag behind `sent`, is integrated exactly."""
    k1, k2, k3, k4, trial, probe = work[0], work[1], work[2], work[3], work[4], work[5]
    given, n = work[6], acting.size
    for i in range(n):
        given[i] = 0.0
    _rate(coefficients, boundary, width, round_, unwinds[0], given, state, probe, k1)
    _impulse(coefficients, lag, fades[0], 0.5 * span, acting, sent, given)
    for j in range(2 * n):
        trial[j] = state[j] + 0.5 * span * k1[j]
    _rate(coefficients, boundary, width, round_, unwinds[1], given, trial, probe, k2)
    for j in range(2 * n):
        trial[j] = state[j] + 0.5 * span * k2[j]
    _rate(coefficients, boundary, width, round_, unwinds[1], given, trial, probe, k3)
    _impulse(coefficients, lag, fades[1], span, acting, sent, given)
    for j in range(2 * n):
        trial[j] = state[j] + span * k3[j]
    _rate(coefficients, boundary, width, round_, unwinds[2], given, trial, probe, k4)
    for j in range(2 * n):
        state[j] += span / 6.0 * (k1[j] + 2.0 * k2[j] + 2.0 * k3[j] + k4[j])
    for i in range(n):
        state[n + i] += given[i]
        acting[i] = sent[i] + (acting[i] - sent[i]) * fades[1]


@_inlined
def _fade(span, lag):
    return exp(-span / lag) if lag > 0.0 else 0.0


@_inlined
def _period(coefficients, boundary, times, before, now, unwind, turned, acting, state, work):
    """A period: the torques `before` act until `now` have arrived. `unwind` (2,): v0 at its begin and end; `turned`
    (2, n): the radii under the web over their means."""
    lag, period = times[_LAG], times[_PERIOD]
    arrival = times[_LATENCY] % period
    fades, unwinds, round_ = np.empty(2), np.empty(3), work[7]
    for piece in range(2):
        begin, end = (0.0, arrival) if piece == 0 else (arrival, period)
        sent = before if piece == 0 else now
        if end - begin < 1e-9 * period:
            continue
        steps = max(int(np.ceil((end - begin) / times[_STEP] - 1e-9)), 1)
        span = (end - begin) / steps
        fades[0], fades[1] = _fade(0.5 * span, lag), _fade(span, lag)
        for step in range(steps):
            for stage in range(3):
                share = (begin + (step + 0.5 * stage) * span) / period
                unwinds[stage] = unwind[0] + share * (unwind[1] - unwind[0])
            share = (begin + (step + 0.5) * span) / period
            for i in range(acting.size):
                round_[i] = turned[0, i] + share * (turned[1, i] - turned[0, i])
            _step(coefficients, boundary, times[_WIDTH], lag, span, fades, round_, unwinds, acting, sent, state, work)


@_compiled
def follow(
    coefficients, boundary, times, radii, torque, unwind, first, start, seen, measured, gains, which, innovations,
    predicted,
):  # fmt: skip
    """For every column b of `coefficients` (b, 6, n), `times` (b, 5) and `radii` (b, k, n), those under the web at the
    samples over their means, from sample `first` to the last one.

    `torque` (k, n), `unwind` (k, 2) in the period from each sample on, `start` (2n,) the state at `first`, `seen` (m,)
    which states are measured, `measured` (k, m), `gains` (g, 2n, m), `which` (k,) of them at each sample. Fills
    `innovations` (b, k - first - 1, m) and, where it is not empty, `predicted` (b, k - first - 1, 2n).
    """
    columns, samples, n = coefficients.shape[0], torque.shape[0], torque.shape[1]
    state, acting, work = np.empty(2 * n), np.empty(n), np.empty((8, 2 * n))
    for column in range(columns):
        own, clock = coefficients[column], times[column]
        depth = int(np.floor(clock[_LATENCY] / clock[_PERIOD] + 1e-9))
        clock[_LATENCY] = max(clock[_LATENCY] - depth * clock[_PERIOD], 0.0)
        _settle(own, clock, torque, first, depth, acting)
        state[:] = start
        for k in range(first, samples - 1):
            _period(
                own, boundary, clock, torque[k - depth - 1], torque[k - depth], unwind[k], radii[column, k : k + 2],
                acting, state, work,
            )  # fmt: skip
            row = k - first
            if predicted.size > 0:
                predicted[column, row] = state
            for j in range(seen.size):
                innovations[column, row, j] = measured[k + 1, j] - state[seen[j]]
            gain = gains[which[k + 1]]
            for s in range(2 * n):
                for j in range(seen.size):
                    state[s] += gain[s, j] * innovations[column, row, j]


@_inlined
def _settle(coefficients, clock, torque, first, depth, acting):
    """The torques that act at sample `first`, as those sent before it have left them."""
    arrival, period = clock[_LATENCY], clock[_PERIOD]
    early, late = _fade(arrival, clock[_LAG]), _fade(period - arrival, clock[_LAG])
    acting[:] = torque[0]
    for k in range(depth + 1, first):
        for i in range(acting.size):
            old, new = torque[k - depth - 1, i], torque[k - depth, i]
            acting[i] = new + (old + (acting[i] - old) * early - new) * late


@_compiled
def imagine(
    coefficients, boundary, times, radii, torque, unwind, first, start, seen, gains, which, innovations, outputs
):  # fmt: skip
    """As `follow` for one column, the other way about: the outputs (k - first - 1, m) of a line with these innovations.

    It is the innovations form of the model, whose outputs are distributed as those of the line itself.
    """
    n = torque.shape[1]
    state, acting, work = start.copy(), np.empty(n), np.empty((8, 2 * n))
    depth = int(np.floor(times[_LATENCY] / times[_PERIOD] + 1e-9))
    times[_LATENCY] = max(times[_LATENCY] - depth * times[_PERIOD], 0.0)
    _settle(coefficients, times, torque, first, depth, acting)
    for k in range(first, torque.shape[0] - 1):
        _period(
            coefficients, boundary, times, torque[k - depth - 1], torque[k - depth], unwind[k], radii[k : k + 2],
            acting, state, work,
        )  # fmt: skip
        row = k - first
        gain = gains[which[k + 1]]
        for j in range(seen.size):
            outputs[row, j] = state[seen[j]] + innovations[row, j]
        for s in range(2 * n):
            for j in range(seen.size):
                state[s] += gain[s, j] * innovations[row, j]


@_inlined
def _inverse_cholesky(covariance, root, inverse):
    """`inverse` of the lower `root` of `covariance`; False when it is not positive definite."""
    m = covariance.shape[0]
    root[:] = 0.0
    for i in range(m):
        for j in range(i + 1):
            total = covariance[i, j]
            for p in range(j):
                total -= root[i, p] * root[j, p]
            if i == j:
                if not total > 0.0:
                    return False
                root[i, i] = sqrt(total)
            else:
                root[i, j] = total / root[j, j]
    inverse[:] = 0.0
    for i in range(m):
        inverse[i, i] = 1.0 / root[i, i]
        for j in range(i):
            total = 0.0
            for p in range(j, i):
                total -= root[i, p] * inverse[p, j]
            inverse[i, j] = total / root[i, i]
    return True


@_compiled
def kalman(transitions, intensities, point, noise, seen, covariance, first, tolerance, gains, factors, roots, which):
    """Gains from the Riccati recursion along a recording; returns how many there are.

    `transitions` F and `intensities` Q (p, s, s) of the operating points, `point` (k,) which of them holds from each
    sample on, `noise` (m,) variances of the outputs, `covariance` (s, s) of the state at sample `first`. The recursion
    rests when no variance changes by more than `tolerance` of itself in a period, until the operating point changes.
    Fills `gains` (g, s, m), the lower Cholesky `factors` of S (g, m, m), their inverses `roots`, and `which` (k,).
    Returns -1 when a covariance is not positive definite.
    """
    s, m = covariance.shape[0], seen.size
    spread = np.empty((m, m))
    crossed = np.empty((m, s))
    found, rests = 0, False
    for k in range(first, point.size - 1):
        if rests and point[k] == point[k - 1]:
            which[k + 1] = found - 1
            continue
        F = transitions[point[k]]
        before = covariance
        covariance = F @ covariance @ F.T + intensities[point[k]]
        for i in range(m):
            for j in range(m):
                spread[i, j] = covariance[seen[i], seen[j]]
            spread[i, i] += noise[i]
            crossed[i] = covariance[seen[i]]
        if not _inverse_cholesky(spread, factors[found], roots[found]):
            return -1
        whitened = roots[found] @ crossed
        gains[found] = whitened.T @ roots[found]
        covariance -= whitened.T @ whitened
        which[k + 1] = found
        found += 1
        rests = True
        for j in range(s):
            rests = rests and abs(covariance[j, j] - before[j, j]) <= tolerance * covariance[j, j]
    return found


@_compiled
def estimate_swing(white, response, drift, covariance, swing, found, spread, after):
    """The separate-bias estimator along whitened innovations (k, m) that belong to no swing at all.

    `response` (k, m, q): what one of each swing would add to them; `covariance` (q, q) of the swings before any sample,
    which grows by `drift` (k, q) on its diagonal from sample to sample; `swing` (q,) the mean, which is moved on. Fills
    `found` (k, m), the innovations that are left, of unit covariance; `spread` (k, m, m), what the doubt about the
    swings adds to the unit covariance; and `after` (k, q), the swings once each sample is seen.
    """
    samples, m, q = response.shape
    total, root, inverse = np.empty((m, m)), np.empty((m, m)), np.empty((m, m))
    for k in range(samples):
        for j in range(q):
            covariance[j, j] += drift[k, j]
        crossed = response[k] @ covariance
        spread[k] = crossed @ response[k].T
        total[:] = spread[k]
        for i in range(m):
            total[i, i] += 1.0
        if not _inverse_cholesky(total, root, inverse):
            return False
        found[k] = inverse @ (white[k] + response[k] @ swing)
        gain = inverse @ crossed
        swing -= gain.T @ found[k]
        covariance -= gain.T @ gain
        after[k] = swing
    return True


@_compiled
def whiten(innovations, roots, which, out):
    """`out` (b, k, m): innovations (b, k, m) by the roots (g, m, m) that hold at their samples (k,)."""
    for column in range(innovations.shape[0]):
        for k in range(innovations.shape[1]):
            root = roots[which[k]]
            for i in range(root.shape[0]):
                total = 0.0
                for j in range(i + 1):
                    total += root[i, j] * innovations[column, k, j]
                out[column, k, i] = total
