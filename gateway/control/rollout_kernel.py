"""The compiled closed loop of linear laws: many plants at once, eight side by side in the processor's vector units.

Arrays are (row, lane): each operation on a state of one plant is the same for the plants beside it. The law's matrices
are read as lists of their non-zero entries. All that is compiled stands in this one file: numba's cache looks at the
file of the function that it keeps, not at those of the functions inside it.
"""

# pyright: standard
# (numba infers the types of what it compiles; there is nothing to annotate them with)

from math import inf, pi
from typing import Any

import numpy as np
from numba import njit, prange

LANES = 8
LOOKED_AT = 8  #: periods, after which blocks that have run away are left

# numba's decorator has no types; what it returns is called as the function it decorates. Whether to inline is left to
# LLVM: one large function has too many arrays for it to see that they do not overlap, and becomes scalar code.
_part: Any = njit(error_model="numpy", fastmath={"contract"})
_alone: Any = njit(cache=True, error_model="numpy", fastmath={"contract"})
_parallel: Any = njit(parallel=True, cache=True, error_model="numpy", fastmath={"contract"})

# Rows of what the kernel accumulates for each roller or span.
(
    SQUARED, LEAST, MOST, LAST, BEYOND, TORQUE, STEP, EFFORT, TAIL_LEAST, TAIL_MOST, TAIL_ERROR, TAIL_MOVES, SPEED,
) = range(13)  # fmt: skip
ROWS = 13


@_part
def _stretching(stiffness, per_length, tension_up, speed_up, tension, speed):
    """dT/dt of a span: eq. web_tension_dynamics."""
    return per_length * (stiffness * (speed - speed_up) + tension_up * speed_up - tension * speed)


@_part
def _rate(coefficients, boundary, state, torque, unwind, rate, n):
    """d[T; v]/dt for all lanes; rows of `coefficients` are EA, 1/L, R^2/J, f/J, R/J, n each."""
    for i in range(n):
        for w in range(LANES):
            tension_up = state[i - 1, w] if i > 0 else boundary[0, w]
            speed_up = state[n + i - 1, w] if i > 0 else unwind
            tension_down = state[i + 1, w] if i + 1 < n else boundary[1, w]
            tension, speed = state[i, w], state[n + i, w]
            rate[i, w] = _stretching(coefficients[i, w], coefficients[n + i, w], tension_up, speed_up, tension, speed)
            rate[n + i, w] = (
                coefficients[2 * n + i, w] * (tension_down - tension)
                - coefficients[3 * n + i, w] * speed
                + coefficients[4 * n + i, w] * torque[i, w]
            )


@_part
def _product(begins, columns, values, vector, out):
    """out = matrix @ vector for all lanes."""
    for row in range(begins.size - 1):
        for w in range(LANES):
            out[row, w] = 0.0
        for entry in range(begins[row], begins[row + 1]):
            value, column = values[entry], columns[entry]
            for w in range(LANES):
                out[row, w] += value * vector[column, w]


@_part
def _see(state, samples, reference, steps, signals, size, n):
    """Errors as measured, and the reference, into `signals` [z; e; x_ref; u_ref; u_applied]."""
    for j in range(2 * n):
        for w in range(LANES):
            seen = state[j, w] + samples[j]
            if steps[j] > 0.0:
                seen = np.round(seen / steps[j]) * steps[j]
            signals[size + j, w] = seen - reference[j]
    for j in range(3 * n):
        for w in range(LANES):
            signals[size + 2 * n + j, w] = reference[j]


@_part
def _limit(asked, before, most_nm, reach_nm, applied, n):
    """What the envelope lets through."""
    for i in range(n):
        for w in range(LANES):
            was = before[i, w]
            held = min(max(asked[i, w], -most_nm[i]), most_nm[i])
            applied[i, w] = min(max(held, was - reach_nm), was + reach_nm)


@_part
def _send(applied, before, late, sent, n):
    """The torque that acts when this period's is due: where that is late, the one before it."""
    for i in range(n):
        for w in range(LANES):
            sent[i, w] = before[i, w] if late[i] else applied[i, w]


@_part
def _account(state, reference, applied, before, sums, n):
    """Torques and errors of a period."""
    for i in range(n):
        for w in range(LANES):
            now, error = applied[i, w], state[i, w] - reference[i]
            sums[TORQUE, i, w] = max(sums[TORQUE, i, w], abs(now))
            sums[STEP, i, w] = max(sums[STEP, i, w], abs(now - before[i, w]))
            sums[EFFORT, i, w] += now * now
            sums[SQUARED, i, w] += error * error


