"""Closed loops on true lines: cases of set-points, speeds and pushes through, and what became of the tensions."""

from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from gateway.control.deviation import Measured
from gateway.control.laws import make_law, untimed
from gateway.control.reference import Motion, Reference, Steady
from gateway.core.controller import Controller
from gateway.core.controller_laws import MpcConfig
from gateway.core.line import Limits
from tests.independent import laws, truth_kernel
from tests.independent.truth import FloatArray, Truth, stacked
from tests.independent.truth_kernel import STEP_S, compiled

RUNAWAY_N = 300.0
# Columns of what is found of a span.
LEAST, MOST, SWING, ERROR, CHATTER, SQUARED, BEYOND, SETTLED, ROLLER, COLUMNS = range(10)


@dataclass(frozen=True)
class Glide:
    """Set-points on a minimum-jerk curve, of which a law is told how they go on."""

    begin: int  #: the period in which it begins
    time_s: float
    first_n: FloatArray  #: (n,)
    goal_n: FloatArray  #: (n,)

    def motion(self, since_s: float) -> Motion:
        """So long after its begin. The unwinder's speed is another matter."""
        s = min(max(since_s / self.time_s, 0.0), 1.0)
        way = s**3 * (10.0 - 15.0 * s + 6.0 * s * s)
        rate = 30.0 * (s * (1.0 - s)) ** 2 / self.time_s
        acceleration = 60.0 * s * (1.0 - s) * (1.0 - 2.0 * s) / self.time_s**2
        by = self.goal_n - self.first_n
        return Motion(self.first_n + way * by, rate * by, acceleration * by, 0.0, 0.0)


@dataclass(frozen=True)
class _Gliding:
    """A law's reference in a glide, which it knows of from its begin on."""

    glide: Glide
    since_s: float
    tension_n: FloatArray
    moving: bool = True

    def ahead(self, time_s: float) -> Motion:
        return self.glide.motion(self.since_s + time_s)


@dataclass(frozen=True)
class Case:
    """What is asked of a line, period by period."""

    name: str
    tension_n: FloatArray  #: (k, n) set-points
    unwind_m_per_s: FloatArray  #: (k,)
    push_nm: FloatArray  #: (k, n), torque that disturbs each roller
    changed: int  #: the period from which overshoot and settling count
    tail: int  #: periods at the end in which everything should stand still
    band_n: float = 0.5  #: within which a tension has settled
    glide: Glide | None = None  #: of the tensions; a law is asked as the product asks it

    @property
    def periods(self) -> int:
        return len(self.unwind_m_per_s)

    def smaller(self, share: float) -> "Case":
        """The same with a share of what set-points, speed and pushes do."""
        first, slow = self.tension_n[0], self.unwind_m_per_s[0]
        return replace(
            self,
            tension_n=first + share * (self.tension_n - first),
            unwind_m_per_s=slow + share * (self.unwind_m_per_s - slow),
            push_nm=share * self.push_nm,
            glide=None,
        )

    def reference(self, k: int, period_s: float) -> Reference:
        """What a law is told in period k."""
        glide = self.glide
        if glide is None or not 0.0 <= (k - glide.begin) * period_s < glide.time_s - 1e-9:
            return Steady(self.tension_n[k])
        return _Gliding(glide, (k - glide.begin) * period_s, self.tension_n[k])


class Found(NamedTuple):
    """(b, n) each, N and Nm, true values. Of a line that has run away, or left its band, as far as it went."""

    least_n: FloatArray
    most_n: FloatArray
    swing_n: FloatArray  #: half of greatest less least tension in the tail
    error_n: FloatArray  #: |mean error| in the tail
    chatter_nm: FloatArray  #: rms over the tail of what the torque changes by in a period
    squared_n2: FloatArray  #: mean squared error
    beyond_n: FloatArray  #: overshoot in the direction of the change
    settled_s: FloatArray  #: after the change
    roller_m_per_s: FloatArray  #: greatest surface speed of the span's roller, either way
    ended: NDArray[np.int64]  #: (b,), the period in which it ran away; -1: it did not


