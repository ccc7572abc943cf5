"""The two cases of the benchmark: what the line does before, what changes at 1 s, how long it is watched."""

from dataclasses import dataclass

import numpy as np

from gateway.core.messages import Command, SetSpeed, SetTension
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
    change: Command  #: a literal step, made at once

    def setpoints_n(self, time_s: FloatArray) -> FloatArray:
        """Set-points (k, n) in N at `time_s` (k,), counted from the start of the case."""
        setpoints = np.tile(np.array(self.tension_n), (len(time_s), 1))
        if isinstance(self.change, SetTension):
            setpoints[time_s >= CHANGE_AT_S, self.change.span - 1] = self.change.tension_n
        return setpoints


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