@_part
def _account_change(state, reference, band, direction, since, last, sums, n):
    """Settling and overshoot, `since` periods after a change; in the `last` one it is to have settled."""
    for i in range(n):
        for w in range(LANES):
            error = state[i, w] - reference[i]
            if abs(error) > band[i]:
                sums[LAST, i, w] = inf if last else max(sums[LAST, i, w], since + 1.0)
            past = abs(error) if direction[i] == 0.0 else direction[i] * error
            sums[BEYOND, i, w] = max(sums[BEYOND, i, w], past)


@_part
def _account_tail(state, reference, applied, before, sums, n):
    """Mean error, and how much the torques move where nothing should."""
    for i in range(n):
        for w in range(LANES):
            move = applied[i, w] - before[i, w]
            sums[TAIL_ERROR, i, w] += state[i, w] - reference[i]
            sums[TAIL_MOVES, i, w] += move * move


@_part
def _extremes(state, least, most, n):
    for i in range(n):
        for w in range(LANES):
            least[i, w] = min(least[i, w], state[i, w])
            most[i, w] = max(most[i, w], state[i, w])


@_part
def _fastest(state, most, n):
    for i in range(n):
        for w in range(LANES):
            most[i, w] = max(most[i, w], abs(state[n + i, w]))


@_part
def _account_step(state, sums, in_tail, n):
    """Tensions and rollers' speeds of a step of the integration."""
    _extremes(state, sums[LEAST], sums[MOST], n)
    _fastest(state, sums[SPEED], n)
    if in_tail:
        _extremes(state, sums[TAIL_LEAST], sums[TAIL_MOST], n)


@_part
def _gone(least, most, runaway_n, n):
    """Whether all plants of a block have run away."""
    for w in range(LANES):
        held = True
        for i in range(n):
            held &= least[i, w] >= -runaway_n and most[i, w] <= runaway_n  # nan is neither
        if held:
            return False
    return True


@_part
def _added(state, factor, slope, out):
    """out = state + factor slope"""
    for j in range(state.shape[0]):
        for w in range(LANES):
            out[j, w] = state[j, w] + factor * slope[j, w]


@_part
def _summed(state, slopes, step_s):
    """The end of a step of RK4."""
    k1, k2, k3, k4 = slopes[0], slopes[1], slopes[2], slopes[3]
    for j in range(state.shape[0]):
        for w in range(LANES):
            state[j, w] += step_s / 6.0 * (k1[j, w] + 2.0 * k2[j, w] + 2.0 * k3[j, w] + k4[j, w])


@_part
def _step(coefficients, boundary, state, torque, unwind, moved, step_s, slopes, probe, n):
    """One step of RK4, and what moves the rollers at random."""
    k1, k2, k3, k4 = slopes[0], slopes[1], slopes[2], slopes[3]
    _rate(coefficients, boundary, state, torque, unwind, k1, n)
    _added(state, 0.5 * step_s, k1, probe)
    _rate(coefficients, boundary, probe, torque, unwind, k2, n)
    _added(state, 0.5 * step_s, k2, probe)
    _rate(coefficients, boundary, probe, torque, unwind, k3, n)
    _added(state, step_s, k3, probe)
    _rate(coefficients, boundary, probe, torque, unwind, k4, n)
    _summed(state, slopes, step_s)
    for i in range(n):
        for w in range(LANES):
            state[n + i, w] += moved[i]


