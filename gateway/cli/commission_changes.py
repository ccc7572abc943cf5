"""What the commissioning chain's steps bring, made from the line as it is now: configurations, experiments, models.

Each step has offers: the candidate that the rules take, and those that may be taken in its place. An offer says what it
is without being made; where its design has knobs, they may be turned.
"""

import time
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, field, replace
from datetime import datetime
from math import inf

import numpy as np

from gateway.cli.identify_model import model_of_found
from gateway.commissioning.architectures import ARCHITECTURES
from gateway.commissioning.candidates import FIRST_LAWS, Exhausted, Law, NotOffered, at_end, configuration, experiment
from gateway.commissioning.chain import first_legs
from gateway.commissioning.convergence import SIGNIFICANT, Convergence, convergence, measurement
from gateway.commissioning.ladder import ALL, AS_IT_IS, BY_RULES, Next
from gateway.commissioning.past import Step
from gateway.commissioning.redesign import Offer as Redesign
from gateway.commissioning.redesign import redesigns
from gateway.core.controller import Controller, config_hash
from gateway.core.deployment import Region, first_region
from gateway.core.experiment import Experiment
from gateway.core.line import Line
from gateway.core.line_model import LineModel, ModelRefused, model_hash
from gateway.core.proposal import Change, ExperimentChange, GainsChange, ModelChange
from gateway.core.recording import Recording
from gateway.core.theta import Noise
from gateway.identification.identify import Identified, NotIdentified, identify

MOST_REASON = 1000  #: letters

Factors = Mapping[str, float]


@dataclass(frozen=True)
class LineNow:
    """What a proposal is made from."""

    in_service: Controller
    model: LineModel | None  #: accepted; None: the line's file
    tension_n: Sequence[float]  #: set-points
    speed_m_per_s: float  #: the same
    at: datetime


@dataclass(frozen=True)
class Made:
    change: Change
    reason: str
    identified: Identified | None = None  #: of a model: how it was come by


@dataclass(frozen=True)
class Offer:
    """A candidate. `make` with factors on its knobs, {} for none; it raises NotOffered."""

    rung: int
    title: str
    make: Callable[[Factors], Made]
    knobs: Sequence[str] = ()
    law: Law | None = None
    redesign: Redesign | None = field(default=None, repr=False)


def first_speed_m_per_s(line: Line) -> float:
    """Up to which a first configuration is judged."""
    return first_region(line).speed_max_m_per_s or line.limits.speed_max_m_per_s


