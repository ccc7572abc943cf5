"""What bench-gate runs: proposals for one line, each judged by the gate and by the judge of the gate."""

import time
from copy import copy
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np

from gateway.core.controller import Controller
from gateway.core.deployment import Region
from gateway.core.judge_context import JudgeContext
from gateway.core.line import Line
from gateway.core.proposal import ExperimentChange, GainsChange, ModelChange
from gateway.core.recording import Recording
from gateway.core.verdict import Verdict
from safety.judge import judge
from tests.bench.gate_contexts import GateLine, context_of, outdated, payload_of
from tests.bench.gate_foresight import Foresight
from tests.bench.gate_proposals import Asked
from tests.independent.gate_judge import GateJudge, Judged, Lets, everything, model_error, unsafe_experiment
from tests.independent.truth import with_slower_cells

MISLEADS = 0.1  #: a model farther from the truth than this
ROLLOUT_RULE = "corners"  #: in the names of the rule that simulates
FIRST_TOP_M_PER_S = 0.02
CHAINED_MARGIN_S = 0.005  #: gate.delay_margin_min_s where one small change after another needs no person
POORER = 1.05  #: times the mean tracking error of the adapted design: what an outdated one has at least


@dataclass(frozen=True)
class Tried:
    """A proposal, its verdict and its truth."""

    number: int  #: of the line
    class_name: str
    context: str
    kind: str  #: of the change
    law: str
    accepted: bool
    against: list[str]  #: rules that do not pass
    findings: list[tuple[str, bool, float | None, float | None]]  #: rule, passed, margin, value
    reported: list[tuple[str, bool, float | None, float | None]]
    unsafe: str
    good: bool
    why_not_good: str
    verdict_s: float  #: on the wall
    processor_s: float
    texts: list[str] = field(default_factory=list)  #: of the rules that do not pass
    unsafe_slower: str = ""  #: of one that was accepted and is safe: with cells slower than the data have shown
    unsafe_unguarded: str = ""  #: what is unsafe if the loop lets every step