def simulated(
    config: Controller,
    truths: list[Truth],
    cases: list[Case],
    limits: Limits,
    seed: int,
    *,
    latency_s: float | None = None,
    stop_outside: bool = False,
    slowly: bool = False,
    traced: list[FloatArray] | None = None,
) -> Found:
    """Case b on truth b. `latency_s`: the line's own; the law's, where it is not given. `stop_outside` the band.

    `slowly` with the product's own law, as a law that is not linear is run anyway.
    `traced` is given the true tensions (k, n) at the samples, and the torques (k, n), of each case.
    """
    n, count = truths[0].n, len(truths)
    longest = max(case.periods for case in cases)
    per_period = round(config.period_s / STEP_S)
    delay = round((config.latency_s if latency_s is None else latency_s) / STEP_S)
    generator = np.random.default_rng(seed)
    found, ended = np.zeros((count, n, COLUMNS)), np.full(count, -1)
    whole = stacked(truths)
    bounds = np.array(
        [limits.torque_nm, limits.torque_rate_nm_per_s * config.period_s, limits.tension_min_n, limits.tension_max_n]
    )
    law = None if slowly or isinstance(config, MpcConfig) else laws.law_of(config)
    for b, case in enumerate(cases):
        k = longest if b == 0 else case.periods
        chances = (
            generator.random((k, n)), generator.random(k), generator.standard_normal((k, 2 * n)),
            generator.standard_normal((k * per_period, n)),
        )  # fmt: skip
        trace = np.full((case.periods if traced is not None else 0, 2 * n), np.nan)
        given = (
            whole, b, case.tension_n, case.unwind_m_per_s, case.push_nm, case.changed, case.tail, case.band_n, *chances,
            bounds, per_period, delay, stop_outside, found[b], trace,
        )  # fmt: skip
        ended[b] = _run_slowly(config, given, case) if law is None or case.glide is not None else _run(law, *given)
        if traced is not None:
            traced.append(trace)
    return Found(*(found[:, :, i] for i in range(COLUMNS)), ended)


@compiled
def _limited(asked, before, bounds):
    for i in range(asked.size):
        held = min(max(asked[i], -bounds[0]), bounds[0])
        before[i] = min(max(held, before[i] - bounds[1]), before[i] + bounds[1])


@compiled
def _steps(whole, b, line, k, unwind, push, noise, bounds, per_period, stop_outside, found, in_tail, tailing):
    """A control period of the line. True where it is to end."""
    n = line.tension_n.size
    for j in range(per_period):
        step = k * per_period + j
        truth_kernel.advance(whole, b, line, step, unwind, push, noise[step], bounds[0])
        for i in range(n):
            tension = line.tension_n[i]
            if not (abs(tension) < RUNAWAY_N):
                found[i, LEAST], found[i, MOST] = -np.inf, np.inf
                return True
            found[i, LEAST], found[i, MOST] = min(found[i, LEAST], tension), max(found[i, MOST], tension)
            found[i, ROLLER] = max(found[i, ROLLER], abs(line.speed_m_per_s[i]))
            if tailing:
                in_tail[0, i], in_tail[1, i] = min(in_tail[0, i], tension), max(in_tail[1, i], tension)
            if stop_outside and not (bounds[2] <= tension <= bounds[3]):
                return True
    return False


@compiled
def _note(found, k, case_tail, periods, changed, band, tension, setpoint, first, last, moved):
    """Errors of a sample, and what the torque `moved` by (n,)."""
    for i in range(tension.size):
        error = tension[i] - setpoint[i]
        found[i, SQUARED] += error * error / periods
        if k >= periods - case_tail:
            found[i, ERROR] += error / case_tail
            found[i, CHATTER] += moved[i] * moved[i] / case_tail
        if k >= changed:
            aimed = tension[i] - last[i]
            way = last[i] - first[i]
            over = abs(aimed) if way == 0.0 else (aimed if way > 0.0 else -aimed)
            found[i, BEYOND] = max(found[i, BEYOND], over)
            if abs(aimed) > band:
                found[i, SETTLED] = k + 1 - changed