class Changes:
    """Of a line that is to go as fast as `wanted_m_per_s`, or as its drives hold."""

    def __init__(self, line: Line, wanted_m_per_s: float = inf) -> None:
        self.line = line
        self._wanted_m_per_s = wanted_m_per_s
        #: And what they were designed from
        self._designed: tuple[LineNow, Region | None, bool, list[Redesign]] | None = None
        self._experiment_for: tuple[object, Experiment] | None = None  #: and what it was designed from

    def offers(
        self, step: Next, now: LineNow, recordings: Sequence[Recording], region: Region | None,
        proposed: Collection[str] = (),
    ) -> list[Offer]:  # fmt: skip
        """The candidate of `step`, and those of its `others` that there are.

        `recordings`: the newest first; `proposed`: hashes of the configurations that were, on the accepted model.

        Raises NotOffered where there is no such candidate as the step's own.
        """
        match step.step:
            case Step.FIRST:
                if step.rung >= BY_RULES:
                    return [self._quicker(step.rung, now, proposed)]
                return [self._first(one, now) for one in (step, *step.others)]
            case Step.EXPERIMENT:
                return [self._experiment(one, now) for one in (step, *step.others)]
            case Step.MODEL:
                return self._models(step, now, recordings)
            case Step.REDESIGN:
                if step.rung >= BY_RULES:
                    return [self._better(step.rung, now, region, proposed)]
                return self._redesigns(step, now, region)
            case Step.MEASUREMENT:
                return [self._measurement(step, now, region)]

    def looked_at(self, now: LineNow, recordings: Sequence[Recording]) -> Convergence:
        """What the newest of `recordings` shows of the configuration in service. Raises NotOffered."""
        assert now.model is not None  # a measurement follows a redesign
        return convergence(self.line, recordings[0], now.in_service, now.model)

    def effort_n2m2s(self, recording: Recording) -> float:
        """Of the drives, as far as their torques are known."""
        return float(recording.period_s * np.nansum(recording.torque_nm**2))

    def _first(self, step: Next, now: LineNow) -> Offer:
        """One under which an experiment can be designed: without, the chain would end there."""
        law, speed = FIRST_LAWS[step.rung], first_speed_m_per_s(self.line)

        def make(factors: Factors) -> Made:
            turned = law.turned(factors)
            controller = configuration(self.line, None, speed, turned)
            try:
                self._asked(replace(now, in_service=controller), first_legs(speed), 1.0, 0)
            except NotOffered as refused:
                raise NotOffered(f"{turned.text}: under it no experiment can be designed: {refused}") from refused
            said = [f"{turned.text} on the line's file, to begin with"]
            said += at_end(self.line, None, speed, turned) if factors else []
            return Made(GainsChange(controller=controller), "; ".join(said))

        return Offer(step.rung, f"{law.text} on the line's file", make, _knobs(law), law)

    def _quicker(self, rung: int, now: LineNow, proposed: Collection[str]) -> Offer:
        """With which the rules would have begun, before the one that agents chose and that led to no model."""
        made = self._first(Next(Step.FIRST, rung - BY_RULES), now)

        def make(factors: Factors) -> Made:
            quicker = made.make(factors)
            assert isinstance(quicker.change, GainsChange)
            if config_hash(quicker.change.controller) in proposed:
                raise NotOffered("it has been proposed before")
            why = "the rules would have begun with it: what agents chose in its place has led to no model"
            return replace(quicker, reason=f"{quicker.reason}; {why}")

        return replace(made, rung=rung, make=make, knobs=())

    def _experiment(self, step: Next, now: LineNow) -> Offer:
        speeds = " and ".join(f"{speed:.3g}" for speed in step.speeds_m_per_s)

        def make(factors: Factors) -> Made:
            asked = self._asked(now, step.speeds_m_per_s, step.size * factors.get("size", 1.0), step.number)
            moves = f"set-points move by {max(asked.amplitude_n):g} N for {asked.duration_s:g} s"
            return Made(ExperimentChange(experiment=asked), f"to identify the line at {speeds} m/s: {moves}")

        title = f"at {speeds} m/s, with moves of {step.size:g} times what is designed"
        return Offer(step.rung, title, make, ("size",))

    def _asked(self, now: LineNow, speeds_m_per_s: tuple[float, ...], size: float, seed: int) -> Experiment:
        """Designed; what has been designed last, again. Raises NotOffered."""
        model = None if now.model is None else model_hash(now.model)
        key = (config_hash(now.in_service), model, tuple(now.tension_n), now.speed_m_per_s, speeds_m_per_s,
               size, seed)  # fmt: skip
        if self._experiment_for is None or self._experiment_for[0] != key:
            asked = experiment(
                self.line, now.model, now.in_service, now.tension_n, now.speed_m_per_s, speeds_m_per_s, size,
                seed,
            )  # fmt: skip
            self._experiment_for = key, asked
        return self._experiment_for[1]

    def _models(self, step: Next, now: LineNow, recordings: Sequence[Recording]) -> list[Offer]:
        """Of the newest experiment, which goes the fastest, or of all recordings.

        A fit takes as long as its data: of four times as much for what is at most half as wide an interval.
        """
        if not recordings:
            raise NotOffered("there is no recording of an experiment")
        if step.rung == ALL and len(recordings) == 1:
            raise NotOffered("there is no other recording")
        rungs = [step.rung, *(one.rung for one in step.others if len(recordings) > 1)]
        return [self._model(rung, now, list(recordings if rung == ALL else recordings[:1])) for rung in rungs]

    def _model(self, rung: int, now: LineNow, used: list[Recording]) -> Offer:
        which = "the last experiment" if len(used) == 1 else f"the last {len(used)} experiments"

        def make(_: Factors) -> Made:
            try:
                found = identify(used, self.line, Noise(), time.perf_counter)
                parent = None if now.model is None else model_hash(now.model)
                model = model_of_found(self.line, used, found, now.at.isoformat(timespec="milliseconds"), parent=parent)
            except (NotIdentified, ModelRefused) as refused:
                raise NotOffered("; ".join(refused.reasons)[:MOST_REASON]) from refused
            speed = model.region.speed_to_m_per_s
            reason = f"from {which}: {found.estimate.structure}, up to {speed:.3g} m/s"
            return Made(ModelChange(model=model), reason, found)

        return Offer(rung, f"from {which}, {sum(one.samples * one.period_s for one in used):.0f} s of data", make)

    def _measurement(self, step: Next, now: LineNow, region: Region | None) -> Offer:
        speeds = " and ".join(f"{speed:.3g}" for speed in step.speeds_m_per_s)

        def make(_: Factors) -> Made:
            asked = measurement(self.line, region, now.tension_n, step.speeds_m_per_s, step.size, step.number)
            steps = f"steps of up to {asked.step_max_n:.3g} N for {asked.duration_s:g} s"
            return Made(
                ExperimentChange(experiment=asked),
                f"to see how the configuration in service does, {steps} at {speeds} m/s",
            )

        return Offer(step.rung, f"steps at {speeds} m/s", make)

    def _redesigns(self, step: Next, now: LineNow, region: Region | None) -> list[Offer]:
        """On the accepted model; in the end the configuration in service, for what data have shown since."""
        assert now.model is not None  # a redesign follows a model
        on = _on(now.model)
        as_it_is = Made(GainsChange(controller=now.in_service), f"the configuration in service, {on}")
        rungs = [one.rung for one in (step, *step.others)]
        designed = [] if rungs == [AS_IT_IS] else self._designs(now, region)
        offers: list[Offer] = []
        for rung in rungs:
            if rung == AS_IT_IS:
                offers.append(Offer(rung, "the configuration in service, as it is", lambda _: as_it_is))
            elif rung < len(designed):
                offers.append(self._redesign(rung, designed[rung], now, on))
            elif rung == step.rung:
                raise Exhausted(_nothing_left(len(designed)))
        return offers

    def _better(self, rung: int, now: LineNow, region: Region | None, proposed: Collection[str]) -> Offer:
        """Than what agents have put into service: significantly so in a course on the same model, and in the mean.

        A step that torque limits is as good by any design, and would hide in the mean what the others differ by. One
        that has been proposed on that model has had its verdict.
        """
        assert now.model is not None  # a redesign follows a model
        better = [
            one
            for one in self._designs(now, region, last=True)
            if one.share < 1.0
            and min(one.shares.values()) <= 1.0 - SIGNIFICANT
            and config_hash(one.controller) not in proposed
        ]
        if not better:
            raise Exhausted(
                f"the rules have no design that promises {SIGNIFICANT:.0%} less tracking error in any course"
            )
        one = better[0]
        told = " and ".join(f"{share:.0%} ({course})" for course, share in one.shares.items())
        promise = f"simulated, it promises {told} of the tracking error of what is in service, to which agents have led"
        made = Made(GainsChange(controller=one.controller), f"{one.law.text} {_on(now.model)}; {promise}")
        return Offer(rung, one.law.text, lambda _: made, (), one.law, one)

    def _designs(self, now: LineNow, region: Region | None, last: bool = False) -> list[Redesign]:
        """What has been designed before, again. `last`: see `redesigns`."""
        assert now.model is not None
        known = self._designed
        if known is None or known[1:3] != (region, last) or not _same(known[0], now):
            judged = Region() if region is None else region
            found = redesigns(self.line, now.model, now.in_service, now.tension_n, judged, self._wanted_m_per_s, last)
            known = self._designed = now, region, last, found
        return known[3]

    def _redesign(self, rung: int, one: Redesign, now: LineNow, on: str) -> Offer:
        def make(factors: Factors) -> Made:
            if not factors:
                return Made(GainsChange(controller=one.controller), f"{one.law.text} {on}")
            law = one.law.turned(factors)
            controller = configuration(self.line, now.model, one.speed_m_per_s, law)
            said = [f"{law.text} {on}", *at_end(self.line, now.model, one.speed_m_per_s, law)]
            return Made(GainsChange(controller=controller), "; ".join(said))

        return Offer(rung, one.law.text, make, _knobs(one.law), one.law, one)


def _on(model: LineModel) -> str:
    return f"on model {model_hash(model)[:12]}, whose data go up to {model.region.speed_to_m_per_s:.3g} m/s"


def _knobs(law: Law) -> tuple[str, ...]:
    return tuple(knob.name for knob in ARCHITECTURES[law.name].knobs)


def _nothing_left(offered: int) -> str:
    better = "on the model promises no worse than the configuration in service"
    if offered == 0:
        return f"no design {better}"
    return f"no other design {better}; {offered} {'has' if offered == 1 else 'have'} been offered"


def _same(one: LineNow, other: LineNow) -> bool:
    return (one.in_service, one.model, list(one.tension_n)) == (other.in_service, other.model, list(other.tension_n))
