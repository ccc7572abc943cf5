"""What the rules are asked about: one proposal, and what is believed of the line that it is for."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any, TypeVar

import numpy as np

from gateway.control.design import DesignTask, task_on
from gateway.control.judged_courses import near_m_per_s
from gateway.core.controller import Controller
from gateway.core.experiment import Experiment
from gateway.core.judge_context import JudgeContext
from gateway.core.line import Line
from gateway.core.line_model import LineModel, noise_of, theta_of
from gateway.core.proposal import ExperimentChange, GainsChange, ModelChange, Proposal
from gateway.core.recording import Recording
from gateway.core.signals import FloatArray
from gateway.core.theta import Noise, Theta, expected_noise, nominal_theta
from safety.believed import corners_of_model, prior_corners
from safety.excitation import Excited, excited_parts, recent

T = TypeVar("T")
NOISIER = 1.2


@dataclass(frozen=True)
class Case:
    """Of one verdict. What several rules need is computed once, by the rule that asks for it first."""

    line: Line
    context: JudgeContext
    proposal: Proposal
    hash: str  #: of the proposal
    recordings: Sequence[Recording]  #: as `context.data` names them, in that order
    seed: int

    _kept: dict[object, object] = field(default_factory=dict[object, object], init=False, repr=False, compare=False)

    def once(self, compute: "Callable[[Case], T]") -> T:
        """What `compute` finds of this case, the first time; the same again after that."""
        if compute not in self._kept:
            self._kept[compute] = compute(self)
        found: Any = self._kept[compute]
        return found

    @property
    def controller(self) -> Controller:
        """Proposed. Raises TypeError where something else is."""
        if not isinstance(self.proposal.change, GainsChange):
            raise TypeError(f"a proposal of kind {self.proposal.kind} has no controller")
        return self.proposal.change.controller

    @property
    def experiment(self) -> Experiment:
        """Proposed. Raises TypeError where something else is."""
        if not isinstance(self.proposal.change, ExperimentChange):
            raise TypeError(f"a proposal of kind {self.proposal.kind} has no experiment")
        return self.proposal.change.experiment

    @property
    def model(self) -> LineModel:
        """Proposed. Raises TypeError where something else is."""
        if not isinstance(self.proposal.change, ModelChange):
            raise TypeError(f"a proposal of kind {self.proposal.kind} has no model")
        return self.proposal.change.model

    @property
    def first(self) -> bool:
        """Whether no model has been accepted yet, so that the tolerances of the line's file are all there is."""
        return self.context.model is None

    @cached_property
    def latency_s(self) -> float:
        """From a sample to its torque: as measured; else the longer of what file and model say."""
        if self.context.latency_s is not None:
            return self.context.latency_s
        model = self.context.model
        return max(self.line.control.latency_s, 0.0 if model is None else model.parameters.latency_s)

    @cached_property
    def believed(self) -> Theta:
        """The accepted model's parameters, or those of the line's file; the latency as measured."""
        model = self.context.model
        return replace(nominal_theta(self.line) if model is None else theta_of(model), latency_s=self.latency_s)

    @cached_property
    def noise(self) -> Noise:
        """The accepted model's; what is expected of any line where it says nothing."""
        model = self.context.model
        expected = expected_noise(self.line)
        return expected if model is None else noise_of(model) or expected

    @cached_property
    def stress_noise(self) -> Noise:
        """For simulations under stress: the greater of the model's and what is expected, and a fifth more.

        Chatter grows with it. Seconds of data tell a noise to some 5 %, and over a tail of 1.5 s the root mean square
        itself is known to 6 %: at 1.1 a law passed whose chatter on its plant was 5.07 Nm.
        """
        expected, own = expected_noise(self.line), self.noise
        return Noise(
            NOISIER * max(expected.tension_n, own.tension_n),
            NOISIER * max(expected.speed_m_per_s, own.speed_m_per_s),
            NOISIER * max(expected.acceleration_m_per_s1_5, own.acceleration_m_per_s1_5),
        )

    @cached_property
    def corners(self) -> list[Theta]:
        """What the truth may be, as far as anybody knows. Raises Unbelievable."""
        if self.context.model is None:
            return prior_corners(self.line, self.latency_s, self.seed)
        return corners_of_model(self.context.model, self.line.gate, self.latency_s, self.seed)

    @cached_property
    def data(self) -> list[Recording]:
        """The recordings that are not too old."""
        return recent(self.context, self.recordings, self.line.gate.data_max_age_s)

    @cached_property
    def excited(self) -> list[Excited]:
        """The parts of the recent recordings in which every measured tension moves, each at one speed."""
        return [part for recording in self.data for part in excited_parts(recording, self.line)]

    @cached_property
    def tension_n(self) -> FloatArray:
        """Set-points (n,) of the line now. Raises ValueError where the context has another number of them."""
        tension = np.array(self.context.state.tension_n)
        if len(tension) != self.line.n:
            raise ValueError(f"state.tension_n has {len(tension)} entries; allowed: {self.line.n}, one per span")
        return tension

    @property
    def validated_m_per_s(self) -> float:
        """The highest speed at which excited data have been recorded; 0: none."""
        return max((part.speed_m_per_s for part in self.excited), default=0.0)

    @property
    def draw_spans(self) -> list[int]:
        """Spans (from 0) without a load cell."""
        return [i for i, span in enumerate(self.line.spans) if span.control == "draw"]

    @property
    def tension_spans(self) -> list[int]:
        """The others. A draw span's tension follows from what its web is like: no controller keeps it."""
        return [i for i, span in enumerate(self.line.spans) if span.control == "tension"]

    @cached_property
    def speed_max_m_per_s(self) -> float:
        """Up to which the change is judged, and which the verdict's region carries."""
        if self.first:
            return min(self.line.gate.first_speed_max_m_per_s, self.line.limits.speed_max_m_per_s)
        # Without data the model rule refuses; the others still tell what they find at the speed of now.
        wanted = self.validated_m_per_s or self.context.state.speed_m_per_s or self.line.gate.first_speed_max_m_per_s
        return min(wanted + near_m_per_s(self.line), self.line.limits.speed_max_m_per_s)

    @cached_property
    def tension_step_n(self) -> float:
        """The largest set-point step that the region permits."""
        most = self.line.limits.tension_step_max_n
        return min(most, self.line.gate.first_step_max_n) if self.first else most

    @cached_property
    def speed_step_m_per_s(self) -> float:
        """The largest speed step that the region permits."""
        return min(self.line.limits.speed_step_max_m_per_s, self.speed_max_m_per_s)

    def task(self, theta: Theta, speed_m_per_s: float) -> DesignTask:
        """The linear loop's task on a plant at a speed, at the set-points of now."""
        return replace(
            task_on(self.line, theta, self.noise), tension_n=self.tension_n, unwind_speed_m_per_s=speed_m_per_s
        )
