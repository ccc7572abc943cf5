"""Set-points on their way: where they are now, where they shall be, and how fast they may move. Pure.

Control is told of every change of speed but a step, also of ramps: rollers that are accelerated with the web need a
torque for it, which on heavy ones comes to as much as the tension.
"""

from dataclasses import dataclass
from math import inf
from typing import Literal

import numpy as np

from gateway.control.reference import MinimumJerk, Motion, Reference, Steady
from gateway.control.takeover import NEAR_SETPOINT
from gateway.core.line import Moves, Recipe
from gateway.core.signals import BoolArray, FloatArray

STEP_PAUSE = 100.0  #: moments between two steps of one quantity: they must not add up to one that is too large
LEAST_MOVE = 10.0  #: moments that a minimum-jerk move takes, however small
NEAR = 0.2  #: a tension this near its set-point, as a fraction, has followed it


@dataclass(frozen=True, slots=True)
class OnTheWay:
    """A reference whose set-points are moving, or the line's speed is."""

    tension_n: FloatArray
    curve: MinimumJerk  #: tensions (n,), then the speed
    now_s: float  #: on the curve
    speed_lag_s: float  #: from the speed that is asked for to that which the unwinder has
    tensions_move: bool = True  #: not the speed alone
    moving: bool = True

    def ahead(self, time_s: float) -> Motion:
        if self.tensions_move:
            tension, rate, acceleration = self.curve.at(self.now_s + time_s)[:, :-1]
        else:
            tension, rate, acceleration = self.tension_n, (none := np.zeros(len(self.tension_n))), none
        i, now_s = len(self.tension_n), self.now_s - self.speed_lag_s
        speed, unwind_acceleration = self.curve.of(i, now_s + time_s)
        return Motion(tension, rate, acceleration, unwind_acceleration, speed - self.curve.of(i, now_s)[0])


