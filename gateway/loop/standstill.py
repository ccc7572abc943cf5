"""Whether anything on the line still moves, as far as it is measured."""

import numpy as np

from gateway.core.finding import Finding, finding
from gateway.core.line import Line
from gateway.core.signals import Channel, FloatArray, Inputs, Quality

STILL_MOMENTS = 15.0  #: in which nothing has moved: one sample is no standstill
MOVES = 2.0  #: times what counts as standstill: what stood moves again; less may be noise
#: Of the line's greatest speed, and whatever that is: from where on the unwinder counts as turning, and a roller. A
#: web that gives way after a stop lets its rollers creep for a while, at less than half of what they tension it with.
UNWINDER_TURNS_SHARE, UNWINDER_TURNS_M_PER_S = 0.02, 0.02
ROLLER_TURNS_SHARE, ROLLER_TURNS_M_PER_S = 0.05, 0.05
MEAN_SHARE = 0.25  #: by which a mean speed follows a sample: of an encoder's noise a third is left
UNUSABLE_PERIODS = 5  #: in a row: then nobody knows whether a roller turns that something moves in no known way
LATELY_S = 0.25  #: a speed that has not been heard for so long says nothing; a silent link asks several times a second

_BAD = int(Quality.BAD)


def standing(inputs: Inputs, standstill_m_per_s: float) -> bool:
    """Whether the unwinder is known to stand still."""
    unwind = inputs.unwind_speed
    return unwind.good() and abs(unwind.value.item(0)) <= standstill_m_per_s


def turns_m_per_s(line: Line) -> FloatArray:
    """The mean speeds (n+1,) from which on the unwinder, and each roller, counts as turning."""
    fastest = line.limits.speed_max_m_per_s
    unwinder = min(UNWINDER_TURNS_SHARE * fastest, UNWINDER_TURNS_M_PER_S)
    roller = min(ROLLER_TURNS_SHARE * fastest, ROLLER_TURNS_M_PER_S)
    return np.array([unwinder, *[roller] * line.n])


class Standstill:
    """Of unwinder and rollers. A web that has broken may stand at one end and run at the other."""

    def __init__(self, line: Line, standstill_m_per_s: float, still_periods: int) -> None:
        """`still_periods`: in a row without a movement, until nothing moves."""
        self._still_periods = still_periods
        self._standstill_m_per_s = standstill_m_per_s
        self._period_s = line.control.period_s
        self._turns_m_per_s = turns_m_per_s(line)
        self._mean: FloatArray = np.full(line.n + 1, np.nan)  #: of the unwinder's speed, then the rollers'
        self._anew = True  #: the mean begins with the next sample
        self._gap = np.zeros(line.n + 1, np.int64)  #: periods in a row without a usable sample, unwinder first
        self._unusable = np.zeros(line.n, np.int64)  #: periods in a row in which a roller's sample could not be true
        self._still = 0  #: periods in a row
        self._stands = False

    def look(self, inputs: Inputs, asked: bool) -> bool:
        """Once a period. `asked`: a speed is wanted."""
        fastest = np.inf
        if asked:
            self._anew = True
        else:
            unwind, rollers = inputs.unwind_speed, inputs.speed
            speeds = np.concatenate((unwind.value, rollers.value))
            good = unwind.good() and rollers.good()
            self._follow(speeds, inputs, good)
            # Of numpy: Python's own maximum passes over what is no number; that does not stand.
            fastest = float(np.abs(speeds).max()) if good else np.inf
        most = MOVES * self._standstill_m_per_s if self._stands else self._standstill_m_per_s
        self._still = self._still + 1 if fastest <= most else 0
        self._stands = self._still >= self._still_periods
        return self._stands

    def _follow(self, speeds: FloatArray, inputs: Inputs, good: bool) -> None:
        share = MEAN_SHARE
        if self._anew:
            self._anew = False
            self._mean = speeds
            self._gap.fill(0)
        if not good or self._gap.any():
            self._unusable = np.where(inputs.speed.quality == _BAD, self._unusable + 1, 0)
            there = np.concatenate((inputs.unwind_speed.quality, inputs.speed.quality)) == 0  # GOOD
            # What comes back after a while says nothing with what was before.
            share = np.where(there, np.where(self._gap * self._period_s >= LATELY_S, 1.0, MEAN_SHARE), 0.0)
            self._gap = np.where(there, 0, self._gap + 1)
        self._mean = np.where(np.isnan(self._mean), speeds, self._mean + share * (speeds - self._mean))

    def turning(self, inputs: Inputs, now_s: float) -> list[Finding]:
        """The unwinder and rollers that turn, or may: of whose speed only what cannot be true is heard.

        What has not been heard lately is not known to turn.
        """
        fast = np.flatnonzero(~(np.abs(self._mean) <= self._turns_m_per_s)).tolist()  # NaN does not stand still
        doubted = np.flatnonzero(self._unusable >= UNUSABLE_PERIODS).tolist()
        found = [finding("roller-speed-unknown", roller=i + 1) for i in doubted]
        for i in fast:
            speed = float(self._mean[i])
            if i == 0 and _heard(inputs.unwind_speed, 0, now_s):
                found.append(finding("unwinder-turns", speed_m_per_s=speed))
            elif i > 0 and _heard(inputs.speed, i - 1, now_s):
                found.append(finding("roller-turns", roller=i, speed_m_per_s=speed))
        return found


def _heard(channel: Channel, index: int, now_s: float) -> bool:
    return bool(now_s - channel.time_s[index] < LATELY_S)
