"""The compiled closed loop of linear laws: many plants at once, eight side by side in the processor's vector units.

Arrays are (row, lane): each operation on a state of one plant is the same for the plants beside it. The law's matrices
are read as lists of their non-zero entries.
"""

# pyright: standard
# (numba infers the types of what it compiles; there is nothing to annotate them with)

from math import inf
from typing import Any

import numpy as np
from numba import njit, prange

from gateway.control.deviation import Measured
from gateway.control.laws import make_law
from gateway.control.linear_form import linear_form
from gateway.control.reference import Steady
from gateway.control.rollout import Course, Plants, Rollouts, Setup, references, start, step_direction
from gateway.control.scheduled import SpeedGrid
from gateway.core.controller_schedule import LinearConfig, ScheduledConfig
from gateway.core.metrics import BAND
from gateway.core.signals import FloatArray

LANES = 8

# numba's decorator has no types; what it returns is called as the function it decorates. Whether to inline is left to
# LLVM: one large function has too many arrays for it to see that they do not overlap, and becomes scalar code.
_part: Any = njit(error_model="numpy", fastmath={"contract"})
_parallel: Any = njit(parallel=True, cache=True, error_model="numpy", fastmath={"contract"})

# Rows of what the kernel accumulates for each roller or span.
_SQUARED, _LEAST, _MOST, _LAST, _BEYOND, _TORQUE, _STEP, _EFFORT = range(8)


