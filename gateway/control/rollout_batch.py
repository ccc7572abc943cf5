"""Rollouts of linear laws through the compiled kernel: plants side by side, laws as lists of non-zero entries."""

from typing import Any

import numpy as np

from gateway.control import rollout_kernel as kernel
from gateway.control.deviation import Measured
from gateway.control.laws import make_law
from gateway.control.linear_form import linear_form
from gateway.control.reference import Steady
from gateway.control.rollout_line import delay_steps
from gateway.control.rollout_slow import told
from gateway.control.rollout_start import references, start
from gateway.control.rollout_terms import Course, Effects, Plants, Rollouts, Setup
from gateway.control.scheduled import SpeedGrid
from gateway.core.controller_schedule import LinearConfig, ScheduledConfig
from gateway.core.metrics import BAND
from gateway.core.signals import CountArray, FloatArray


def run(
    config: LinearConfig | ScheduledConfig, plants: Plants, course: Course, setup: Setup, *, record: bool
) -> Rollouts:
    """`rollout.simulate` for a law with a linear form, or with one for each speed."""
    n, count = plants.n, plants.count
    laws, which = _laws(config, course)
    forms = [linear_form(law) for law in laws]
    blocks = -(-count // kernel.LANES)
    fill = np.minimum(np.arange(blocks * kernel.LANES), count - 1)  # the last block repeats the last plant
    states, torques = start(plants, course)
    samples, moved = setup.draw(course.periods, n)
    unwinds = np.ascontiguousarray(course.unwind_speed_m_per_s, dtype=np.float64)  # of another kind: compiled anew
    memory = _engaged(laws[int(which[0])], course, setup, states, torques, samples[0])
    effects = plants.effects
    shape = (blocks * kernel.LANES, course.periods, n) if record else (0, 0, 0)
    tension_n, torque_nm = np.full(shape, np.nan), np.full(shape, np.nan)
    sums = kernel.simulate(
        lanes(coefficients_of(plants), fill), lanes(plants.boundary_n, fill),
        None if effects is None else lanes(effects_of(plants, effects, setup), fill),
        effects is not None and bool(effects.eccentricity.any()),
        np.array(delay_steps(plants, setup))[fill].reshape(blocks, kernel.LANES),
        lanes(states, fill), lanes(torques, fill), lanes(memory, fill),
        *_entries([form.torque for form in forms]), *_entries([np.hstack((f.state, f.applied)) for f in forms]), which,
        references(config, course), unwinds, samples, moved, setup.late(course.periods, n),
        np.array([setup.tension_step_n] * n + [setup.speed_step_m_per_s] * n),
        BAND * course.settled_at_n, course.direction, course.changes, course.periods - course.tail,
        setup.substeps, setup.step_s, np.zeros(n) + setup.torque_nm, setup.torque_rate_nm_per_s * setup.period_s,
        float(setup.runaway_n), tension_n, torque_nm,
    )  # fmt: skip
    rows = sums.transpose(1, 0, 3, 2).reshape(kernel.ROWS, -1, n)[:, :count]
    return told(
        _figures(rows, course, setup),
        tension_n[:count] if record else None,
        torque_nm[:count] if record else None,
        setup.runaway_n,
    )


def _figures(rows: FloatArray, course: Course, setup: Setup) -> dict[str, FloatArray]:
    """Fields of `Rollouts`, from what the kernel has accumulated (rows, b, n)."""
    figures = {
        "squared_error_n2": rows[kernel.SQUARED] / course.periods,
        "tension_min_n": rows[kernel.LEAST],
        "tension_max_n": rows[kernel.MOST],
        "settled": rows[kernel.LAST],
        "beyond_n": rows[kernel.BEYOND],
        "roller_speed_max_m_per_s": rows[kernel.SPEED],
        "torque_max_nm": rows[kernel.TORQUE],
        "torque_step_max_nm": rows[kernel.STEP],
        "effort_n2m2s": rows[kernel.EFFORT] * setup.period_s,
    }
    if course.tail:
        figures["tail_swing_n"] = 0.5 * (rows[kernel.TAIL_MOST] - rows[kernel.TAIL_LEAST])
        figures["tail_error_n"] = np.abs(rows[kernel.TAIL_ERROR]) / course.tail
        figures["chatter_nm"] = np.sqrt(rows[kernel.TAIL_MOVES] / course.tail)
    return figures


def coefficients_of(plants: Plants) -> FloatArray:
    """What the kernel has of each plant (b, 5n), in the order of its `_rate`."""
    gain = plants.radius_m / plants.inertia_kg_m2
    return np.hstack(
        (
            plants.stiffness_n, 1.0 / plants.length_m, plants.radius_m * gain,
            plants.friction_nms_per_rad / plants.inertia_kg_m2, gain,
        )
    )  # fmt: skip


def effects_of(plants: Plants, effects: Effects, setup: Setup) -> FloatArray:
    """What the kernel has of each plant's effects, (b, 4n + 3), in the order that `kernel.simulate` tells."""
    lag_s = effects.torque_lag_s[:, None]
    with np.errstate(divide="ignore"):
        fades = np.exp(-setup.step_s * np.array([0.5, 1.0]) / lag_s)  # exp(-inf) where there is no lag
    gain = plants.radius_m / plants.inertia_kg_m2
    return np.hstack(
        (gain * effects.coulomb_nm, effects.eccentricity, effects.phase_rad, 1.0 / plants.radius_m, lag_s, fades)
    )


def lanes(values: FloatArray, fill: Any) -> FloatArray:
    """(plants, rows) as (blocks, rows, LANES)."""
    picked = values[fill]
    return np.ascontiguousarray(picked.reshape(-1, kernel.LANES, values.shape[1]).transpose(0, 2, 1))


def _laws(config: LinearConfig | ScheduledConfig, course: Course) -> tuple[list[LinearConfig], CountArray]:
    """The laws that a course needs, and which of them each period (k,): the unwinder's speed is known before."""
    if not isinstance(config, ScheduledConfig):
        return [config], np.zeros(course.periods, dtype=np.int64)
    grid = SpeedGrid(config)
    used, which = np.unique(grid.course(course.unwind_speed_m_per_s.tolist()), return_inverse=True)
    return [grid.laws[at] for at in used], which


def _entries(matrices: list[FloatArray]) -> tuple[Any, Any, FloatArray]:
    """Where each row begins, columns, and values (matrices, entries) of what is non-zero in any of them."""
    every: Any = np.array(matrices)
    rows, columns = np.nonzero(every.any(axis=0))
    begins = np.searchsorted(rows, np.arange(len(matrices[0]) + 1))
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
