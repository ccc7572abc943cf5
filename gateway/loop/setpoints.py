"""Set-points on their way: where they are now, where they shall be, and how fast they may move. Pure."""

from math import inf

import numpy as np

from gateway.core.line import Moves, Recipe
from gateway.core.signals import FloatArray

STEP_PAUSE_S = 2.0  #: between two steps of one quantity, so that they do not add up to one that is larger than allowed
NEAR = 0.2  #: a tension this near its set-point, as a fraction, has followed it


class Setpoints:
    """Tensions (n,) in N and the line's speed in m/s: now, and where they move to."""

    def __init__(self, recipe: Recipe) -> None:
        n = len(recipe.tension_n)
        self.recipe = recipe
        self.tension_n: FloatArray = np.zeros(n)  #: what control follows now
        self.tension_target_n: FloatArray = np.array(recipe.tension_n)
        self.speed_m_per_s = 0.0  #: what is asked of the line PLC now
        self.speed_target_m_per_s = recipe.speed_m_per_s  #: what the operator wants while the line runs
        self._tension_stepped_s: FloatArray = np.full(n, -inf)
        self._speed_stepped_s = -inf

    def aim_at(self, recipe: Recipe) -> None:
        """The recipe's set-points become the targets."""
        self.recipe = recipe
        self.tension_target_n = np.array(recipe.tension_n)
        self.speed_target_m_per_s = recipe.speed_m_per_s

    def begin_at(self, tension_n: FloatArray) -> None:
        """Start from what is measured, so that nothing jumps when control takes over. Targets stay."""
        self.tension_n = np.minimum(np.maximum(tension_n, 0.0), self.tension_target_n)

    def step_tension(self, span: int, tension_n: float, now_s: float) -> None:
        """Make a change at once. Span from 0."""
        self.tension_n[span] = self.tension_target_n[span] = tension_n
        self._tension_stepped_s[span] = now_s

    def step_speed(self, speed_m_per_s: float, now_s: float) -> None:
        self.speed_m_per_s = self.speed_target_m_per_s = speed_m_per_s
        self._speed_stepped_s = now_s

    def tension_step_pause_s(self, span: int, now_s: float) -> float:
        """Seconds until another step of this tension may be made; not positive when it may be made now."""
        return float(self._tension_stepped_s[span]) + STEP_PAUSE_S - now_s

    def speed_step_pause_s(self, now_s: float) -> float:
        return self._speed_stepped_s + STEP_PAUSE_S - now_s

    def advance(self, moves: Moves, period_s: float, speed_goal_m_per_s: float, speed_rate_m_per_s2: float) -> None:
        """Move on by one period: tensions towards their targets, speed towards `speed_goal_m_per_s`."""
        if not self._there():
            reach = moves.tension_rate_n_per_s * period_s
            self.tension_n = self.tension_n + np.clip(self.tension_target_n - self.tension_n, -reach, reach)
        reach = speed_rate_m_per_s2 * period_s
        self.speed_m_per_s += max(-reach, min(reach, speed_goal_m_per_s - self.speed_m_per_s))

    def followed_by(self, tension_n: FloatArray, measured: FloatArray) -> bool:
        """Whether every set-point is where it shall be and every measured tension (n,) is near it."""
        if not self._there():
            return False
        near = np.abs(tension_n - self.tension_n) <= NEAR * self.tension_n
        return bool(near[measured > 0].all())

    def _there(self) -> bool:
        """Whether every tension's set-point has reached its target."""
        return not np.count_nonzero(self.tension_n != self.tension_target_n)