class LineBench:
    """One line with its contexts; judges are made when they are first asked for."""

    def __init__(self, given: GateLine) -> None:
        self.given = given
        self._judges: dict[str, GateJudge] = {}
        self._unsafe: dict[str, str] = {}

    @cached_property
    def contexts(self) -> dict[str, JudgeContext]:
        given = self.given
        return {
            "plain": context_of(given, given.plain, given.plain),
            "initial": context_of(given, given.initial, given.initial),
            "adapted": context_of(given, given.adapted, given.initial),
            "cautious": context_of(given, given.cautious, given.cautious),
            "drifted": context_of(given, self._drifted, self._drifted),
            "begun": context_of(given, given.initial, None, region=begun(given.line)),
            "first": context_of(given, given.initial, given.initial, first=True),
        }

    @cached_property
    def _drifted(self) -> Controller:
        """The first outdated design that is safe on the truth, and clearly poorer there than the adapted one."""
        given, generator = self.given, np.random.default_rng([self.given.number, 11])
        lets = self._lets(given.initial)
        judge = GateJudge(
            given.line, given.truth, given.adapted, given.adapted, self._top_m_per_s, given.number, lets=lets
        )
        adapted = judge.references[0]
        for config in outdated(given.task, generator):
            poorer = judge.metrics(config).mean_rmse_n > POORER * adapted.mean_rmse_n
            if poorer and not judge.unsafe(config):
                return config
        return given.cautious

    @property
    def _top_m_per_s(self) -> float:
        return self.given.model.region.speed_to_m_per_s

    def recordings(self, context: str) -> list[Recording]:
        return [] if context == "first" else [self.given.recording]

    def truth(self, context: str) -> GateJudge:
        """The judge of the gate for a context."""
        if context not in self._judges:
            given, first = self.given, context == "first"
            in_service, baseline = self.contexts[context].in_service, self.contexts[context].baseline
            top = FIRST_TOP_M_PER_S if first else self._top_m_per_s
            line = creeping(given.line) if first else given.line
            lets = everything if first else self._lets(in_service)
            self._judges[context] = GateJudge(
                line,
                given.truth,
                in_service,
                baseline or in_service,
                top,
                given.number,
                given.line.limits.speed_max_m_per_s,
                lets,
            )
        return self._judges[context]

    def _lets(self, in_service: Controller) -> Lets:
        line, model = self.given.line, self.given.model
        return lambda config, case: Foresight(line, model, config, in_service).let(case)

    def unsafe_in_service(self, context: str) -> str:
        """What is unsafe on the truth about what runs there: nobody would propose anything better there."""
        if context not in self._unsafe:
            self._unsafe[context] = self.truth(context).unsafe(self.contexts[context].in_service)
        return self._unsafe[context]

    def tried(self, asked: Asked, seed: int) -> Tried:
        given, context = self.given, self.contexts[asked.context]
        payload = payload_of(asked.change, context, given.line)
        began_s, worked_s = time.perf_counter(), time.process_time()
        verdict = judge(payload, context, given.line, self.recordings(asked.context), seed)
        took_s, processor_s = time.perf_counter() - began_s, time.process_time() - worked_s
        found, law = self._truth_of(asked)
        passed = verdict.accepted and not found.unsafe
        return Tried(
            given.number, asked.class_name, asked.context, asked.change.kind, law, verdict.accepted,
            sorted({one.rule for one in verdict.findings if not one.passed}), _rows(verdict, "findings"),
            _rows(verdict, "reported"), found.unsafe, found.good, found.why_not_good, took_s, processor_s,
            [t[:300] for t in verdict.reasons], self._with_slower_cells(asked) if passed else "", found.unguarded,
        )  # fmt: skip

    def _with_slower_cells(self, asked: Asked) -> str:
        """What would be unsafe then. The gate has not been told, and does not promise it."""
        change, given = asked.change, self.given
        if not isinstance(change, GainsChange):
            return ""
        judge = copy(self.truth(asked.context))
        judge.truth = with_slower_cells(given.truth, np.random.default_rng([given.number, 8]))
        return judge.unsafe(change.controller)

    def _truth_of(self, asked: Asked) -> tuple[Judged, str]:
        """What is true of it, and the law."""
        given, change = self.given, asked.change
        if isinstance(change, GainsChange):
            return self.truth(asked.context).of(change.controller), change.controller.kind
        if isinstance(change, ModelChange):
            error = model_error(change.model, given.truth)
            return Judged(f"off by {100.0 * error:.0f} %" if error > MISLEADS else "", False, "a model", None), "model"
        assert isinstance(change, ExperimentChange)
        state, config = self.contexts[asked.context].state, self.contexts[asked.context].in_service
        unsafe = unsafe_experiment(
            change.experiment, given.line, given.truth, config, list(state.tension_n), state.speed_m_per_s, given.number
        )
        return Judged(unsafe, False, "an experiment", None), "experiment"

    def judged(self, config: Controller, context: JudgeContext, seed: int) -> Verdict:
        """On gains in a context of one's own, on the line's data, where changes go through without a person."""
        line = self.given.line
        gate = line.gate.model_copy(update={"delay_margin_min_s": CHAINED_MARGIN_S})
        payload = payload_of(GainsChange(controller=config), context, line)
        return judge(payload, context, line.model_copy(update={"gate": gate}), [self.given.recording], seed)


def measured(one: Tried) -> bool:
    """Whether the rule that simulates has come to a figure."""
    return any(rule.startswith(ROLLOUT_RULE) and value is not None for rule, _, _, value in one.findings)


def begun(line: Line) -> Region:
    """For which a first configuration is judged: beyond it nothing is compared with it."""
    return Region(
        speed_max_m_per_s=FIRST_TOP_M_PER_S,
        tension_step_max_n=line.gate.first_step_max_n,
        speed_step_max_m_per_s=FIRST_TOP_M_PER_S,
    )


def creeping(line: Line) -> Line:
    """With the limits of a line that has no accepted model."""
    limits = line.limits.model_copy(
        update={
            "tension_step_max_n": line.gate.first_step_max_n,
            "speed_max_m_per_s": line.gate.first_speed_max_m_per_s,
        }
    )
    return line.model_copy(update={"limits": limits})


def _rows(verdict: Verdict, name: str) -> list[tuple[str, bool, float | None, float | None]]:
    return [(one.rule, one.passed, one.margin, one.value) for one in getattr(verdict, name)]
