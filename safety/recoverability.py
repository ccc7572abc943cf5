"""Would the fallback configuration still bring the line back, if it took over with the next sample?

Its closed loop with the accepted model is linear until a torque meets its limit or its rate, and so one product says
where tensions, speeds and torques go over the horizon. Only where a torque would meet a limit is the way gone step by
step, with the limit. Pure; numpy only, for it runs in the loop.

With x~ = x - x_eq and u~ = u - u_eq away from the model's equilibrium, u~ in flight newest first, and z what the law
remembers (see `linear_form`), s = [x~; u~ in flight; z]:

    u = K s + c,    s_next = A s + B u + d

with matrices that are computed once (safety/recovery_ways.py).
"""

from bisect import bisect_right
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from gateway.control.deviation import Deviation, Measured
from gateway.control.reference import Steady
from gateway.core.controller import Controller
from gateway.core.controller_laws import MpcConfig
from gateway.core.controller_schedule import LinearConfig, ScheduledConfig, law_at
from gateway.core.deployment import RecoveryPrediction
from gateway.core.line import Line
from gateway.core.line_limits import tension_bands_n, torque_limits_nm
from gateway.core.signals import FloatArray
from safety.limits import envelope_limits
from safety.recovery_ways import ClosedLoop, closed_loop

MOST_TRIED = 4  #: times that the rest is looked at in one, from a period on that cut no torque
NEAR_SETPOINT = 0.5  #: of what a set-point keeps from a limit, tensions may keep as well
STEP_MARGINS = 1.1  #: times these margins is what tensions must keep in a step that is still to be made: noise follows
EXCUSED = 1e-6  #: of a torque's limit and rate, for rounding


@dataclass(frozen=True, slots=True)
class Shortfall:
    """What the fallback would not keep: a span's tension or a roller's speed (from 0), what it comes to, and when."""

    what: str  #: "span" or "roller"
    index: int
    value: float  #: N or m/s
    allowed: float
    ahead_s: float

    @property
    def parameters(self) -> dict[str, float]:
        """Of a finding."""
        value, allowed = ("tension_n", "allowed_n") if self.what == "span" else ("speed_m_per_s", "allowed_m_per_s")
        return {self.what: self.index + 1, value: self.value, allowed: self.allowed, "ahead_s": self.ahead_s}


