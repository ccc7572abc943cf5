"""The two cases of the benchmark: what the line does before, what changes at 1 s, how long it is watched."""

from dataclasses import dataclass, replace

import numpy as np

from gateway.control.reference import MinimumJerk
from gateway.core.messages import SetSpeed, SetTension
from gateway.core.signals import FloatArray

CHANGE_AT_S = 1.0
DURATION_S = 15.0


@dataclass(frozen=True)
class Case:
    name: str
    title: str
    description: str
    tension_n: tuple[float, ...]  #: before the change, one per span
    unwind_speed_m_per_s: float  #: before the change
    change: SetTension | SetSpeed  #: a literal step, made at once, unless `move_s` says otherwise
    move_s: float = 0.0  #: that the change takes along a minimum-jerk curve; 0: it is a step

    def setpoints_n(self, time_s: FloatArray) -> FloatArray:
        """Set-points (k, n) in N at `time_s` (k,), counted from the start of the case."""
        setpoints = np.tile(np.array(self.tension_n), (len(time_s), 1))
        if isinstance(self.change, SetTension):
            i, end_n = self.change.span - 1, self.change.tension_n
            if self.move_s:
                begin_n = self.tension_n[i]
                curve = MinimumJerk(np.array([begin_n]))
                curve.move(0, end_n, MinimumJerk.PEAK * abs(end_n - begin_n) / self.move_s, CHANGE_AT_S)
                after = time_s >= CHANGE_AT_S
                setpoints[after, i] = [curve.at(t)[0, 0] for t in time_s[after].tolist()]
            else:
                setpoints[time_s >= CHANGE_AT_S, i] = end_n
        return setpoints

    @property
    def size(self) -> float:
        """Of the change, in N or m/s."""
        if isinstance(self.change, SetTension):
            return abs(self.change.tension_n - self.tension_n[self.change.span - 1])
        return abs(self.change.speed_m_per_s - self.unwind_speed_m_per_s)

    def moved_over(self, move_s: float) -> "Case":
        """The same, along a minimum-jerk curve of so many seconds."""
        change = self.change.model_copy(update={"step": False})
        return replace(self, change=change, move_s=move_s)


TENSION = Case(
    name="tension",
    title="Tension case",
    description="Six spans at 28/36/20/40/24/32 N and 0.01 m/s; span 3 steps from 20 to 44 N at 1 s.",
    tension_n=(28.0, 36.0, 20.0, 40.0, 24.0, 32.0),
    unwind_speed_m_per_s=0.01,
    change=SetTension(span=3, tension_n=44.0, step=True),
)
VELOCITY = Case(
    name="velocity",
    title="Velocity case",
    description="All spans at 30 N; the unwinder steps from 0.01 to 0.10 m/s at 1 s.",
    tension_n=(30.0,) * 6,
    unwind_speed_m_per_s=0.01,
    change=SetSpeed(speed_m_per_s=0.10, step=True),
)
CASES = (TENSION, VELOCITY)
