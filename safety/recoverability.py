"""Would the fallback configuration still bring the line back, if it took over with the next sample?

Its closed loop with the accepted model is linear until a torque meets its limit or its rate, and so one product says
where tensions and torques go over the horizon. Only where a torque would meet a limit is the way gone step by step,
with the limit. Pure; numpy only, for it runs in the loop.

With x~ = x - x_eq and u~ = u - u_eq away from the model's equilibrium, u~ in flight newest first, and z what the law
remembers (see `linear_form`), s = [x~; u~ in flight; z]:

    u = K s + c,    s_next = A s + B u + d
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from gateway.control.deviation import Deviation, Measured
from gateway.control.engagement import engagement
from gateway.control.linear_form import LinearForm, linear_form
from gateway.control.reference import Steady
from gateway.control.sampled import Sampled
from gateway.core.controller import Controller
from gateway.core.controller_laws import MpcConfig
from gateway.core.controller_schedule import LinearConfig, ScheduledConfig, law_at
from gateway.core.deployment import RecoveryNode, RecoveryPrediction
from gateway.core.line import Line
from gateway.core.signals import FloatArray

CLOSELY = 10  #: periods at the beginning of which each is looked at
STRIDE = 2  #: periods from one look to the next behind them
NEAR_SETPOINT = 0.5  #: of what a set-point keeps from a limit, tensions may keep as well
EXCUSED = 1e-6  #: of a torque's limit and rate, for rounding


@dataclass(frozen=True, slots=True)
class Shortfall:
    """Where the fallback would not keep the margin: span (from 0), the tension it would come to, and when."""

    span: int
    tension_n: float
    allowed_n: float
    ahead_s: float

    def __str__(self) -> str:
        return (
            f"span {self.span + 1} would come to {self.tension_n:.1f} N in {self.ahead_s:.2f} s if the fallback took "
            f"over now, allowed: {self.allowed_n:.1f} N"
        )


@dataclass(frozen=True)
class _Loop:
    """The fallback in closed loop with the model near one speed."""

    A: FloatArray  #: (s, s), without control
    B: FloatArray  #: (s, n)
    K: FloatArray  #: (n, s)
    form: LinearForm
    engaged: FloatArray  #: see `engagement`
    tension: FloatArray  #: (k n, 2 s), on [s; B c + d]: tensions at `looks`, less those of the equilibrium
    torque: FloatArray  #: (k n, 2 s), the same of K s


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
        self._low_n, self._high_n = limits.tension_min_n, limits.tension_max_n
        self._torque_nm = limits.torque_nm
        self._step_nm = limits.torque_rate_nm_per_s * watch.period_s
        draw = [i for i, span in enumerate(line.spans) if span.control == "draw"]
        self._draw = np.array(draw, dtype=np.intp)
        self._free = np.zeros(watch.n)  #: added to a span's bounds: nobody sees the tension of a draw span
        self._free[draw] = np.inf
        self._each: NDArray[np.int64] = np.arange(self.periods + 1, dtype=np.int64)
        self._looks = np.concatenate((self._each[:CLOSELY], self._each[CLOSELY::STRIDE]))
        self._between = np.diff(self._looks)[:, None].astype(np.float64)
        speeds = [node.speed_m_per_s for node in watch.nodes]
        self._middles = [0.5 * (low + high) for low, high in zip(speeds[:-1], speeds[1:], strict=True)]
        self._loops = [_loop(node, _law(fallback, node.speed_m_per_s), self._looks) for node in watch.nodes]
        self._law = Deviation(fallback.feedforward, fallback.draw_spans, fallback.period_s, fallback.latency_s)
        self._model = Deviation(watch.model, draw, watch.period_s, 0.0)
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
        loop = self._loops[sum(measured.unwind_speed_m_per_s > middle for middle in self._middles)]
        n, reference = self._n, Steady(setpoint_n)
        unwind = measured.unwind_speed_m_per_s
        x_ref, u_ref = self._law.state(reference, unwind), self._law.torque(reference, unwind, 0)
        x_eq = self._model.state(reference, unwind)
        u_eq = self._model.torque(reference, unwind, 0) + self._coulomb_nm * np.sign(x_eq[n:])
        x = np.concatenate((measured.tension_n, measured.speed_m_per_s))
        x[self._draw] = x_eq[self._draw]
        s = np.zeros(len(loop.A))
        s[: 2 * n] = x - x_eq
        physical = 2 * n + n * self.depth
        s[2 * n : physical] = (in_flight_nm - u_eq).ravel()
        s[:physical] = loop.A[:physical, :physical].dot(s[:physical]) + loop.B[:physical].dot(torque_nm - u_eq)
        if remembered is None:
            now = np.concatenate((s[: 2 * n] + x_eq, x_ref, u_ref, torque_nm))
            s[physical:] = loop.engaged.dot(now)
        else:
            s[physical:] = remembered
        away = np.concatenate((s[physical:] * 0.0, x_eq - x_ref, x_ref, u_ref))
        c = loop.form.torque.dot(away)
        d = np.zeros(len(s))
        d[:physical] = -loop.B[:physical].dot(u_eq)
        d[physical:] = loop.form.state.dot(away)
        return self._judged(loop, s, c, d, torque_nm, setpoint_n)

    def _judged(
        self, loop: _Loop, s: FloatArray, c: FloatArray, d: FloatArray, before_nm: FloatArray, setpoint_n: FloatArray
    ) -> Shortfall | None:
        both = np.concatenate((s, loop.B.dot(c) + d))
        torque = loop.torque.dot(both).reshape(-1, self._n) + c
        step = 1.0 + EXCUSED
        # Most periods no torque comes near a limit, and one product is all.
        cut = (
            np.abs(torque).max() > self._torque_nm * step
            or np.abs(torque[0] - before_nm).max() > self._step_nm * step
            or (np.abs(torque[1:] - torque[:-1]) > self._step_nm * step * self._between).any()
        )
        if cut:
            tension, looks = self._step_by_step(loop, s, c, d, before_nm), self._each
        else:
            tension, looks = loop.tension.dot(both).reshape(-1, self._n), self._looks
        return self._short(tension + setpoint_n, looks, setpoint_n)

    def _step_by_step(
        self, loop: _Loop, s: FloatArray, c: FloatArray, d: FloatArray, before_nm: FloatArray
    ) -> FloatArray:
        """Tensions (periods + 1, n) less those of the equilibrium, with torques cut as the envelope cuts them."""
        A, B, K, n = loop.A, loop.B, loop.K, self._n
        found = np.empty((self.periods + 1, n))
        for k in range(self.periods + 1):
            found[k] = s[:n]
            asked = K.dot(s) + c
            torque = np.minimum(np.maximum(asked, before_nm - self._step_nm), before_nm + self._step_nm)
            torque = np.minimum(np.maximum(torque, -self._torque_nm), self._torque_nm)
            s = A.dot(s) + B.dot(torque) + d
            before_nm = torque
        return found

    def _short(self, tension_n: FloatArray, looks: NDArray[np.int64], setpoint_n: FloatArray) -> Shortfall | None:
        low = self._low_n + np.minimum(self._margin_n, NEAR_SETPOINT * (setpoint_n - self._low_n)) - self._free
        high = self._high_n - np.minimum(self._margin_n, NEAR_SETPOINT * (self._high_n - setpoint_n)) + self._free
        below, above = low - tension_n.min(axis=0), tension_n.max(axis=0) - high
        worst = np.maximum(below, above)
        i = int(worst.argmax())
        if not worst[i] > 0.0:
            return None
        under = bool(below[i] > above[i])
        k = int(tension_n[:, i].argmin() if under else tension_n[:, i].argmax())
        allowed = float(low[i] if under else high[i])
        return Shortfall(i, float(tension_n[k, i]), allowed, float(looks[k] + 1) * self._period_s)


def _law(fallback: Controller, speed_m_per_s: float) -> LinearConfig | MpcConfig:
    return law_at(fallback, speed_m_per_s) if isinstance(fallback, ScheduledConfig) else fallback


def _loop(node: RecoveryNode, law: LinearConfig | MpcConfig, looks: NDArray[np.int64]) -> _Loop:
    form = linear_form(law)
    F, G = Sampled(np.array(node.transition), [np.array(matrix) for matrix in node.inputs]).augmented()
    physical, n = G.shape
    size = physical + form.states
    A, B, K = np.zeros((size, size)), np.vstack((G, form.applied)), np.zeros((n, size))
    A[:physical, :physical] = F
    A[physical:, : 2 * n] = form.part(form.state, "e")
    A[physical:, physical:] = form.part(form.state, "z")
    K[:, : 2 * n] = form.part(form.torque, "e")
    K[:, physical:] = form.part(form.torque, "z")
    closed = A + B @ K
    # s_k = M^k s_0 + (1 + M + .. + M^(k-1)) b
    power, total = np.eye(size), np.zeros((size, size))
    tension, torque = list[FloatArray](), list[FloatArray]()
    wanted = set(looks.tolist())
    for k in range(int(looks[-1]) + 1):
        if k in wanted:
            both = np.hstack((power, total))
            tension.append(both[:n])
            torque.append(K @ both)
        power, total = closed @ power, closed @ total + np.eye(size)
    engaged = engagement(law, form)
    return _Loop(A, B, K, form, engaged, np.vstack(tension), np.vstack(torque))