class Recovery:
    """A `RecoveryPrediction` for a line, with its fallback."""

    def __init__(self, watch: RecoveryPrediction, fallback: Controller, line: Line) -> None:
        """Takes some milliseconds."""
        self.fallback = watch.fallback
        self.periods = round(watch.horizon_s / watch.period_s)
        self.depth = len(watch.nodes[0].inputs) - 1  #: torques in flight on the model's side
        self._n = watch.n
        self._period_s = watch.period_s
        self._margin_n = watch.margin_n
        limits = line.limits
        self._low_n, self._high_n = tension_bands_n(line)
        self._envelope = envelope_limits(line)
        self._fastest = self._envelope.roller_speed_watched_m_per_s
        self._torque_nm = torque_limits_nm(line) * (1.0 + EXCUSED)
        self._torques_nm = self._torque_nm[:, None]
        self._step_nm = limits.torque_rate_nm_per_s * watch.period_s
        self._draw = [i for i, span in enumerate(line.spans) if span.control == "draw"]
        self._each: NDArray[np.int64] = np.arange(self.periods + 1, dtype=np.int64)
        self._looks = _looks(self._each, watch.n)
        # The first torque follows the one that is sent now.
        self._steps_nm = self._step_nm * (1.0 + EXCUSED) * np.diff(self._looks, prepend=-1)
        self._setpoints = b""  #: that the next two belong to
        self._least = self._most = np.zeros(2 * watch.n)  #: of tensions and speeds
        speeds = [node.speed_m_per_s for node in watch.nodes]
        self._middles = [0.5 * (low + high) for low, high in pairwise(speeds)]
        self._loops = [closed_loop(node, _law(fallback, node.speed_m_per_s), self._looks) for node in watch.nodes]
        self._law = Deviation(fallback.feedforward, fallback.draw_spans, fallback.period_s, fallback.latency_s)
        self._model = Deviation(watch.model, self._draw, watch.period_s, 0.0)
        self._coulomb_nm = np.array(watch.coulomb_nm)

    def shortfall(
        self,
        measured: Measured,
        setpoint_n: FloatArray,
        in_flight_nm: FloatArray,
        torque_nm: FloatArray,
        remembered: FloatArray | None = None,
    ) -> Shortfall | None:
        """What goes wrong if `torque_nm` (n,) is sent now and the fallback controls from the next sample on.

        `in_flight_nm` (depth, n): sent before, newest first. `remembered` (z,): the fallback runs already and
        remembers this at the next sample; None: it would take over then, without a jump.
        """
        found, looks = self.ahead(measured, setpoint_n, in_flight_nm, torque_nm, remembered)
        return self._within(found, looks, *self._bounds(setpoint_n))

    def shortfall_of_step(
        self,
        measured: Measured,
        setpoint_n: FloatArray,
        in_flight_nm: FloatArray,
        torque_nm: FloatArray,
        remembered: FloatArray | None,
    ) -> Shortfall | None:
        """What would go wrong if set-points, or the unwinder's speed, stepped to these.

        A little more must be kept than `shortfall` asks for, which would stop the line for a step of its own that
        noise has taken a tenth of a newton further.
        """
        found, looks = self.ahead(measured, setpoint_n, in_flight_nm, torque_nm, remembered)
        fastest = self._envelope.roller_speed_in_step_m_per_s(measured.unwind_speed_m_per_s)
        return self._within(found, looks, *self._kept(setpoint_n, STEP_MARGINS, fastest))

    def _within(
        self, found: FloatArray, looks: NDArray[np.int64], least: FloatArray, most: FloatArray
    ) -> Shortfall | None:
        if (found.min(axis=1) >= least).all() and (found.max(axis=1) <= most).all():
            return None
        return self._short(found, looks, least, most)

    def ahead(
        self,
        measured: Measured,
        setpoint_n: FloatArray,
        in_flight_nm: FloatArray,
        torque_nm: FloatArray,
        remembered: FloatArray | None = None,
    ) -> tuple[FloatArray, NDArray[np.int64]]:
        """Tensions, then speeds (2n, k) where it is looked at, and when (k,): periods after the next sample."""
        n, reference, unwind = self._n, Steady(setpoint_n), measured.unwind_speed_m_per_s
        loop = self._loops[bisect_right(self._middles, unwind)]
        x_eq = self._model.state(reference, unwind)
        u_eq = self._model.torque(reference, unwind, 0) + self._coulomb_nm * np.sign(x_eq[n:])
        tension_n = measured.tension_n
        if self._draw:
            tension_n = tension_n.copy()
            tension_n[self._draw] = setpoint_n[self._draw]
        known = (
            tension_n, measured.speed_m_per_s, in_flight_nm.ravel(), torque_nm, x_eq, u_eq,
            self._law.state(reference, unwind), self._law.torque(reference, unwind, 0),
        )  # fmt: skip
        if remembered is None:
            way, q = loop.taking_over, np.concatenate(known)
        else:
            way, q = loop.running, np.concatenate((*known, remembered))
        if self._never_cut(way.torques.dot(q).reshape(n, -1), torque_nm):
            return way.states.dot(q).reshape(2 * n, -1), self._looks
        return self._step_by_step(loop, way.begin.dot(q), x_eq, torque_nm)

    def _never_cut(self, asked_nm: FloatArray, before_nm: FloatArray) -> bool:
        """Whether torques (n, k) at the looks, after `before_nm` (n,), keep limit and rate. Most periods they do."""
        change_nm = np.abs(asked_nm - np.concatenate((before_nm[:, None], asked_nm[:, :-1]), axis=1))
        return bool(
            (np.abs(asked_nm) <= self._torques_nm).all() and (change_nm <= self._steps_nm[: len(change_nm[0])]).all()
        )

    def _step_by_step(
        self, loop: ClosedLoop, begin: FloatArray, x_eq: FloatArray, before_nm: FloatArray
    ) -> tuple[FloatArray, NDArray[np.int64]]:
        """As `ahead`, with torques cut as the envelope cuts them, until after some cut none is cut any more."""
        n, states = self._n, len(loop.B)
        s, d, c = begin[:states], begin[states : 2 * states], begin[2 * states :]
        constant, driven = np.concatenate((d, loop.K.dot(d) + c)), loop.B.dot(c) + d
        now = np.concatenate((s, loop.K.dot(s) + c))  # [s; u], u as it is asked for until it is cut
        gone: list[FloatArray] = []
        tried, cut_before = 0, False
        for k in range(1, self.periods + 2):
            cut = self._cut(now[states:], before_nm)
            cut_before |= cut
            before_nm = now[states:]
            gone.append(now)
            now = loop.period.dot(now)
            now += constant
            if cut_before and not cut and tried < MOST_TRIED and k <= self.periods:
                tried += 1
                begin = np.concatenate((now[:states], driven))
                rest = int(np.searchsorted(self._looks, self.periods - k, side="right"))  # of the looks, in the horizon
                asked = loop.onward.torques.dot(begin).reshape(n, -1)[:, :rest]
                if self._never_cut(asked + c[:, None], before_nm):
                    onward = loop.onward.states.dot(begin).reshape(2 * n, -1)[:, :rest]
                    found = np.hstack((np.array(gone).T[: 2 * n], onward))
                    return found + x_eq[:, None], np.concatenate((self._each[:k], self._looks[:rest] + k))
        return np.array(gone).T[: 2 * n] + x_eq[:, None], self._each

    def _cut(self, torque_nm: FloatArray, before_nm: FloatArray) -> bool:
        """Cut what is asked for (n,), in place, to rate and limit; whether anything was cut."""
        asked, step_nm, most_nm = torque_nm.tobytes(), self._step_nm, self._torque_nm
        np.maximum(torque_nm, before_nm - step_nm, out=torque_nm)
        np.minimum(torque_nm, before_nm + step_nm, out=torque_nm)
        np.maximum(torque_nm, -most_nm, out=torque_nm)
        np.minimum(torque_nm, most_nm, out=torque_nm)
        return torque_nm.tobytes() != asked

    def _bounds(self, setpoint_n: FloatArray) -> tuple[FloatArray, FloatArray]:
        """What tensions and speeds (2n,) must keep."""
        setpoints = setpoint_n.tobytes()
        if setpoints != self._setpoints:
            self._least, self._most = self._kept(setpoint_n, 1.0, self._fastest)
            self._setpoints = setpoints
        return self._least, self._most

    def _kept(self, setpoint_n: FloatArray, margins: float, fastest_m_per_s: float) -> tuple[FloatArray, FloatArray]:
        """Least and most of tensions, so many margins from the limits, and of speeds (2n,)."""
        n, low_n, high_n = self._n, self._low_n, self._high_n
        least, most = np.empty(2 * n), np.empty(2 * n)
        np.minimum(self._margin_n, NEAR_SETPOINT * (setpoint_n - low_n), out=least[:n])
        np.minimum(self._margin_n, NEAR_SETPOINT * (high_n - setpoint_n), out=most[:n])
        least[:n] = low_n + margins * least[:n]
        most[:n] = high_n - margins * most[:n]
        if self._draw:  # nobody sees the tension of a draw span
            least[self._draw], most[self._draw] = -np.inf, np.inf
        least[n:], most[n:] = -fastest_m_per_s, fastest_m_per_s
        return least, most

    def _short(self, found: FloatArray, looks: NDArray[np.int64], least: FloatArray, most: FloatArray) -> Shortfall:
        """The tension that is furthest beyond its bounds, or the speed where no tension is."""
        over = np.maximum(least[:, None] - found, found - most[:, None])
        n = self._n
        first = 0 if (over[:n] > 0.0).any() else n
        i, k = np.unravel_index(int(over[first : first + n].argmax()), over[:n].shape)
        value = float(found[first + i, k])
        allowed = float(least[first + i] if value < least[first + i] else most[first + i])
        return Shortfall("roller" if first else "span", int(i), value, allowed, float(looks[k] + 1) * self._period_s)


def _looks(each: NDArray[np.int64], n: int) -> NDArray[np.int64]:
    """Every period at the beginning, then every third; on a longer line fewer, for each takes more."""
    closely, stride = (8, 3) if n <= 8 else (4, max(3, n // 4))
    return np.concatenate((each[:closely], each[closely::stride]))


def _law(fallback: Controller, speed_m_per_s: float) -> LinearConfig | MpcConfig:
    return law_at(fallback, speed_m_per_s) if isinstance(fallback, ScheduledConfig) else fallback