@compiled
def _run(
    law, whole, b, setpoints, unwinds, pushes, changed, tail, band, late, ages, seen_noise, noise, bounds, per_period,
    delay, stop_outside, found, trace,
):  # fmt: skip
    periods, n = setpoints.shape
    line = truth_kernel.begin(whole, b, setpoints[0], unwinds[0])
    applied = line.command_nm.copy()
    memory = laws.engage(law, setpoints[0], unwinds[0], line.speed_m_per_s, applied)
    now, seen, before = laws.now_of(n), np.empty(2 * n), np.empty(n)
    in_tail = np.zeros((2, n))
    _clear(found, in_tail)
    for k in range(periods):
        truth_kernel.sample(whole, b, line, ages[k], seen_noise[k], seen)
        laws.ask(law, memory, setpoints[k], unwinds[k], seen, now)
        before[:] = applied
        _limited(now.torque, applied, bounds)
        laws.commit(law, memory, setpoints[k], unwinds[k], now, applied)
        before[:] = applied - before
        _note(found, k, tail, periods, changed, band, line.tension_n, setpoints[k], setpoints[0], setpoints[-1], before)
        if trace.shape[0] > 0:
            trace[k, :n], trace[k, n:] = line.tension_n, applied
        truth_kernel.send(whole, b, line, k, applied, k * per_period, delay, per_period, late[k])
        if _steps(
            whole,
            b,
            line,
            k,
            unwinds[k],
            pushes[k],
            noise,
            bounds,
            per_period,
            stop_outside,
            found,
            in_tail,
            k >= periods - tail,
        ):
            return k
    _finish(found, in_tail, per_period)
    return -1


@compiled
def _clear(found, in_tail):
    found[:] = 0.0
    found[:, LEAST], found[:, MOST] = np.inf, -np.inf
    in_tail[0], in_tail[1] = np.inf, -np.inf


@compiled
def _finish(found, in_tail, per_period):
    for i in range(found.shape[0]):
        found[i, SWING] = max(0.5 * (in_tail[1, i] - in_tail[0, i]), 0.0)
        found[i, ERROR] = abs(found[i, ERROR])
        found[i, CHATTER] = np.sqrt(found[i, CHATTER])
        found[i, SETTLED] *= per_period * STEP_S


def _run_slowly(config: Controller, given: tuple[Any, ...], case: Case) -> int:
    """`_run` with the product's own law: for those that are not linear, where it feeds a move forward, and for holding
    the other against it.
    """
    (whole, b, setpoints, unwinds, pushes, changed, tail, band, late, ages, seen_noise, noise, bounds, per_period,
     delay, stop_outside, found, trace) = given  # fmt: skip
    periods, n = setpoints.shape
    line = truth_kernel.begin(whole, b, setpoints[0], unwinds[0])
    applied: FloatArray = line.command_nm.copy()
    law, seen = make_law(untimed(config)), np.empty(2 * n)
    at_rest = Measured(setpoints[0].copy(), line.speed_m_per_s.copy(), float(unwinds[0]))
    memory = law.engage(at_rest, Steady(setpoints[0]), applied.copy())
    in_tail = np.zeros((2, n))
    _clear(found, in_tail)
    for k in range(periods):
        truth_kernel.sample(whole, b, line, ages[k], seen_noise[k], seen)
        measured = Measured(seen[:n].copy(), seen[n:].copy(), float(unwinds[k]))
        decision = law.ask(memory, measured, case.reference(k, config.period_s))
        before = applied.copy()
        _limited(decision.torque_nm, applied, bounds)
        memory = law.commit(memory, decision, applied.copy())
        moved = applied - before
        _note(found, k, tail, periods, changed, band, line.tension_n, setpoints[k], setpoints[0], setpoints[-1], moved)
        if len(trace):
            trace[k, :n], trace[k, n:] = line.tension_n, applied
        truth_kernel.send(whole, b, line, k, applied, k * per_period, delay, per_period, late[k])
        if _steps(
            whole,
            b,
            line,
            k,
            unwinds[k],
            pushes[k],
            noise,
            bounds,
            per_period,
            stop_outside,
            found,
            in_tail,
            k >= periods - tail,
        ):
            return k
    _finish(found, in_tail, per_period)
    return -1