def run(
    config: LinearConfig | ScheduledConfig, plants: Plants, course: Course, setup: Setup, *, record: bool
) -> Rollouts:
    """`rollout.simulate` for a law with a linear form, or with one for each speed."""
    n, count = plants.n, plants.count
    laws, which = _laws(config, course)
    forms = [linear_form(law) for law in laws]
    blocks = -(-count // LANES)
    fill = np.minimum(np.arange(blocks * LANES), count - 1)  # the last block repeats the last plant
    states, torques = start(plants, course)
    samples, moved = setup.draw(course.periods, n)
    reference = references(config, course)
    memory = _engaged(laws[which[0]], course, setup, states, torques, samples[0])
    coefficients = np.stack(
        (
            plants.stiffness_n, 1.0 / plants.length_m, plants.radius_m**2 / plants.inertia_kg_m2,
            plants.friction_nms_per_rad / plants.inertia_kg_m2, plants.radius_m / plants.inertia_kg_m2,
        )
    )  # fmt: skip
    shape = (blocks * LANES, course.periods, n) if record else (0, 0, 0)
    tension_n, torque_nm = np.empty(shape), np.empty(shape)
    found = _simulate(
        _lanes(coefficients.transpose(1, 0, 2).reshape(count, -1), fill), _lanes(plants.boundary_n, fill),
        _lanes(states, fill), _lanes(torques, fill), _lanes(memory, fill),
        *_entries([form.torque for form in forms]), *_entries([np.hstack((f.state, f.applied)) for f in forms]), which,
        reference, course.unwind_speed_m_per_s, samples, moved,
        np.array([setup.tension_step_n] * n + [setup.speed_step_m_per_s] * n),
        BAND * course.tension_n[-1], step_direction(course), course.changed,
        setup.substeps, setup.delay_steps, setup.step_s,
        setup.torque_nm, setup.torque_rate_nm_per_s * setup.period_s, tension_n, torque_nm,
    )  # fmt: skip
    rows = found.transpose(1, 0, 3, 2).reshape(8, -1, n)[:, :count]
    settled = rows[_LAST]
    after = course.periods - course.changed
    return Rollouts(
        rows[_SQUARED] / course.periods, rows[_LEAST], rows[_MOST], np.where(settled == after, inf, settled),
        rows[_BEYOND], rows[_TORQUE], rows[_STEP], rows[_EFFORT] * setup.period_s,
        tension_n[:count] if record else np.empty(0), torque_nm[:count] if record else np.empty(0),
    )  # fmt: skip


def _lanes(values: FloatArray, fill: Any) -> FloatArray:
    """(plants, rows) as (blocks, rows, LANES)."""
    picked = values[fill]
    return np.ascontiguousarray(picked.reshape(-1, LANES, values.shape[1]).transpose(0, 2, 1))


def _laws(config: LinearConfig | ScheduledConfig, course: Course) -> tuple[list[LinearConfig], Any]:
    """The laws that a course needs, and which of them each period (k,): the unwinder's speed is known before."""
    if not isinstance(config, ScheduledConfig):
        return [config], np.zeros(course.periods, dtype=np.int64)
    grid = SpeedGrid(config)
    used, which = np.unique(grid.course(course.unwind_speed_m_per_s.tolist()), return_inverse=True)
    return [grid.laws[at] for at in used], which


def _entries(matrices: list[FloatArray]) -> tuple[Any, Any, FloatArray]:
    """Where each row begins, columns, and values (matrices, entries) of what is non-zero in any of them."""
    every = np.array(matrices)
    rows, columns = np.nonzero(every.any(axis=0))
    begins = np.searchsorted(rows, np.arange(every.shape[1] + 1))
    # Unsigned: a signed index may count from the end, and asking for it each time costs six times the sum itself.
    return begins.astype(np.uint64), columns.astype(np.uint64), np.ascontiguousarray(every[:, rows, columns])


def _engaged(
    config: LinearConfig, course: Course, setup: Setup, states: FloatArray, torques: FloatArray, noise: FloatArray
) -> FloatArray:
    """The law's state (b, s) as it engages on each plant.

    What a law engages with is an affine function of speeds and torques, so that it is asked 2n + 1 times, not per
    plant; the tensions are the same for all.
    """
    n, unwind = config.n, float(course.unwind_speed_m_per_s[0])
    law, reference = make_law(config), Steady(course.tension_n[0])

    def engaged(values: FloatArray) -> FloatArray:
        return flattened(law.engage(Measured(values[:n], values[n : 2 * n], unwind), reference, values[2 * n :]))

    inputs = np.hstack((states + noise, torques))
    steps = np.array([setup.tension_step_n] * n + [setup.speed_step_m_per_s] * n)
    quantised = steps > 0.0
    inputs[:, : 2 * n][:, quantised] = np.round(inputs[:, : 2 * n][:, quantised] / steps[quantised]) * steps[quantised]
    base = inputs[0]
    at_base = engaged(base)
    slopes = np.array([engaged(base + row) - at_base for row in np.eye(3 * n)[n:]])
    return at_base + (inputs - base)[:, n:] @ slopes


def flattened(state: Any) -> FloatArray:
    """A law's state as the vector z of its `LinearForm`."""
    return np.concatenate([np.ravel(getattr(state, name)) for name in state.__slots__])


@_part
def _rate(coefficients, boundary, state, torque, unwind, rate, n):
    """d[T; v]/dt for all lanes; rows of `coefficients` are EA, 1/L, R^2/J, f/J, R/J, n each."""
    for i in range(n):
        for w in range(LANES):
            tension_up = state[i - 1, w] if i > 0 else boundary[0, w]
            speed_up = state[n + i - 1, w] if i > 0 else unwind
            tension_down = state[i + 1, w] if i + 1 < n else boundary[1, w]
            tension, speed = state[i, w], state[n + i, w]
            rate[i, w] = coefficients[n + i, w] * (
                coefficients[i, w] * (speed - speed_up) + tension_up * speed_up - tension * speed
            )
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
            held = min(max(asked[i, w], -most_nm), most_nm)
            applied[i, w] = min(max(held, was - reach_nm), was + reach_nm)


@_part
def _account(state, reference, applied, before, sums, n):
    """Torques and tensions of a period."""
    for i in range(n):
        for w in range(LANES):
            now, tension = applied[i, w], state[i, w]
            error = tension - reference[i]
            sums[_TORQUE, i, w] = max(sums[_TORQUE, i, w], abs(now))
            sums[_STEP, i, w] = max(sums[_STEP, i, w], abs(now - before[i, w]))
            sums[_EFFORT, i, w] += now * now
            sums[_SQUARED, i, w] += error * error
            sums[_LEAST, i, w] = min(sums[_LEAST, i, w], tension)
            sums[_MOST, i, w] = max(sums[_MOST, i, w], tension)


@_part
def _account_change(state, reference, band, direction, since, sums, n):
    """Settling and overshoot, `since` periods after the change."""
    for i in range(n):
        for w in range(LANES):
            error = state[i, w] - reference[i]
            if abs(error) > band[i]:
                sums[_LAST, i, w] = since + 1
            past = abs(error) if direction[i] == 0.0 else direction[i] * error
            sums[_BEYOND, i, w] = max(sums[_BEYOND, i, w], past)


@_part
def _added(state, factor, slope, out):
    """out = state + factor slope"""
    for j in range(state.shape[0]):
        for w in range(LANES):
            out[j, w] = state[j, w] + factor * slope[j, w]


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
    for j in range(2 * n):
        for w in range(LANES):
            state[j, w] += step_s / 6.0 * (k1[j, w] + 2.0 * k2[j, w] + 2.0 * k3[j, w] + k4[j, w])
    for i in range(n):
        for w in range(LANES):
            state[n + i, w] += moved[i]


@_parallel
def _simulate(
    coefficients, boundary, states, torques, memories,
    torque_begins, torque_columns, torque_values, state_begins, state_columns, state_values, which,
    reference, unwinds, samples, moved, steps, band, direction, changed, substeps, delay, step_s,
    most_nm, reach_nm, tension_out, torque_out,
):  # fmt: skip
    blocks, width = states.shape[0], states.shape[1]
    n, size = width // 2, memories.shape[1]
    found = np.zeros((blocks, 8, n, LANES))
    found[:, _LEAST], found[:, _MOST] = inf, -inf
    ring = delay // substeps + 2
    for block in prange(blocks):
        state, before, sums = states[block].copy(), torques[block].copy(), found[block]
        signals, asked = np.empty((size + 6 * n, LANES)), np.empty((n, LANES))
        signals[:size] = memories[block]
        applied, following = signals[size + 5 * n :], np.empty((size, LANES))
        slopes, probe = np.empty((4, width, LANES)), np.empty((width, LANES))
        sent = np.empty((ring, n, LANES))
        sent[:] = before
        for k in range(unwinds.size):
            _see(state, samples[k], reference[k], steps, signals, size, n)
            _product(torque_begins, torque_columns, torque_values[which[k]], signals, asked)
            _limit(asked, before, most_nm, reach_nm, applied, n)
            if k == 0:
                before[:] = applied  # a change counts from the first torque of the law's own
            _account(state, reference[k], applied, before, sums, n)
            before[:] = applied
            sent[k % ring] = applied
            if k >= changed:
                _account_change(state, reference[k], band, direction, k - changed, sums, n)
            if tension_out.size > 0:
                tension_out[block * LANES : (block + 1) * LANES, k] = state[:n].T
                torque_out[block * LANES : (block + 1) * LANES, k] = applied.T
            _product(state_begins, state_columns, state_values[which[k]], signals, following)
            signals[:size] = following
            for sub in range(substeps):
                age = max(-(-(delay - sub) // substeps), 0)
                torque = sent[(k - age) % ring]
                _step(coefficients[block], boundary[block], state, torque, unwinds[k], moved[k * substeps + sub],
                      step_s, slopes, probe, n)  # fmt: skip
    return found
