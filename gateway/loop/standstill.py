"""Whether anything on the line still moves, as far as it is measured."""

import numpy as np

from gateway.core.signals import Inputs
from gateway.loop import machine as machines

STILL_S = 0.3  #: for so long nothing has moved: one sample is no standstill
MOVES_M_PER_S = 2.0 * machines.STANDSTILL_M_PER_S  #: what stood moves again; less may be noise


def standing(inputs: Inputs) -> bool:
    """Whether the unwinder is known to stand still."""
    unwind = inputs.unwind_speed
    return unwind.good() and abs(unwind.value.item(0)) <= machines.STANDSTILL_M_PER_S


class Standstill:
    """Of unwinder and rollers. A web that has broken may stand at one end and run at the other."""

    def __init__(self, period_s: float) -> None:
        self._period_s = period_s
        self._still = 0  #: periods in a row
        self._stands = False

    def look(self, inputs: Inputs, asked: bool) -> bool:
        """Once a period. `asked`: a speed is wanted."""
        known = not asked and inputs.unwind_speed.good() and inputs.speed.good()
        unwind, rollers = inputs.unwind_speed.value, inputs.speed.value
        # Of numpy: Python's own maximum passes over what is no number; that does not stand.
        fastest = float(np.abs(np.concatenate((unwind, rollers))).max()) if known else np.inf
        most = MOVES_M_PER_S if self._stands else machines.STANDSTILL_M_PER_S
        self._still = self._still + 1 if fastest <= most else 0
        self._stands = self._still * self._period_s >= STILL_S
        return self._stands
