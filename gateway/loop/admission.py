"""What is let near a period: built, run and measured aside, and refused with the figure where it takes too long.

A period of a running line has no time for anything that nobody has measured. So a law is engaged and asked here, at
rest and where limits are reached, and so is the prediction that watches it, along both of its ways; what they take
together must fit the share of a period that is left for control.
"""

import time
from collections.abc import Callable
from dataclasses import replace
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
from gateway.core.finding import Finding, finding
from gateway.core.line import Line
from gateway.core.signals import FloatArray
from gateway.loop.configurations import Configuration
from gateway.loop.kept import Kept
from gateway.wording.catalogue import sentences
from safety.recoverability import Recovery

#: Of every period, for the law and the prediction that watches it: samples may take half of it, and writing the rest.
SHARE = 0.45
#: Of the one period in which the monitor takes a law back, and the one before takes over: samples that came late are
#: then in time for nothing, but no period is skipped.
TAKEN_BACK_SHARE = 0.85
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
        self._periods = MEASURED_PERIODS if period_s < inf else 1

    def admit(self, deployment: Deployment, good: Configuration) -> Configuration:
        """What `deployment` brings, ready to run; `good` is what the line would go back to.

        Raises ControllerRefused with every reason.
        """
        config = deployment.controller
        found = config_hash(config)
        if found != deployment.hash:
            raise _refused(finding("configuration-altered", hash=found[:12], expected=deployment.hash[:12]))
        if reasons := misfits(config, self._line):
            raise _refused(*(finding("configuration-misfit", because=reason) for reason in reasons))
        law = self._law_of(config)
        law_s = self._law_s(law, config)
        recovery, watch_s = None, 0.0
        if deployment.watch is not None:
            recovery, watch_s = self._recovery(deployment.watch, good.config)
        self._require_time(law_s, watch_s, good.law_s)
        return Configuration(
            config, found, law, deployment.region, deployment.watch, recovery, law_s, confirmed=True
        )  # fmt: skip

    def recovery(self, watch: RecoveryPrediction, fallback: Controller, law_s: float) -> Recovery:
        """Whether `fallback` would recover the line, to be asked in each period beside a law that takes `law_s`.

        Raises ControllerRefused.
        """
        recovery, watch_s = self._recovery(watch, fallback)
        self._require_time(law_s, watch_s)
        return recovery

    def measured(self, given: Configuration) -> Configuration:
        """`given`, as it was measured; one that cannot be run, or takes too long, is unfit."""
        try:
            law_s = self._law_s(given.law, given.config)
            self._require_time(law_s)
        except ControllerRefused as refused:
            return replace(given, unfit=str(refused))
        return replace(given, law_s=law_s)

    def resumed(self, kept: Kept, say: Callable[[str], None]) -> tuple[Configuration, Configuration]:
        """What runs and what is gone back to, of what a loop before has kept. Raises ControllerRefused.

        A prediction that cannot be used any more is left out, and so is the controller on top; either is told.
        """
        config, watch, recovery = kept.controller, kept.watch, None
        law = self._law_of(config)
        law_s = self._law_s(law, config)
        self._require_time(law_s)
        top = self._resumed_top(kept, law_s, say)
        if watch is not None:
            try:
                recovery = self.recovery(watch, config, law_s if top is None else top.law_s)
            except ControllerRefused as refused:
                say(f"nobody looks whether the line could be recovered: {refused}")
                watch = None
        watched = {"watch": watch, "recovery": recovery, "watch_proof": None if watch is None else kept.watch_proof}
        good = Configuration(config, config_hash(config), law, kept.region, law_s=law_s, proof=kept.proof)
        good = replace(good, **watched, confirmed=kept.proof is not None)
        return (good if top is None else replace(top, **watched)), good

    def _resumed_top(self, kept: Kept, good_s: float, say: Callable[[str], None]) -> Configuration | None:
        if (top := kept.on_top) is None:
            return None
        config = top.controller
        try:
            law = self._law_of(config)
            law_s = self._law_s(law, config)
            self._require_time(law_s, 0.0, good_s)
        except ControllerRefused as refused:
            say(f"{config.kind} controller {config_hash(config)[:12]} is not used, what it stands on is: {refused}")
            return None
        return Configuration(
            config, config_hash(config), law, top.region, law_s=law_s, proof=top.proof,
            confirmed=top.proof is not None,
        )  # fmt: skip

    def _law_s(self, law: Law[Any], config: Controller) -> float:
        """What a period of `law` takes, in processor seconds. Raises ControllerRefused where it cannot be run."""
        try:
            return max(_law_s(law, *situation, self._periods) for situation in _situations(config, self._line))
        except ControllerRefused:
            raise
        except Exception as error:  # whatever a law may raise: here it costs nothing
            raise _refused(finding("configuration-fails", error=f"{type(error).__name__}: {error}")) from error

    def _recovery(self, watch: RecoveryPrediction, fallback: Controller) -> tuple[Recovery, float]:
        """Made, and what a look of it takes, in processor seconds."""
        if watch.fallback != config_hash(fallback):
            hashes = {"watched": watch.fallback[:12], "fallback": config_hash(fallback)[:12]}
            raise _refused(finding("prediction-of-another-fallback", **hashes))
        if watch.n != self._line.n or abs(watch.period_s - self._line.control.period_s) > 1e-9:
            raise _refused(finding("prediction-of-another-line"))
        try:
            recovery = Recovery(watch, fallback, self._line)
            situations = _situations(fallback, self._line)
            return recovery, max(_look_s(recovery, *situation, self._periods) for situation in situations)
        except Exception as error:  # of a prediction that fits its format and not its fallback
            raise _refused(finding("prediction-fails", error=f"{type(error).__name__}: {error}")) from error

    def _require_time(self, law_s: float, watch_s: float = 0.0, good_s: float = 0.0) -> None:
        """Every period has law and prediction in it, the one in which the law is taken back also the good one."""
        taken = {"law_s": law_s, "prediction_s": watch_s, "period_s": self._period_s}
        if not law_s + watch_s <= (allowed_s := SHARE * self._period_s):
            raise _refused(finding("law-too-slow", **taken, allowed_s=allowed_s))
        if not law_s + watch_s + good_s <= (allowed_s := TAKEN_BACK_SHARE * self._period_s):
            raise _refused(finding("law-too-slow-to-take-back", **taken, fallback_s=good_s, allowed_s=allowed_s))


def _refused(*findings: Finding) -> ControllerRefused:
    return ControllerRefused(sentences(findings), findings)


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
        raise _refused(finding("configuration-not-finite"))
    return law.commit(state, decision, torque_nm)


def _look_s(recovery: Recovery, measured: Measured, reference: Steady, torque_nm: FloatArray, periods: int) -> float:
    """What one look takes, in processor seconds; away from the set-points torques are cut, and it goes step by step."""
    in_flight_nm = np.tile(torque_nm, (recovery.depth, 1))
    setpoint_n = reference.tension_n
    took_s: list[float] = []
    for _ in range(WARM_PERIODS + periods):
        begun_s = time.thread_time()
        recovery.shortfall(measured, setpoint_n, in_flight_nm, torque_nm)
        took_s.append(time.thread_time() - begun_s)
    return median(took_s[WARM_PERIODS:])
