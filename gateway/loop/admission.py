"""What is let near a period: built, run and measured aside, and refused with the figure where it takes too long.

A period of a running line has no time for anything that nobody has measured. So a law is engaged and asked here, at
rest and where limits are reached, and so is the prediction that watches it, along both of its ways; what the slowest
of each takes must fit the share of a period that is theirs.
"""

import time
from collections.abc import Callable
from math import inf
from statistics import median
from typing import Any

import numpy as np

from gateway.control.deviation import Deviation
from gateway.control.law import Law, Measured
from gateway.control.reference import Steady
from gateway.core.controller import Controller, ControllerRefused, config_hash
from gateway.core.controller_fit import misfits
from gateway.core.deployment import Deployment, RecoveryPrediction
from gateway.core.line import Line
from gateway.core.signals import FloatArray
from gateway.loop.configurations import Configuration
from gateway.loop.kept import Kept
from safety.recoverability import Recovery

LAW_SHARE = 0.45  #: of a period, for engaging and asking a law; the samples have half of it, before
WATCH_SHARE = 0.4  #: for the prediction, along the longer of its ways; what is left is for reading and writing
WARM_PERIODS = 3  #: first solutions take longest: they are not measured
MEASURED_PERIODS = 7  #: of which the median counts

LawOf = Callable[[Controller], Law[Any]]


class Admission:
    """Builds configurations for a line. Every method takes its time: never within a period.

    `period_s` is what shares are of; endless in stepped time, where nothing is late and what a run gives must not
    depend on the computer.
    """

    def __init__(self, line: Line, law_of: LawOf, period_s: float = inf) -> None:
        self._line = line
        self._law_of = law_of
        self._period_s = period_s
        self._measured = MEASURED_PERIODS if period_s < inf else 1

    def admit(self, deployment: Deployment, good: Controller) -> Configuration:
        """What `deployment` brings, ready to run; `good` is what the line would go back to.

        Raises ControllerRefused with every reason.
        """
        config = deployment.controller
        found = config_hash(config)
        if found != deployment.hash:
            raise ControllerRefused(f"its hash is {found[:12]}.., not {deployment.hash[:12]}..: it was altered")
        if reasons := misfits(config, self._line):
            raise ControllerRefused("; ".join(reasons))
        law = self._ready(config)
        recovery = None if deployment.watch is None else self.recovery(deployment.watch, good)
        return Configuration(config, found, law, deployment.region, deployment.watch, recovery)

    def resumed(self, kept: Kept, say: Callable[[str], None]) -> tuple[Configuration, Configuration]:
        """What runs and what is gone back to, of what a loop before has kept. Raises ControllerRefused.

        A prediction that cannot be used any more is left out, and told.
        """
        config, watch, recovery = kept.controller, kept.watch, None
        if watch is not None:
            try:
                recovery = self.recovery(watch, config)
            except ControllerRefused as refused:
                say(f"nobody looks whether the line could be recovered: {refused}")
                watch = None
        good = Configuration(config, config_hash(config), self._ready(config), kept.region, watch, recovery)
        if (top := kept.on_top) is None:
            return good, good
        law = self._ready(top.controller)
        return Configuration(top.controller, config_hash(top.controller), law, top.region, watch, recovery), good

    def _ready(self, config: Controller) -> Law[Any]:
        law = self._law_of(config)
        self.measure_law(law, config)
        return law

    def measure_law(self, law: Law[Any], config: Controller) -> None:
        """Run `law` of `config` as a period would. Raises ControllerRefused where that fails, or takes too long."""
        try:
            took_s = max(_law_s(law, *situation, self._measured) for situation in _situations(config, self._line))
        except ControllerRefused:
            raise
        except Exception as error:  # whatever a law may raise: here it costs nothing
            raise ControllerRefused(f"it cannot be run: {type(error).__name__}: {error}") from error
        self._require_share(took_s, LAW_SHARE, "its torques take")

    def recovery(self, watch: RecoveryPrediction, fallback: Controller) -> Recovery:
        """Whether `fallback` would recover the line, to be asked in each period. Raises ControllerRefused."""
        if watch.fallback != config_hash(fallback):
            raise ControllerRefused(
                f"it is watched for the fallback {watch.fallback[:12]}, but {config_hash(fallback)[:12]} is what the "
                "line would go back to"
            )
        if watch.n != self._line.n or abs(watch.period_s - self._line.control.period_s) > 1e-9:
            raise ControllerRefused("its recovery prediction is for another number of spans or another period")
        try:
            recovery = Recovery(watch, fallback, self._line)
            situations = _situations(fallback, self._line)
            took_s = max(_recovery_s(recovery, *situation, self._measured) for situation in situations)
        except Exception as error:  # of a prediction that fits its format and not its fallback
            raise ControllerRefused(
                f"its recovery prediction cannot be used: {type(error).__name__}: {error}"
            ) from error
        self._require_share(took_s, WATCH_SHARE, "its recovery prediction takes")
        return recovery

    def _require_share(self, took_s: float, share: float, what: str) -> None:
        allowed_s = share * self._period_s
        if not took_s <= allowed_s:
            raise ControllerRefused(
                f"{what} {1e3 * took_s:.3g} ms of a period of {1e3 * self._period_s:g} ms on this computer; "
                f"allowed: {1e3 * allowed_s:.3g} ms"
            )


