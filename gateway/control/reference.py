"""Where the line shall be: set-points that stand, or move along minimum-jerk polynomials."""

from dataclasses import dataclass
from math import copysign
from typing import Protocol

import numpy as np

from gateway.core.signals import FloatArray

HAIR_S = 1e-9  #: to the end of a move that no sum of periods meets exactly


@dataclass(frozen=True, slots=True)
class Motion:
    """A reference at one instant: tensions and their derivatives (n,), and what the unwinder does beside its speed."""

    tension_n: FloatArray
    tension_rate_n_per_s: FloatArray
    tension_acceleration_n_per_s2: FloatArray
    unwind_acceleration_m_per_s2: float  #: as asked of the line PLC
    unwind_speed_change_m_per_s: float  #: asked of it since the reference's own instant


class Reference(Protocol):
    """What a control law is told about the set-points."""

    @property
    def tension_n(self) -> FloatArray:
        """Set-points (n,) now."""
        ...

    @property
    def moving(self) -> bool:
        """Whether any set-point is on its way. A step is no motion: it is over as soon as it is known."""
        ...

    def ahead(self, time_s: float) -> Motion:
        """The reference so many seconds from now, as far as it is known now."""
        ...


@dataclass(frozen=True, slots=True)
class Steady:
    """Set-points (n,) in N that stand."""

    tension_n: FloatArray
    moving: bool = False

    def ahead(self, time_s: float) -> Motion:
        none = np.zeros(len(self.tension_n))
        return Motion(self.tension_n, none, none, 0.0, 0.0)


class MinimumJerk:
    """Values (m,), each on its own way to a target: the quintic from where it is, with its rate and acceleration.

    Of all curves that take a given time from rest to rest it has the least mean squared jerk (Flash and Hogan 1985).
    A value may also go to its target on a ramp, or be put somewhere.
    """

    PEAK = 15.0 / 8.0  #: greatest rate, in units of distance over time, from rest to rest

    def __init__(self, value: FloatArray) -> None:
        self._begin_s: FloatArray = np.zeros(len(value))
        self._time_s: FloatArray = np.zeros(len(value))  #: that the move takes; 0: it stands
        self._polynomial: FloatArray = np.zeros((6, len(value)))  #: of the time since the beginning, lowest power first
        self._polynomial[0] = value
        self._rate_before: FloatArray = np.zeros(len(value))  #: at which it came to where its way begins
        self.target: FloatArray = np.array(value, dtype=np.float64)

    def put(self, index: int | slice, value: float | FloatArray) -> None:
        """It is there at once, and stands; or several are."""
        self._polynomial[:, index] = 0.0
        self._polynomial[0, index] = self.target[index] = value
        self._time_s[index] = self._rate_before[index] = 0.0

    def move(self, index: int, target: float, greatest_rate: float, now_s: float, least_s: float = 0.0) -> None:
        """Set out for `target` at once; from rest the rate stays at `greatest_rate` or below, in units per second.

        From a value that moves already, rate and acceleration are kept at first, and it may go past its target. A move
        takes `least_s` or longer: one of a hair's breadth in no time at all has a small rate and a huge acceleration.
        """
        value, rate, acceleration = self.at(now_s)[:, index]
        distance = target - value
        left_s = (
            self._begin_s[index] + self._time_s[index] - now_s
        )  # of the move under way: what moves is not torn round
        time_s = max(self.PEAK * abs(distance) / greatest_rate, left_s, least_s)
        if time_s < 1e-6:  # nothing that anybody would see, and nothing to divide by
            self.put(index, target)
            return
        a, v, T = 0.5 * acceleration * time_s**2, rate * time_s, time_s
        # value + v s + a s^2 + c3 s^3 + c4 s^4 + c5 s^5, s = t / T, with rate and acceleration 0 at s = 1
        rest = distance - v - a
        slope, bend = -v - 2.0 * a, -2.0 * a
        c3, c4, c5 = (
            10.0 * rest - 4.0 * slope + 0.5 * bend,
            -15.0 * rest + 7.0 * slope - bend,
            6.0 * rest - 3.0 * slope + 0.5 * bend,
        )
        self._polynomial[:, index] = [value, v / T, a / T**2, c3 / T**3, c4 / T**4, c5 / T**5]
        self._begin(index, now_s, time_s, rate)
        self.target[index] = target

    def ramp(self, index: int, target: float, rate: float, now_s: float) -> None:
        """Set out for `target` at a constant rate (positive, units per second), whatever its rate is now."""
        value, before, _ = self.at(now_s)[:, index].tolist()
        self._polynomial[:, index] = 0.0
        self._polynomial[:2, index] = value, copysign(rate, target - value)
        self._begin(index, now_s, abs(target - value) / rate, before)
        self.target[index] = target

    def _begin(self, index: int, now_s: float, time_s: float, rate_before: float) -> None:
        self._begin_s[index], self._time_s[index], self._rate_before[index] = now_s, time_s, rate_before

    def moving(self, now_s: float) -> bool:
        """Whether any value is on its way."""
        return bool(np.count_nonzero((self._time_s > 0.0) & (self._begin_s + self._time_s > now_s)))

    def is_moving(self, index: int, now_s: float) -> bool:
        """Whether this value is on its way."""
        return bool(self._time_s[index] > 0.0 and self._begin_s[index] + self._time_s[index] > now_s)

    def of(self, index: int, now_s: float) -> tuple[float, float]:
        """Value and rate of one of them at a time, as `at` has them, sooner."""
        since = now_s - float(self._begin_s[index])
        c0, c1, c2, c3, c4, c5 = self._polynomial[:, index].tolist()
        if since < 0.0:
            rate = float(self._rate_before[index])
            return c0 + since * rate, rate
        if since >= float(self._time_s[index]) - HAIR_S:
            return float(self.target[index]), 0.0
        s = since
        value = c0 + s * (c1 + s * (c2 + s * (c3 + s * (c4 + s * c5))))
        return value, c1 + s * (2.0 * c2 + s * (3.0 * c3 + s * (4.0 * c4 + s * 5.0 * c5)))

    def at(self, now_s: float) -> FloatArray:
        """Value, rate and acceleration (3, m) at a time; before a move began, at the rate that led to its beginning."""
        since: FloatArray = now_s - self._begin_s
        s: FloatArray = np.clip(since, 0.0, self._time_s)
        c = self._polynomial
        found = np.empty((3, len(s)))
        found[0] = c[0] + s * (c[1] + s * (c[2] + s * (c[3] + s * (c[4] + s * c[5]))))
        found[1] = c[1] + s * (2.0 * c[2] + s * (3.0 * c[3] + s * (4.0 * c[4] + s * 5.0 * c[5])))
        found[2] = 2.0 * c[2] + s * (6.0 * c[3] + s * (12.0 * c[4] + s * 20.0 * c[5]))
        over = s >= self._time_s - HAIR_S
        found[0, over], found[1:, over] = self.target[over], 0.0
        before = since < 0.0
        if before.any():
            rate = self._rate_before[before]
            found[:, before] = c[0, before] + since[before] * rate, rate, np.zeros(len(rate))
        return found
