"""The stop after a web break, or without tension control, from its first period to its last.

`safety.braking`, and the request to the unwinder.
"""

from gateway.core.line import Line
from gateway.core.signals import BoolArray, FloatArray, Inputs
from gateway.loop.setpoints import Setpoints
from safety.braking import Braking, BrakingState, begin, brake, braking_limits
from safety.limits import EnvelopeLimits


class Brake:
    """`over`: nothing that may be braked turns any more, as of the last period of it."""

    def __init__(self, line: Line, limits: EnvelopeLimits) -> None:
        self.over = False
        self._limits = braking_limits(line, limits)
        self._state: BrakingState | None = None

    def step(
        self, inputs: Inputs, setpoints: Setpoints, lost: BoolArray, applied_nm: FloatArray, *, signals_lost: bool
    ) -> Braking:
        """A period of it; the unwinder's speed is asked for through `setpoints`. `signals_lost`: for too long."""
        if self._state is None:
            speed_m_per_s, tension_n = setpoints.speed_m_per_s, setpoints.tension_n
            self._state = begin(self._limits, inputs, speed_m_per_s, tension_n, lost, signals_lost=signals_lost)
        found = brake(self._limits, self._state, inputs, lost, applied_nm)
        self.over = found.over
        setpoints.begin_at_speed(found.unwind_speed_m_per_s)
        return found

    def end(self) -> None:
        """The stop is over, or there is none."""
        if self._state is not None:
            self._state, self.over = None, False
