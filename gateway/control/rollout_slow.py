"""Closed loops plant by plant, with the law as it runs on the line: what the compiled kernel is held against."""

from collections.abc import Callable
from math import inf
from typing import Any, Protocol

import numpy as np

from gateway.control.deviation import Measured
from gateway.control.law import Law
from gateway.control.reference import Steady
from gateway.control.rollout_line import PlainLine, RealLine, delay_steps
from gateway.control.rollout_start import start
from gateway.control.rollout_terms import Course, Plants, Rollouts, Setup, plants_of
from gateway.core.metrics import BAND
from gateway.core.signals import BoolArray, FloatArray
from gateway.core.web_model import WebModel


def run_law(
    law: Law[Any], model: WebModel, course: Course, setup: Setup, samples: FloatArray, moved: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """`run_plant` on a model without effects; noise as `Setup.draw` gives it."""
    return run_plant(law, plants_of([model]), 0, course, setup, (samples, moved, setup.late(course.periods, model.n)))


class Line(Protocol):
    """A plant: `rollout_line`, or compiled."""

    @property
    def state(self) -> FloatArray:
        """[T; w] (2n,), and more behind it."""
        ...

    def step(self, sent_nm: FloatArray, unwind_speed_m_per_s: float, moved_m_per_s: FloatArray) -> None: ...


LineOf = Callable[[Plants, int, Setup, FloatArray, FloatArray], Line]  #: from its state (2n,) and torques (n,)


def plain_line(plants: Plants, index: int, setup: Setup, state: FloatArray, torque_nm: FloatArray) -> Line:
    """In numpy, written apart from the kernel."""
    if plants.effects is None:
        return PlainLine(plants.model(index), setup.step_s, state)
    return RealLine(plants, plants.effects, index, setup.step_s, state, torque_nm)


def run_plant(
    law: Law[Any],
    plants: Plants,
    index: int,
    course: Course,
    setup: Setup,
    drawn: tuple[FloatArray, FloatArray, BoolArray],
    line_of: LineOf = plain_line,
) -> tuple[FloatArray, FloatArray]:
    """[T; w] (k substeps, 2n) before each step of the integration and torques (k, n) as sent, of one plant.

    `drawn`: noise and late commands, as `Setup.draw` and `Setup.late` give them. After a plant has run away: nan.
    """
    n, (samples, moved, late) = plants.n, drawn
    states, torques = start(plants, course)
    applied = torques[index]
    line = line_of(plants, index, setup, states[index], applied)
    delay = delay_steps(plants, setup)[index]
    acting = [applied] * (delay // setup.substeps + 2)
    on_grid = Grid(np.array([setup.tension_step_n] * n + [setup.speed_step_m_per_s] * n))
    stepped, sent = np.full((course.periods * setup.substeps, 2 * n), np.nan), np.full((course.periods, n), np.nan)
    memory = None
    for k, unwind in enumerate(course.unwind_speed_m_per_s.tolist()):
        seen = on_grid.nearest(line.state[: 2 * n] + samples[k])
        measured, reference = Measured(seen[:n], seen[n:], unwind), Steady(course.tension_n[k])
        if memory is None:
            memory = law.engage(measured, reference, applied)
        decision = law.ask(memory, measured, reference)
        before, applied = applied, limited(setup, decision.torque_nm, applied)
        memory = law.commit(memory, decision, applied)
        sent[k] = applied
        acting.append(np.where(late[k], before, applied))
        for j in range(setup.substeps):
            state = line.state
            if not (np.abs(state[:n]) <= setup.runaway_n).all():
                return stepped, sent
            stepped[k * setup.substeps + j] = state[: 2 * n]
            age = -(-(delay - j) // setup.substeps)  # periods ago that the acting torque was computed
            line.step(acting[-1 - max(age, 0)], unwind, moved[k * setup.substeps + j])
    return stepped, sent


def rollouts_of(stepped: FloatArray, torques: FloatArray, course: Course, setup: Setup, *, record: bool) -> Rollouts:
    """What is told of recordings: [T; w] (b, k substeps, 2n) and torques (b, k, n)."""
    n = torques.shape[2]
    stepped, speeds = stepped[:, :, :n], stepped[:, :, n:]
    tensions = stepped[:, :: setup.substeps]
    error: FloatArray = tensions - course.tension_n
    settled, beyond = _settled_and_beyond(error, course)
    steps = np.abs(np.diff(torques, axis=1)).max(axis=1, initial=0.0)
    tail = course.periods - course.tail
    in_tail = stepped[:, tail * setup.substeps :]
    moves = np.diff(torques, axis=1, prepend=torques[:, :1])[:, tail:]
    figures = {
        "squared_error_n2": np.mean(error**2, axis=1),
        "tension_min_n": stepped.min(axis=1),
        "tension_max_n": stepped.max(axis=1),
        "settled": settled,
        "beyond_n": np.maximum(beyond, 0.0),
        "roller_speed_max_m_per_s": np.abs(speeds).max(axis=1),
        "torque_max_nm": np.abs(torques).max(axis=1),
        "torque_step_max_nm": steps,
        "effort_n2m2s": setup.period_s * np.sum(torques**2, axis=1),
    }
    if course.tail:
        figures["tail_swing_n"] = 0.5 * (in_tail.max(axis=1) - in_tail.min(axis=1))
        figures["tail_error_n"] = np.abs(error[:, tail:].mean(axis=1))
        figures["chatter_nm"] = np.sqrt(np.mean(moves**2, axis=1))
    return told(figures, tensions if record else None, torques if record else None, setup.runaway_n)


def _settled_and_beyond(error: FloatArray, course: Course) -> tuple[FloatArray, FloatArray]:
    """The worst of all changes, (b, n) each."""
    settled, beyond = np.zeros((2, len(error), error.shape[2]))
    bands, changes = BAND * course.settled_at_n, course.changes.tolist()
    for i, (begin, end) in enumerate(zip(changes[:-1], changes[1:], strict=True)):
        after, direction = error[:, begin:end], course.direction[i]
        beyond = np.maximum(beyond, np.where(direction == 0.0, np.abs(after), direction * after).max(axis=1))
        outside = np.abs(after) > bands[i]
        last = after.shape[1] - np.argmax(outside[:, ::-1], axis=1)
        last = np.where(outside[:, -1], inf, last)
        settled = np.maximum(settled, np.where(outside.any(axis=1), last, 0.0))
    return settled, beyond


def told(
    figures: dict[str, FloatArray], tension_n: FloatArray | None, torque_nm: FloatArray | None, runaway_n: float
) -> Rollouts:
    """Rollouts of figures by name, in which those of a plant that has run away are the worst there is."""
    least, most = figures["tension_min_n"], figures["tension_max_n"]
    diverged = ~((least >= -runaway_n) & (most <= runaway_n)).all(axis=1)  # nan is neither
    for name, values in figures.items():
        values[diverged] = -inf if name == "tension_min_n" else inf
    recorded = {"tension_n": tension_n, "torque_nm": torque_nm}
    for values in recorded.values():
        if values is not None:
            values[~np.isfinite(values).all(axis=2)] = np.nan
    return Rollouts(**figures, **{name: values for name, values in recorded.items() if values is not None})


def limited(setup: Setup, asked_nm: FloatArray, before_nm: FloatArray) -> FloatArray:
    """The torque (n,) that the envelope lets through."""
    reach = setup.torque_rate_nm_per_s * setup.period_s
    held = np.minimum(np.maximum(asked_nm, -setup.torque_nm), setup.torque_nm)
    return np.minimum(np.maximum(held, before_nm - reach), before_nm + reach)


class Grid:
    """A grid of `steps`; where that is 0, none."""

    def __init__(self, steps: FloatArray) -> None:
        self._fine = steps == 0.0
        self._steps = np.where(self._fine, 1.0, steps)
        self._none, self._any = bool(self._fine.all()), bool(self._fine.any())

    def nearest(self, values: FloatArray) -> FloatArray:
        """`values` on the grid; where there is none, as they are."""
        if self._none:
            return values
        there = np.rint(values / self._steps) * self._steps
        return np.where(self._fine, values, there) if self._any else there
