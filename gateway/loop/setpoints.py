"""Set-points on their way: where they are now, where they shall be, and how fast they may move. Pure."""

from dataclasses import dataclass

import numpy as np

from gateway.core.line import Moves
from gateway.core.signals import FloatArray


@dataclass(slots=True)
class Setpoints:
    tension_n: FloatArray  #: (n,), what control follows now
    tension_target_n: FloatArray  #: (n,), where it moves to
    speed_m_per_s: float = 0.0  #: what is asked of the line PLC now
    speed_target_m_per_s: float = 0.0  #: what the operator wants while the line runs

    def begin_at(self, tension_n: FloatArray) -> None:
        """Start from what is measured, so that nothing jumps when control takes over. Targets stay."""
        self.tension_n = np.minimum(np.maximum(tension_n, 0.0), self.tension_target_n)

    def advance(self, moves: Moves, period_s: float, speed_goal_m_per_s: float, speed_rate_m_per_s2: float) -> None:
        """Move on by one period: tensions towards their targets, speed towards `speed_goal_m_per_s`."""
        reach = moves.tension_rate_n_per_s * period_s
        self.tension_n = self.tension_n + np.clip(self.tension_target_n - self.tension_n, -reach, reach)
        reach = speed_rate_m_per_s2 * period_s
        self.speed_m_per_s += max(-reach, min(reach, speed_goal_m_per_s - self.speed_m_per_s))

    def reached(self) -> bool:
        """Whether every tension set-point is where it shall be."""
        return bool((self.tension_n == self.tension_target_n).all())