class Setpoints:
    """Tensions (n,) in N and the line's speed in m/s: now, and where they move to."""

    def __init__(self, recipe: Recipe, moment_s: float) -> None:
        """`moment_s` is that of the line (`line_scales`)."""
        self.step_pause_s = STEP_PAUSE * moment_s  #: between two steps of one quantity
        self._least_move_s = LEAST_MOVE * moment_s
        n = len(recipe.tension_n)
        self.recipe = recipe
        self.tension_n: FloatArray = np.zeros(n)  #: what control follows now
        self.tension_target_n: FloatArray = np.array(recipe.tension_n)
        self.speed_m_per_s = 0.0  #: what is asked of the line PLC now
        self.speed_target_m_per_s = recipe.speed_m_per_s  #: what the operator wants while the line runs
        self._tension_stepped_s: FloatArray = np.full(n, -inf)
        self._tension_stepped_n: FloatArray = np.zeros(n)  #: by how much then
        self._speed_stepped_s = -inf
        self._curve = MinimumJerk(np.zeros(n + 1))
        self._time_s = 0.0  #: on the curve
        self._ramped: BoolArray = np.zeros(n + 1, dtype=np.bool_)  #: values that go to their target on a ramp
        self._ramp: tuple[float, float] | None = None  #: that the speed is on, or was last: goal in m/s, rate in m/s^2
        self._excited = False  #: an experiment says where tensions stand, and their targets where they go back to

    def aim_at(self, recipe: Recipe) -> None:
        """The recipe's set-points become the targets."""
        self.recipe = recipe
        self.tension_target_n = np.array(recipe.tension_n)
        self.speed_target_m_per_s = recipe.speed_m_per_s

    def begin_at(self, tension_n: FloatArray) -> None:
        """Start from what is measured, so that nothing jumps when control takes over. Targets stay."""
        target = self.tension_target_n
        there = np.abs(tension_n - target) <= NEAR_SETPOINT * target
        self.tension_n = np.where(there, target, np.minimum(np.maximum(tension_n, 0.0), target))
        for i, value in enumerate(self.tension_n.tolist()):
            self._curve.put(i, value)

    def reference(self, speed_lag_s: float) -> Reference:
        """What control is told; `speed_lag_s` is from a speed that is asked for to that which the unwinder has."""
        curve, before_s = self._curve, self._time_s - speed_lag_s
        if not curve.moving(before_s):
            return Steady(self.tension_n)
        tensions_move = any(curve.is_moving(i, before_s) for i in range(len(self.tension_n)))
        return OnTheWay(self.tension_n, curve, self._time_s, speed_lag_s, tensions_move)

    def step_tension(self, span: int, tension_n: float, now_s: float) -> None:
        """Make a change at once. Span from 0."""
        self._tension_stepped_n[span] = abs(tension_n - self.tension_n[span])
        self.tension_n[span] = self.tension_target_n[span] = tension_n
        self._curve.put(span, tension_n)
        self._tension_stepped_s[span] = now_s

    def step_speed(self, speed_m_per_s: float, now_s: float) -> None:
        self.begin_at_speed(speed_m_per_s)
        self.speed_target_m_per_s = speed_m_per_s
        self._speed_stepped_s = now_s

    def excite(self, tension_n: FloatArray) -> None:
        """An experiment's set-points (n,), at once, for this period. Targets stay; `settle` ends it."""
        self._excited = True
        if tension_n is not self.tension_n:
            self.tension_n = tension_n
            self._curve.put(slice(len(tension_n)), tension_n)

    def settle(self, now_s: float) -> None:
        """No experiment any more: from where they are, tensions go to their targets as they always do."""
        if self._excited:
            self._excited = False
            self._tension_stepped_s[:] = now_s

    def at_rest(self) -> bool:
        """Whether every set-point stands at its target."""
        return self._there() and self.speed_m_per_s == self.speed_target_m_per_s

    def stands(self, held: bool) -> bool:
        """Whether nothing moves: every set-point at its target, or while `held` the speed at standstill."""
        return self._there() and self.speed_m_per_s == (0.0 if held else self.speed_target_m_per_s)

    def begin_at_speed(self, speed_m_per_s: float) -> None:
        """It is what is asked of the line PLC from now on. The target stays."""
        self.speed_m_per_s, self._ramp = speed_m_per_s, None
        self._curve.put(len(self.tension_n), speed_m_per_s)

    def tension_step_pause_s(self, span: int, now_s: float) -> float:
        """Seconds until another step of this tension may be made; not positive when it may be made now."""
        return float(self._tension_stepped_s[span]) + self.step_pause_s - now_s

    def stepped_lately_n(self, now_s: float) -> float:
        """What the steps of all tensions come to together that are so young that another one would add to them."""
        lately = self._tension_stepped_s > now_s - self.step_pause_s
        return float(self._tension_stepped_n[lately].sum())

    def speed_step_pause_s(self, now_s: float) -> float:
        return self._speed_stepped_s + self.step_pause_s - now_s

    def advance(
        self,
        moves: Moves,
        period_s: float,
        speed_goal_m_per_s: float,
        speed_rate_m_per_s2: float,
        speed_shape: Literal["ramp", "minimum-jerk"] = "ramp",
    ) -> None:
        """Move on by one period: tensions towards their targets, speed towards `speed_goal_m_per_s`."""
        self._time_s += period_s
        if speed_shape == "minimum-jerk":
            self._advance_speed_smoothly(period_s, speed_goal_m_per_s, speed_rate_m_per_s2)
        else:
            self._ramp_speed(period_s, speed_goal_m_per_s, speed_rate_m_per_s2)
        if self._excited:
            return
        if moves.shape == "minimum-jerk":
            self._advance_smoothly(moves, period_s)
        elif not self._there():
            reach = moves.tension_rate_n_per_s * period_s
            self.tension_n = self.tension_n + np.clip(self.tension_target_n - self.tension_n, -reach, reach)
            self._curve.put(slice(len(self.tension_n)), self.tension_n)

    def _advance_smoothly(self, moves: Moves, period_s: float) -> None:
        """Tensions along their curves. To a target that changes on the way on a ramp: a curve would overshoot."""
        before_s = self._time_s - period_s
        for i in np.flatnonzero((self.tension_target_n != self._curve.target[:-1]) | self._ramped[:-1]).tolist():
            target_n = float(self.tension_target_n[i])
            if not self._ramped[i] and not self._curve.is_moving(i, before_s):
                # It begins where it is now, and has moved in a period from now.
                self._curve.move(i, target_n, moves.tension_rate_n_per_s, self._time_s, self._least_move_s)
                continue
            reach, value = moves.tension_rate_n_per_s * period_s, float(self.tension_n[i])
            self._curve.put(i, value + max(-reach, min(reach, target_n - value)))
            self._ramped[i] = self._curve.target[i] != target_n
        self.tension_n = self._curve.at(self._time_s)[0, :-1]

    def _advance_speed_smoothly(self, period_s: float, goal_m_per_s: float, rate_m_per_s2: float) -> None:
        """As the tensions."""
        i, before_s = len(self.tension_n), self._time_s - period_s
        if goal_m_per_s != self._curve.target[i] or self._ramped[i]:
            if self._ramped[i] or self._curve.is_moving(i, before_s):
                self._ramp_speed(period_s, goal_m_per_s, rate_m_per_s2)
                return
            self._curve.move(i, goal_m_per_s, rate_m_per_s2, self._time_s, self._least_move_s)
            self._ramp = None
        self.speed_m_per_s = float(self._curve.at(self._time_s)[0, i])

    def _ramp_speed(self, period_s: float, goal_m_per_s: float, rate_m_per_s2: float) -> None:
        """On the curve, too: rollers have to be accelerated with the web, and control is told by how much."""
        i, before_s, wanted = len(self.tension_n), self._time_s - period_s, (goal_m_per_s, rate_m_per_s2)
        if self._ramp != wanted:
            self._curve.ramp(i, goal_m_per_s, rate_m_per_s2, before_s)
            self._ramp = wanted
        self.speed_m_per_s = self._curve.of(i, self._time_s)[0]
        self._ramped[-1] = self.speed_m_per_s != goal_m_per_s

    def followed_by(self, tension_n: FloatArray, measured: FloatArray) -> bool:
        """Whether every set-point is where it shall be and every measured tension (n,) is near it."""
        if not self._there():
            return False
        near = np.abs(tension_n - self.tension_n) <= NEAR * self.tension_n
        return bool(near[measured > 0].all())

    def _there(self) -> bool:
        """Whether every tension's set-point has reached its target."""
        return not np.count_nonzero(self.tension_n != self.tension_target_n)
