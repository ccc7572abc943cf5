"""Which configuration controls the line: the one in service, the last known good one, and the way back to it.

Whoever deploys may die: a lease that is not renewed ends, and the loop goes back by itself. All changes are made
between two periods, or at the beginning of a period's control, and each is told.

What is kept becomes the last known good one, unless it is predictive and that is linear: whether a linear law would
still recover the line can be told in every period, of a predictive one under its limits it cannot
(`safety.recoverability`). So the predictive one controls the line on top of the linear one, which stays the way back.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from gateway.control.deviation import Deviation
from gateway.control.law import Law, Measured
from gateway.control.reference import Steady
from gateway.core.controller import Controller, ControllerRefused, config_hash
from gateway.core.controller_fit import misfits
from gateway.core.controller_laws import MpcConfig
from gateway.core.deployment import Deployment, InService, RecoveryPrediction, Region
from gateway.core.line import Line
from gateway.loop.experiment import Tell
from gateway.loop.kept import Kept, OnTop
from gateway.loop.setpoints import Setpoints
from gateway.loop.torque import TorquePath
from safety.recoverability import Recovery

WARM_PERIODS = 3  #: that a law is asked before it is let near the line: first solutions take longest

ROUNDING_S = 1e-6  #: a lease of twenty periods ends with the twentieth, whatever their sum is rounded to

LawOf = Callable[[Controller], Law[Any]]


@dataclass(frozen=True, slots=True)
class Configuration:
    """A configuration that is ready to run."""

    config: Controller
    hash: str
    law: Law[Any]
    region: Region
    watch: RecoveryPrediction | None = None
    recovery: Recovery | None = None  #: what `watch` has been made into


@dataclass(slots=True)
class Probation:
    lease_s: float
    until_s: float  #: monotonic
    shaped_first: bool


class Configurations:
    """Of a loop. `running` controls the line, or will from the next start on."""

    def __init__(
        self,
        line: Line,
        config: Controller,
        law_of: LawOf,
        path_of: Callable[[Law[Any]], TorquePath],
        setpoints: Setpoints,
        tell: Tell | None,
    ) -> None:
        self.running = self.good = Configuration(config, config_hash(config), law_of(config), Region())
        self.path = path_of(self.running.law)
        self.epoch = 0  #: the last that was taken
        self.probation: Probation | None = None
        self.why = "start"
        self.prepared: tuple[Deployment, Configuration] | None = None  #: built ahead of its command
        self.prepared_watch: tuple[RecoveryPrediction, Recovery] | None = None
        self.to_keep = False  #: what outlives this loop is no longer what it should be
        self._line = line
        self._law_of = law_of
        self._setpoints = setpoints
        self._tell = tell
        self._shaped = False

    def resume(self, kept: Kept) -> None:
        """Before the first period: the last known good of the loop that ran before."""
        law, watch = self._law_of(kept.controller), kept.watch
        recovery = None if watch is None else Recovery(watch, kept.controller, self._line)
        config = Configuration(kept.controller, config_hash(kept.controller), law, kept.region, watch, recovery)
        self.running = self.good = config
        if (top := kept.on_top) is not None:
            law = self._law_of(top.controller)
            self.running = Configuration(top.controller, config_hash(top.controller), law, top.region, watch, recovery)
        self.epoch = kept.epoch
        self.path.take_over(law)

    def candidate(self, deployment: Deployment) -> Configuration:
        """Built and warm. Takes its time: never within a period. Raises ControllerRefused with every reason."""
        config = deployment.controller
        found = config_hash(config)
        if found != deployment.hash:
            raise ControllerRefused(f"its hash is {found[:12]}.., not {deployment.hash[:12]}..: it was altered")
        if reasons := misfits(config, self._line):
            raise ControllerRefused("; ".join(reasons))
        law = self._law_of(config)
        _warm(law, config, self._line)
        recovery = None if deployment.watch is None else self.recovery(deployment.watch, self.good.config)
        return Configuration(config, found, law, deployment.region, deployment.watch, recovery)

    def recovery(self, watch: RecoveryPrediction, fallback: Controller) -> Recovery:
        """Takes its time, too. Raises ControllerRefused."""
        if watch.fallback != config_hash(fallback):
            raise ControllerRefused(
                f"it is watched for the fallback {watch.fallback[:12]}, but {config_hash(fallback)[:12]} is what the "
                "line would go back to"
            )
        if watch.n != self._line.n or abs(watch.period_s - self._line.control.period_s) > 1e-9:
            raise ControllerRefused("its recovery prediction is for another number of spans or another period")
        return Recovery(watch, fallback, self._line)

    def take(self, candidate: Configuration, deployment: Deployment, now_s: float) -> None:
        """`candidate` controls the line from now on, on probation."""
        self.running = candidate
        self.epoch = deployment.epoch
        self.probation = Probation(deployment.lease_s, now_s + deployment.lease_s, deployment.shaped_first)
        self.why = "deployed"
        if deployment.shaped_first and self._line.moves.shape == "ramp":
            self._setpoints.stand()
            self._shaped = True
        self.path.take_over(candidate.law)
        self._say("deployed", f"on probation for as long as its lease of {deployment.lease_s:g} s is renewed")

    def renew(self, now_s: float) -> None:
        if self.probation is not None:
            self.probation.until_s = now_s + self.probation.lease_s

    @property
    def good_if_kept(self) -> Configuration:
        """What the line goes back to once nothing is on probation, where what runs is kept."""
        on_top = isinstance(self.running.config, MpcConfig) and not isinstance(self.good.config, MpcConfig)
        return self.good if on_top else self.running

    @property
    def on_top(self) -> OnTop | None:
        """What runs without being what the line goes back to, and not on probation."""
        running = self.running
        if running is self.good or self.probation is not None:
            return None
        return OnTop(controller=running.config, region=running.region)

    def keep(self, watch: RecoveryPrediction | None, recovery: Recovery | None) -> None:
        """What is on probation is kept; `watch` is for what the line goes back to from now on."""
        self.good = self.good_if_kept
        self._watch(watch, recovery)
        self.probation = None
        self.why = "kept"
        good = "is the last known good from now on"
        self._say("kept", good if self.running is self.good else f"is kept, with {self.good.hash[:12]} to go back to")

    def watch_good(self, watch: RecoveryPrediction, recovery: Recovery) -> None:
        """The line is watched by another model. Only where nothing is on probation."""
        self._watch(watch, recovery)
        self._say("watched", "is watched by the model that was accepted last")

    def narrow(self, region: Region) -> None:
        """The line is another one. Only where nothing is on probation."""
        alone = self.running is self.good
        self.good = replace(self.good, region=self.good.region.no_further(region), watch=None, recovery=None)
        self.running = self.good if alone else replace(
            self.running, region=self.running.region.no_further(region), watch=None, recovery=None
        )  # fmt: skip
        self.to_keep = True
        self._no_faster(self.running.region)
        self._say("narrowed", "is no longer known to hold: it goes no further than a first configuration")

    def _watch(self, watch: RecoveryPrediction | None, recovery: Recovery | None) -> None:
        good = replace(self.good, watch=watch, recovery=recovery)
        self.running = good if self.running is self.good else replace(self.running, watch=watch, recovery=recovery)
        self.good = good

    def roll_back(self, reason: str) -> bool:
        """Back to the last known good; False where that runs already."""
        if self.running is self.good:
            return False
        self.to_keep |= self.on_top is not None
        given_up, self.running = self.running, self.good
        self.probation = None
        self.why = f"rolled back: {reason}"
        self.path.take_over(self.good.law)
        text = f"takes over again from {given_up.hash[:12]}: {reason}"
        self._say("rolled-back", text, given_up=given_up.hash, reason=reason)
        self._no_faster(self.good.region)
        return True

    def _no_faster(self, region: Region) -> None:
        """Than what runs was judged for."""
        most = region.speed_max_m_per_s
        if most is not None and self._setpoints.speed_target_m_per_s > most:
            self._setpoints.speed_target_m_per_s = most

    def look(self, now_s: float) -> None:
        """Once a period, before control."""
        probation = self.probation
        if probation is not None and now_s > probation.until_s - ROUNDING_S:
            self.roll_back(f"the lease of {probation.lease_s:g} s was not renewed")
        if self._shaped and self.probation is None and self._setpoints.at_rest():
            self._shaped = False

    @property
    def shaped(self) -> bool:
        """Whether set-points move along curves though the line's file has ramps."""
        return self._shaped

    def in_service(self, now_s: float) -> InService:
        probation, running = self.probation, self.running
        return InService(
            hash=running.hash,
            kind=running.config.kind,
            epoch=self.epoch,
            on_probation=probation is not None,
            lease_left_s=None if probation is None else max(probation.until_s - now_s, 0.0),
            last_known_good=self.good.hash,
            good_if_kept=self.good_if_kept.hash,
            region=running.region,
            watched=running.recovery is not None,
            why=self.why,
        )

    def _say(self, kind: str, text: str, **data: object) -> None:
        if self._tell is not None:
            running = self.running
            said = f"{running.config.kind} controller {running.hash[:12]} {text}"
            self._tell(kind, said, hash=running.hash, epoch=self.epoch, last_known_good=self.good.hash, **data)


def _warm(law: Law[Any], config: Controller, line: Line) -> None:
    """Run it on the line's first recipe, at equilibrium. Raises ControllerRefused where it cannot be run."""
    recipe = line.recipes[0]
    reference = Steady(np.array(recipe.tension_n))
    deviation = Deviation(config.feedforward, config.draw_spans, config.period_s, config.latency_s)
    state_n = deviation.state(reference, recipe.speed_m_per_s)
    torque_nm = deviation.torque(reference, recipe.speed_m_per_s, 0)
    try:
        state: Any = None
        for _ in range(WARM_PERIODS):
            measured = Measured(state_n[: line.n].copy(), state_n[line.n :].copy(), recipe.speed_m_per_s)
            state = law.engage(measured, reference, torque_nm) if state is None else state
            decision = law.ask(state, measured, reference)
            if not np.isfinite(decision.torque_nm).all():
                raise ControllerRefused("it gives no finite torque on the line's own set-points")
            state = law.commit(state, decision, torque_nm)
    except ControllerRefused:
        raise
    except Exception as error:  # whatever a law may raise: here it costs nothing
        raise ControllerRefused(f"it cannot be run: {type(error).__name__}: {error}") from error
