"""Draw-controlled spans that no load cell sees: their rollers' speeds trimmed by what torques say of the tension.

A draw fixes a tension only while the line runs: T_i goes to what the ratio of speeds makes of it with L_i/v, and at
standstill never. There the roller before it takes web up or gives it back, and the span is slack or torn before
anybody knows. So the roller at its end is asked for a speed beside that of its draw,

    s_i = L_i/EA (T_set - T^_i) / tau

By this dT_i/dt is (T_set - T^_i) / tau at standstill, and every roller behind turns with it. Torques, speeds and
tolerances leave an interval open. Where T_set is outside of it, T^_i is certain to lie on one side, and at least its
nearer end is missing; within it, T^_i is the middle as far as the interval is narrow, and T_set where it is wide:

    T^_i = t + c_i (m - t)        t of the interval what is nearest to T_set, m its middle
    c_i = 1 - h / (T_set / 2)     h half of its width; not below 0

So within it a span is moved only where its tension is known to half of its set-point. Law and monitor are told each
roller's speed without what was added, and need to know nothing of it.

Of a web that is whole no span takes more at standstill than what stretches all of it to its tensions twice: beyond that
way the estimate is wrong, or the web is, and the span is left alone.
"""

import numpy as np

from gateway.core.line import Line
from gateway.core.signals import FloatArray
from gateway.core.tension_estimate import MEAN_PERIODS, balance_of
from safety.tensioning import AIM_SHARE, lag_s, tensioning_speed_m_per_s

LAGS = 3.0  #: tau in time constants of a roller's speed while tensioning, and of the averages of the estimate
SPEED_SHARE = 0.5  #: of the speed aimed at in tensioning: the rest is for set-points that move
NARROW = 0.5  #: half of an interval's width over the set-point, from which on its middle says nothing
STRETCHES = 2.0  #: of the whole web to its set-points, that rollers may turn by at standstill

_TINY_N = 1e-300  #: of a set-point of nothing, whose interval is never narrow


class DrawTrim:
    """Of one line. `added_m_per_s` (n,) is what each roller turns faster by; 0 where every span has a load cell."""

    def __init__(self, line: Line) -> None:
        self.spans = balance_of(line).estimated
        self.any = bool(self.spans.any())
        self.added_m_per_s: FloatArray = np.zeros(line.n)
        self._period_s = line.control.period_s
        self._stretch_m_per_n = np.array([span.length_m.value for span in line.spans]) / line.web.stiffness_n.value
        tau_s = LAGS * max(lag_s(line), MEAN_PERIODS * self._period_s)
        self._speed_per_n: FloatArray = np.where(self.spans, self._stretch_m_per_n / tau_s, 0.0)
        self._most_m_per_s = SPEED_SHARE * AIM_SHARE * tensioning_speed_m_per_s(line)
        self._step_m_per_s = self._most_m_per_s * self._period_s / lag_s(line)  #: of what is added, in a period
        self._own_m_per_s: FloatArray = np.zeros(line.n)  #: what each span's roller adds to those before it
        self._way_m: FloatArray = np.zeros(line.n)  #: by that, since the line stands

    def step(self, set_n: FloatArray, interval_n: FloatArray | None, *, stands: bool) -> None:
        """Trim towards `set_n` (n,) tensions within `interval_n` (2, n); None: nothing of it can be relied on.

        `stands`: the line is not to run. What is added changes on a ramp, all of it alike.
        """
        wanted = np.zeros_like(set_n) if interval_n is None else self._wanted(set_n, interval_n)
        way_m = self._way_m if stands else np.zeros_like(self._way_m)
        most_m = STRETCHES * float((self._stretch_m_per_n * np.maximum(set_n, 0.0)).sum())
        wanted = np.where((np.abs(way_m) < most_m) | (wanted * way_m < 0.0), wanted, 0.0)
        added = np.cumsum(wanted)
        if (greatest := float(np.abs(added).max())) > self._most_m_per_s:
            wanted, added = wanted * (self._most_m_per_s / greatest), added * (self._most_m_per_s / greatest)
        change = float(np.abs(added - self.added_m_per_s).max())
        share = self._step_m_per_s / change if change > self._step_m_per_s else 1.0
        self._own_m_per_s = self._own_m_per_s + share * (wanted - self._own_m_per_s)
        self.added_m_per_s = np.cumsum(self._own_m_per_s)
        self._way_m = way_m + self._own_m_per_s * self._period_s

    def _wanted(self, set_n: FloatArray, interval_n: FloatArray) -> FloatArray:
        """What each span's roller (n,) is to add to those before it, without any bound."""
        known = self.spans & np.isfinite(interval_n).all(axis=0)
        least_n, most_n = np.where(known, interval_n, set_n)
        nearest_n = np.minimum(np.maximum(set_n, least_n), most_n)
        half_n, middle_n = 0.5 * (most_n - least_n), 0.5 * (most_n + least_n)
        surely = np.maximum(1.0 - half_n / np.maximum(NARROW * set_n, _TINY_N), 0.0)
        return self._speed_per_n * (set_n - nearest_n - surely * (middle_n - nearest_n))

    def off(self) -> None:
        """No law controls: nothing is added."""
        self.added_m_per_s = np.zeros_like(self.added_m_per_s)
        self._own_m_per_s = np.zeros_like(self._own_m_per_s)
        self._way_m = np.zeros_like(self._way_m)

    def begun_n(self, interval_n: FloatArray) -> FloatArray:
        """What spans without a load cell are taken to have (n,) as a law begins: set-points begin there."""
        middle_n = np.where(self.spans & np.isfinite(interval_n).all(axis=0), interval_n, 0.0).mean(axis=0)
        return np.maximum(middle_n, 0.0)
