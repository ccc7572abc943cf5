"""Which configuration controls the line: the one in service, the last known good one, and the way back to it.

Whoever deploys may die: a lease that is not renewed ends, and the loop goes back by itself. All changes are made
between two periods, or at the beginning of a period's control, and each is told.

What is kept becomes the last known good one, unless it is predictive and that is linear: whether a linear law would
still recover the line can be told in every period, of a predictive one under its limits it cannot
(`safety.recoverability`). So the predictive one controls the line on top of the linear one, which stays the way back.
"""

from dataclasses import dataclass, replace
from typing import Any

from gateway.control.law import Law
from gateway.core.controller import Controller
from gateway.core.controller_laws import MpcConfig
from gateway.core.deployment import Deployment, InService, RecoveryPrediction, Region
from gateway.core.line import Line
from gateway.core.proof import Proof
from gateway.loop.experiment import Tell
from gateway.loop.kept import Durable, OnTop
from gateway.loop.setpoints import Setpoints
from gateway.loop.torque import TorquePath
from gateway.loop.trial import Trial
from safety.recoverability import Recovery

ROUNDING_S = 1e-6  #: a lease of twenty periods ends with the twentieth, whatever their sum is rounded to


@dataclass(frozen=True, slots=True, eq=False)
class Configuration:
    """A configuration that is ready to run. Two are the same only where they are one object."""

    config: Controller
    hash: str
    law: Law[Any]
    region: Region
    watch: RecoveryPrediction | None = None
    recovery: Recovery | None = None  #: what `watch` has been made into
    law_s: float = 0.0  #: that a period of the law takes, in processor seconds, as it was measured
    unfit: str = ""  #: why it must not control the line; empty: it may
    proof: Proof | None = None  #: of the deployment that has brought it; None: the loop was given it
    watch_proof: Proof | None = None  #: of what has brought `watch`
    confirmed: bool = (
        False  #: a verdict has let it through, or a person has confirmed it; else it is guarded as a first
    )


@dataclass(slots=True)
class Probation:
    lease_s: float
    until_s: float  #: monotonic
    shaped_first: bool