def _situations(config: Controller, line: Line) -> list[tuple[Measured, Steady, FloatArray]]:
    """Samples, set-points and the torque (n,) sent before: at rest, and all set-points a largest step away either way.

    Far from their set-points torques and tensions come to their limits, which is when solutions take longest.
    """
    recipe, limits = line.recipes[0], line.limits
    tension_n = np.array(recipe.tension_n)
    away_n = np.resize((1.0, -1.0), line.n) * limits.tension_step_max_n
    reference = Steady(tension_n)
    deviation = Deviation(config.feedforward, config.draw_spans, config.period_s, config.latency_s)
    state = deviation.state(reference, recipe.speed_m_per_s)
    torque_nm = deviation.torque(reference, recipe.speed_m_per_s, 0)
    speed_m_per_s = state[line.n :]
    return [
        (Measured(measured_n, speed_m_per_s.copy(), recipe.speed_m_per_s), reference, torque_nm)
        for measured_n in (state[: line.n].copy(), tension_n + away_n, tension_n - away_n)
    ]


def _law_s(law: Law[Any], measured: Measured, reference: Steady, torque_nm: FloatArray, periods: int) -> float:
    """What a period takes in which the law takes over, or goes on, whichever is longer, in processor seconds."""
    over_s: list[float] = []
    on_s: list[float] = []
    for _ in range(WARM_PERIODS + periods):
        begun_s = time.thread_time()
        state = law.engage(measured, reference, torque_nm)
        state = _ask(law, state, measured, reference, torque_nm)
        engaged_s = time.thread_time()
        _ask(law, state, measured, reference, torque_nm)
        over_s.append(engaged_s - begun_s)
        on_s.append(time.thread_time() - engaged_s)
    return max(median(over_s[WARM_PERIODS:]), median(on_s[WARM_PERIODS:]))


def _ask(law: Law[Any], state: Any, measured: Measured, reference: Steady, torque_nm: FloatArray) -> Any:
    decision = law.ask(state, measured, reference)
    if not np.isfinite(decision.torque_nm).all():
        raise ControllerRefused("it gives no finite torque on the line's own set-points")
    return law.commit(state, decision, torque_nm)


def _recovery_s(
    recovery: Recovery, measured: Measured, reference: Steady, torque_nm: FloatArray, periods: int
) -> float:
    """What one look takes, in processor seconds; away from the set-points torques are cut, and it goes step by step."""
    in_flight_nm = np.tile(torque_nm, (recovery.depth, 1))
    setpoint_n = reference.tension_n
    took_s: list[float] = []
    for _ in range(WARM_PERIODS + periods):
        begun_s = time.thread_time()
        recovery.shortfall(measured, setpoint_n, in_flight_nm, torque_nm)
        took_s.append(time.thread_time() - begun_s)
    return median(took_s[WARM_PERIODS:])
