"""What torques do in an experiment that may end it: they are at a limit, or turn round.

The same for whoever runs one and whoever foresees it, and per time, not per period: at a short period the noise of the
sensors alone moves a torque as far as its rate allows, to and fro, and no single period moves it far.
"""

import numpy as np

from gateway.core.signals import BoolArray, FloatArray

LASTING_S = 0.01  #: or a period, if that is longer: for so long a torque has gone one way as fast as it may
AS_FAST = 0.95  #: of its rate: a wake-up that is late leaves less of a period


def lasting_periods(period_s: float) -> int:
    """Periods of `LASTING_S`."""
    return max(1, round(LASTING_S / period_s))


def at_limit(torque_nm: FloatArray, before_nm: FloatArray, limit_nm: float | FloatArray, reach_nm: float) -> BoolArray:
    """Which torques are at a limit. `before_nm` are those of `LASTING_S` before, `reach_nm` how far they may have come.

    Any shape.
    """
    moved = np.abs(torque_nm - before_nm) >= AS_FAST * reach_nm
    return moved | (np.abs(torque_nm) >= limit_nm * (1.0 - 1e-9))


class Turns:
    """Torques of any shape that turn round: come back by more than `reversal_nm` from the farthest they have been."""

    def __init__(self, torque_nm: FloatArray, reversal_nm: float) -> None:
        self._reversal_nm = reversal_nm
        self._low = self._high = torque_nm  #: since each turned
        self._way: FloatArray = np.zeros(torque_nm.shape)  #: -1 or 1, once a torque has gone so far at all

    def after(self, torque_nm: FloatArray) -> BoolArray:
        """Which turn round in this period."""
        low, high = np.minimum(self._low, torque_nm), np.maximum(self._high, torque_nm)
        down = (self._way >= 0.0) & (high - torque_nm > self._reversal_nm)
        up = (self._way <= 0.0) & (torque_nm - low > self._reversal_nm)
        other = down | up
        turned = other & (self._way != 0.0)
        self._low, self._high = np.where(other, torque_nm, low), np.where(other, torque_nm, high)
        self._way = np.where(other, np.where(up, 1.0, -1.0), self._way)
        return turned
