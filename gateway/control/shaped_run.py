"""A shaped move, simulated: the law itself follows a minimum-jerk curve with its feed-forward, on one plant, unmoved by
noise. (The compiled rollouts know references that stand between their steps.)
"""

from dataclasses import dataclass

import numpy as np

from gateway.control.deviation import Measured
from gateway.control.laws import make_law, untimed
from gateway.control.reference import MinimumJerk, Motion, Reference, Steady
from gateway.control.rollout_line import delay_steps
from gateway.control.rollout_slow import limited
from gateway.control.rollout_start import start
from gateway.control.rollout_terms import Course, Plants, Setup
from gateway.core.controller import Controller
from gateway.core.signals import FloatArray


@dataclass(frozen=True)
class Way:
    """From one set of set-points (n,) to another, after standing for a while, at a speed of the unwinder that stays."""

    low_n: FloatArray
    high_n: FloatArray
    speed_m_per_s: float
    stand_s: float
    move_s: float
    rest_s: float  #: after the move

    def course(self, period_s: float) -> Course:
        """What is asked, period by period."""
        times = np.arange(round((self.stand_s + self.move_s + self.rest_s) / period_s)) * period_s
        curve, end_s = self.curve(), self.stand_s + self.move_s
        tension = np.where(times[:, None] < end_s, self.low_n, self.high_n)
        for k in np.flatnonzero((times > self.stand_s) & (times < end_s)).tolist():
            tension[k] = curve.at(times[k])[0]
        return Course(tension, np.full(len(times), self.speed_m_per_s), round(self.stand_s / period_s))

    def curve(self) -> MinimumJerk:
        """Of time since the begin."""
        curve = MinimumJerk(self.low_n)
        for i, target in enumerate(self.high_n.tolist()):
            curve.move(i, target, np.inf, self.stand_s, self.move_s)
        return curve


@dataclass(frozen=True, slots=True)
class _On:
    """The reference at an instant of a curve."""

    tension_n: FloatArray
    curve: MinimumJerk
    now_s: float
    moving: bool = True

    def ahead(self, time_s: float) -> Motion:
        tension, rate, acceleration = self.curve.at(self.now_s + time_s)
        return Motion(tension, rate, acceleration, 0.0, 0.0)


def follow(config: Controller, plants: Plants, way: Way, setup: Setup) -> FloatArray:
    """Tensions (k, n) at the samples, of the first of `plants`. nan from where they are no numbers any more."""
    from gateway.control.rollout_compiled_line import CompiledLine  # for those who use it

    course, curve, n = way.course(setup.period_s), way.curve(), plants.n
    states, torques = start(plants, course)
    applied: FloatArray = torques[0]
    line = CompiledLine(plants, 0, setup, states[0], applied)
    delay = delay_steps(plants, setup)[0]
    acting = [applied] * (delay // setup.substeps + 2)
    law, memory = make_law(untimed(config)), None
    tensions, still = np.full((course.periods, n), np.nan), np.zeros(n)
    for k in range(course.periods):
        state = line.state
        tensions[k] = state[:n]
        if not np.isfinite(state).all():
            break
        measured = Measured(state[:n], state[n : 2 * n], way.speed_m_per_s)
        reference = _reference(curve, way, course.tension_n[k], k * setup.period_s)
        if memory is None:
            memory = law.engage(measured, reference, applied)
        decision = law.ask(memory, measured, reference)
        applied = limited(setup, decision.torque_nm, applied)
        memory = law.commit(memory, decision, applied)
        acting.append(applied)
        for j in range(setup.substeps):
            age = -(-(delay - j) // setup.substeps)  # periods ago that the acting torque was computed
            line.step(acting[-1 - max(age, 0)], way.speed_m_per_s, still)
    return tensions


def _reference(curve: MinimumJerk, way: Way, tension_n: FloatArray, now_s: float) -> Reference:
    """The law learns of the move when it begins, not before."""
    under_way = way.stand_s - 1e-9 <= now_s < way.stand_s + way.move_s
    return _On(tension_n, curve, now_s) if under_way else Steady(tension_n)
