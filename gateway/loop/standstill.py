"""Whether anything on the line still moves, as far as it is measured."""

import numpy as np

from gateway.core.signals import Inputs
from gateway.loop import machine as machines

STILL_S = 0.3  #: for so long nothing has moved: noise is no movement, and one sample no standstill


def standing(inputs: Inputs) -> bool:
    """Whether the unwinder is known to stand still."""
    unwind = inputs.unwind_speed
    return unwind.good() and abs(unwind.value.item(0)) <= machines.STANDSTILL_M_PER_S


class Standstill:
    """Of unwinder and rollers. A web that has broken may stand at one end and run at the other."""

    def __init__(self, period_s: float) -> None:
        self._period_s = period_s
        self._still = 0  #: periods in a row

    def look(self, inputs: Inputs, asked: bool) -> bool:
        """Once a period. `asked`: a speed is wanted."""
        speed = inputs.speed
        still = not asked and standing(inputs) and speed.good()
        still = still and float(np.abs(speed.value).max()) <= machines.STANDSTILL_M_PER_S
        self._still = self._still + 1 if still else 0
        return self._still * self._period_s >= STILL_S