@_part
def _arriving(sent, delays, now, sub, substeps, torque, n):
    """The torques that reach the drives of each lane in a step; those of this period are in row `now` of `sent`."""
    for w in range(LANES):
        row = now - max(-(-(delays[w] - sub) // substeps), 0)
        if row < 0:
            row += sent.shape[0]
        for i in range(n):
            torque[i, w] = sent[row, i, w]


@_part
def _sine(x):
    """sin(x) to 1e-11, in arithmetic that goes through vector units."""
    turns = np.floor(x * (1.0 / pi) + 0.5)
    y = x - turns * pi
    z = y * y
    series = 1.0 - z * (1.0 / 156.0) * (1.0 - z * (1.0 / 210.0))
    series = 1.0 - z * (1.0 / 72.0) * (1.0 - z * (1.0 / 110.0) * series)
    series = 1.0 - z * (1.0 / 20.0) * (1.0 - z * (1.0 / 42.0) * series)
    return (1.0 - 2.0 * (turns - 2.0 * np.floor(0.5 * turns))) * y * (1.0 - z * (1.0 / 6.0) * series)


@_part
def _given(coefficients, own, acting, torque, span, faded, given, n):
    """R/J times the integral of the torque over `span`; row `faded` of `own` is exp(-span / lag). It is exact."""
    for i in range(n):
        for w in range(LANES):
            lagging = (acting[i, w] - torque[i, w]) * own[4 * n, w] * (1.0 - own[faded, w])
            given[i, w] = coefficients[4 * n + i, w] * (torque[i, w] * span + lagging)


@_part
def _turned(own, state, given, surface, rho, rate, eccentric, n):
    """Surface speeds w, what the web has of them, and the angles' rates."""
    for i in range(n):
        for w in range(LANES):
            surface[i, w] = state[n + i, w] + given[i, w]
            rate[2 * n + i, w] = own[3 * n + i, w] * surface[i, w]
    if eccentric:
        for i in range(n):
            for w in range(LANES):
                rho[i, w] = 1.0 + own[n + i, w] * _sine(state[2 * n + i, w] + own[2 * n + i, w])


@_part
def _rate_by_web(coefficients, boundary, state, surface, rho, unwind, rate, n):
    """d[T; w]/dt, `_rate` for rollers that may be eccentric; without torque and dry friction."""
    for i in range(n):
        for w in range(LANES):
            tension_up = state[i - 1, w] if i > 0 else boundary[0, w]
            speed_up = rho[i - 1, w] * surface[i - 1, w] if i > 0 else unwind
            tension_down = state[i + 1, w] if i + 1 < n else boundary[1, w]
            tension, speed = state[i, w], surface[i, w]
            rate[i, w] = _stretching(
                coefficients[i, w], coefficients[n + i, w], tension_up, speed_up, tension, rho[i, w] * speed
            )
            rate[n + i, w] = (
                coefficients[2 * n + i, w] * rho[i, w] * (tension_down - tension) - coefficients[3 * n + i, w] * speed
            )


@_part
def _stick(coefficients, own, state, rate, acting, torque, rubbing, free, n):
    """Dry friction for a step, as an acceleration against the motion, and `free` 0 for rollers that it keeps at rest.

    `rate` is what the web does. Without lag the torque that arrives acts at once.
    """
    for i in range(n):
        for w in range(LANES):
            speed, most = state[n + i, w], own[i, w]
            drive = acting[i, w] if own[4 * n, w] > 0.0 else torque[i, w]
            pulling = rate[n + i, w] + coefficients[4 * n + i, w] * drive
            way = pulling if speed == 0.0 else speed
            rubbing[i, w] = most if way > 0.0 else (-most if way < 0.0 else 0.0)
            free[i, w] = 0.0 if (speed == 0.0 and most > 0.0 and abs(pulling) <= most) else 1.0


@_part
def _rub(rate, rubbing, free, n):
    for i in range(n):
        for w in range(LANES):
            rate[n + i, w] = free[i, w] * (rate[n + i, w] - rubbing[i, w])


@_part
def _freed(given, free, n):
    for i in range(n):
        for w in range(LANES):
            given[i, w] *= free[i, w]


@_part
def _come_to_rest(own, state, given, moved, rubbing, free, n):
    """The speeds at a step's end. A roller that would have turned back is at rest."""
    for i in range(n):
        for w in range(LANES):
            speed = state[n + i, w] + given[i, w] + free[i, w] * moved[i]
            state[n + i, w] = 0.0 if rubbing[i, w] * speed < 0.0 else speed


@_part
def _lag(own, acting, torque, n):
    for i in range(n):
        for w in range(LANES):
            acting[i, w] = torque[i, w] + (acting[i, w] - torque[i, w]) * own[4 * n + 2, w]


@_part
def _real_step(
    coefficients, boundary, own, state, acting, torque, unwind, moved, step_s, slopes, probe, work, eccentric, n
):  # fmt: skip
    """`_step` with `Effects`. Rows of `own`: c R/J, e, p, 1/R, n each; lag, exp(-h/2 / lag), exp(-h / lag)."""
    k1, k2, k3, k4 = slopes[0], slopes[1], slopes[2], slopes[3]
    none, half, whole, surface, rho, rubbing, free = work[0], work[1], work[2], work[3], work[4], work[5], work[6]
    _given(coefficients, own, acting, torque, 0.5 * step_s, 4 * n + 1, half, n)
    _given(coefficients, own, acting, torque, step_s, 4 * n + 2, whole, n)
    _turned(own, state, none, surface, rho, k1, eccentric, n)
    _rate_by_web(coefficients, boundary, state, surface, rho, unwind, k1, n)
    _stick(coefficients, own, state, k1, acting, torque, rubbing, free, n)
    _rub(k1, rubbing, free, n)
    _freed(half, free, n)
    _freed(whole, free, n)
    _added(state, 0.5 * step_s, k1, probe)
    _turned(own, probe, half, surface, rho, k2, eccentric, n)
    _rate_by_web(coefficients, boundary, probe, surface, rho, unwind, k2, n)
    _rub(k2, rubbing, free, n)
    _added(state, 0.5 * step_s, k2, probe)
    _turned(own, probe, half, surface, rho, k3, eccentric, n)
    _rate_by_web(coefficients, boundary, probe, surface, rho, unwind, k3, n)
    _rub(k3, rubbing, free, n)
    _added(state, step_s, k3, probe)
    _turned(own, probe, whole, surface, rho, k4, eccentric, n)
    _rate_by_web(coefficients, boundary, probe, surface, rho, unwind, k4, n)
    _rub(k4, rubbing, free, n)
    _summed(state, slopes, step_s)
    _come_to_rest(own, state, whole, moved, rubbing, free, n)
    _lag(own, acting, torque, n)


@_part
def _advance(
    coefficients, boundary, own, block, eccentric, delays, sent, now, state, acting, unwind, moved, sub, substeps,
    step_s, slopes, probe, work, n,
):  # fmt: skip
    """A step of a block. Of the two branches only one is compiled: `own` is None, or it is not."""
    if own is None:
        row = now - max(-(-(delays[0] - sub) // substeps), 0)
        torque = sent[row if row >= 0 else row + sent.shape[0]]
        _step(coefficients, boundary, state, torque, unwind, moved, step_s, slopes, probe, n)
    else:
        _arriving(sent, delays, now, sub, substeps, work[7], n)
        _real_step(
            coefficients, boundary, own[block], state, acting, work[7], unwind, moved, step_s, slopes, probe, work,
            eccentric, n,
        )  # fmt: skip


@_alone
def advance(coefficients, boundary, own, eccentric, state, acting, torque, unwind, moved, step_s, slopes, probe, work):
    """A step of one block, whose torques (n, LANES) arrive now. `state` and `acting` are what changes."""
    n = torque.shape[0]
    if own is None:
        _step(coefficients, boundary, state, torque, unwind, moved, step_s, slopes, probe, n)
    else:
        _real_step(
            coefficients, boundary, own, state, acting, torque, unwind, moved, step_s, slopes, probe, work, eccentric, n
        )


@_parallel
def simulate(
    coefficients, boundary, own, eccentric, delays, states, torques, memories,
    torque_begins, torque_columns, torque_values, state_begins, state_columns, state_values, which,
    reference, unwinds, samples, moved, late, steps, bands, directions, changes, tail,
    substeps, step_s, most_nm, reach_nm, runaway_n, tension_out, torque_out,
):  # fmt: skip
    """Sums (blocks, ROWS, n, LANES). Without effects `own` is None, and the code for them is left out at compiling."""
    blocks, n, size, periods = states.shape[0], states.shape[1] // 2, memories.shape[1], unwinds.size
    width = 2 * n if own is None else 3 * n
    found = np.zeros((blocks, ROWS, n, LANES))
    found[:, LEAST], found[:, MOST], found[:, TAIL_LEAST], found[:, TAIL_MOST] = inf, -inf, inf, -inf
    ring = delays.max() // substeps + 2
    for block in prange(blocks):
        before, sums, state = torques[block].copy(), found[block], np.zeros((width, LANES))
        state[: 2 * n] = states[block]
        signals, asked = np.empty((size + 6 * n, LANES)), np.empty((n, LANES))
        signals[:size] = memories[block]
        applied, following = signals[size + 5 * n :], np.empty((size, LANES))
        slopes, probe = np.empty((4, width, LANES)), np.empty((width, LANES))
        sent = np.empty((ring, n, LANES))
        sent[:] = before
        acting, work = before.copy(), np.zeros((8, n, LANES))
        work[4] = 1.0  # round, until a roller is said to be eccentric
        change = 0
        for k in range(periods):
            _see(state, samples[k], reference[k], steps, signals, size, n)
            _product(torque_begins, torque_columns, torque_values[which[k]], signals, asked)
            _limit(asked, before, most_nm, reach_nm, applied, n)
            now = k % ring
            _send(applied, before, late[k], sent[now], n)
            if k == 0:
                before[:] = applied  # a change counts from the first torque of the law's own
            _account(state, reference[k], applied, before, sums, n)
            if k >= tail:
                _account_tail(state, reference[k], applied, before, sums, n)
            before[:] = applied
            if k == changes[change + 1]:
                change += 1
            if k >= changes[0]:
                since, last = k - changes[change], k + 1 == changes[change + 1]
                _account_change(state, reference[k], bands[change], directions[change], since, last, sums, n)
            if tension_out.size > 0:
                tension_out[block * LANES : (block + 1) * LANES, k] = state[:n].T
                torque_out[block * LANES : (block + 1) * LANES, k] = applied.T
            _product(state_begins, state_columns, state_values[which[k]], signals, following)
            signals[:size] = following
            for sub in range(substeps):
                _account_step(state, sums, k >= tail, n)
                _advance(
                    coefficients[block], boundary[block], own, block, eccentric, delays[block], sent, now, state,
                    acting, unwinds[k], moved[k * substeps + sub], sub, substeps, step_s, slopes, probe, work, n,
                )  # fmt: skip
            if k % LOOKED_AT == LOOKED_AT - 1 and _gone(sums[LEAST], sums[MOST], runaway_n, n):
                break
    return found