class Configurations:
    """Of a loop. `running` controls the line, or will from the next start on.

    What is changed here is heard by nobody else: changes are made through `Cycle`, which tells the rest of the loop.
    """

    def __init__(
        self, line: Line, first: Configuration, path: TorquePath, setpoints: Setpoints, tell: Tell | None
    ) -> None:
        self.running = self.good = first
        self.path = path
        self.epoch = 0  #: the last that was taken
        self.probation: Probation | None = None
        self.why = "start"
        self.changes = 0  #: how often what outlives this loop has changed
        self.trial = Trial(line, setpoints)  #: of what runs
        self._line = line
        self._setpoints = setpoints
        self._tell = tell
        self._shaped = False

    def resume(self, running: Configuration, good: Configuration, epoch: int) -> None:
        """Before the first period: what the loop that ran before has kept."""
        self.running, self.good, self.epoch = running, good, epoch
        self.path.take_over(running.law)

    def take(self, candidate: Configuration, deployment: Deployment, now_s: float) -> None:
        """`candidate` controls the line from now on, on probation."""
        self.running = candidate
        self.trial.begin()
        self.epoch = deployment.epoch
        self.changes += 1
        self.probation = Probation(deployment.lease_s, now_s + deployment.lease_s, deployment.shaped_first)
        self.why = "deployed"
        if deployment.shaped_first and self._line.moves.shape == "ramp":
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
    def is_on_top(self) -> bool:
        """Whether what runs was kept without becoming what the line goes back to."""
        return self.running is not self.good and self.probation is None

    @property
    def durable(self) -> Durable:
        """What a loop that starts anew is to run."""
        running, good = self.running, self.good
        on_top = _on_top(running) if self.is_on_top else None
        return Durable(self.epoch, good.config, good.region, good.watch, on_top, good.proof, good.watch_proof)

    def durable_if_kept(self, watch: RecoveryPrediction | None, proof: Proof | None) -> Durable:
        """As `durable`, were `keep` done with this watch and this proof."""
        then, running = self.good_if_kept, self.running
        on_top = None if then is running else _on_top(running)
        watch_proof = None if watch is None else proof
        return Durable(self.epoch, then.config, then.region, watch, on_top, then.proof, watch_proof)

    def keep(self, watch: RecoveryPrediction | None, recovery: Recovery | None, proof: Proof | None) -> None:
        """What is on probation is kept; `watch` is for what the line goes back to from now on."""
        self.good = self.good_if_kept
        self._watch(watch, recovery, proof)
        self.probation = None
        self.changes += 1
        self.why = "kept"
        good = "is the last known good from now on"
        self._say("kept", good if self.running is self.good else f"is kept, with {self.good.hash[:12]} to go back to")

    def watch_good(self, watch: RecoveryPrediction, recovery: Recovery, proof: Proof | None) -> None:
        """The line is watched by another model. Only where nothing is on probation."""
        self._watch(watch, recovery, proof)
        self.changes += 1
        self._say("watched", "is watched by the model that was accepted last")

    def confirm(self, hash_: str) -> bool:
        """A person knows it: what runs, or is gone back to. False where that is not it."""
        known = [one for one in (self.running, self.good) if one.hash == hash_]
        if not known:
            return False
        if all(one.confirmed for one in known):
            return True
        alone = self.running is self.good
        self.good = replace(self.good, confirmed=self.good.confirmed or self.good.hash == hash_)
        running = replace(self.running, confirmed=self.running.confirmed or self.running.hash == hash_)
        self.running = self.good if alone else running
        self._say("confirmed", "is confirmed by a person: it is guarded as a first one no more")
        return True

    def narrow(self, region: Region) -> None:
        """The line is another one. Only where nothing is on probation."""
        alone = self.running is self.good
        self.good = _unwatched(self.good, region)
        self.running = self.good if alone else _unwatched(self.running, region)
        self.changes += 1
        self._no_faster(self.running.region)
        self._say("narrowed", "is no longer known to hold: it goes no further than a first configuration")

    def _watch(self, watch: RecoveryPrediction | None, recovery: Recovery | None, proof: Proof | None) -> None:
        watched = {"watch": watch, "recovery": recovery, "watch_proof": None if watch is None else proof}
        good = replace(self.good, **watched)
        self.running = good if self.running is self.good else replace(self.running, **watched)
        self.good = good

    def roll_back(self, reason: str) -> bool:
        """Back to the last known good; False where that runs already."""
        if self.running is self.good:
            return False
        self.changes += 1
        given_up, self.running = self.running, self.good
        self.trial.begin()
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

    def lapsed(self, now_s: float) -> str:
        """Why what is on probation must be taken back by itself; empty: it need not."""
        probation = self.probation
        if probation is None or now_s <= probation.until_s - ROUNDING_S:
            return ""
        return f"the lease of {probation.lease_s:g} s was not renewed"

    def settle_moves(self) -> None:
        """Once a period: set-points move as the line's file says again, once none is on a curve."""
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
            confirmed=running.confirmed,
            tension_moved=self.trial.tension_moved,
            speed_changed=self.trial.speed_changed,
        )

    def _say(self, kind: str, text: str, **data: object) -> None:
        if self._tell is not None:
            running = self.running
            said = f"{running.config.kind} controller {running.hash[:12]} {text}"
            self._tell(kind, said, hash=running.hash, epoch=self.epoch, last_known_good=self.good.hash, **data)


def _on_top(running: Configuration) -> OnTop:
    return OnTop(controller=running.config, region=running.region, proof=running.proof)


def _unwatched(one: Configuration, region: Region) -> Configuration:
    """`one`, no further than `region`."""
    return replace(one, region=one.region.no_further(region), watch=None, recovery=None, watch_proof=None)
