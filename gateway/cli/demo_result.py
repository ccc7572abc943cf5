"""What the demonstration measured, as data: `result.json`. Schema in docs/schemas/demo-result.schema.json."""

from typing import Literal

from gateway.core.line import Strict

#: The paper's table performance_summary, RMSE in N: tension and velocity case.
PAPER_RMSE_N: dict[str, dict[str, float]] = {
    "Initial": {"tension": 2.3615, "velocity": 1.6708},
    "Adapt1": {"tension": 1.4267, "velocity": 0.7902},
    "Adapt2": {"tension": 1.0449, "velocity": 0.4490},
}


class CaseResult(Strict):
    name: str
    rmse_n: float  #: over the six tensions, true tension against set-point, whole window
    rmse_per_span_n: list[float]
    stepped_rmse_n: float  #: the same case, law and plant in stepped time
    ratio_to_stepped: float
    limit_ratio: float  #: the goal for it
    tension_min_n: float  #: true tension, all spans
    tension_max_n: float
    unsafe_events: int  #: seen by the recorder at the drives during the case
    missed_periods: int


class ConfigurationResult(Strict):
    """A configuration, and the cases on it."""

    name: str  #: the paper's: Initial, Adapt1, Adapt2; or "as started"
    law: str
    controller: str  #: hash
    cases: list[CaseResult]


class RuleResult(Strict):
    """What a rule of the gate found, as a number. null: it has none."""

    rule: str
    passed: bool
    value: float | None
    limit: float | None
    margin: float | None  #: to the limit, in the rule's unit; above 0: it passes
    unit: str


class ChangeResult(Strict):
    """A candidate of the chain."""

    step: str
    name: str  #: "candidate 1", or "own numbers 1" of an agent's
    proposal: str  #: hash; empty: it could not even be made
    configuration: str  #: hash of what it brings, where that is a configuration
    author: str  #: rules, or agents
    reason: str  #: of the proposal
    stage: str  #: that it came to
    why: str  #: it ended there
    rules: int  #: that judged it
    against: list[str]  #: what the rules that failed have found
    closest: RuleResult | None  #: the rule that decided: the first that failed, or the one that passed most narrowly
    measured: str  #: of a measurement: what it has shown
    approved_by: str  #: as the audit has it; empty: nobody was asked
    certificate: str  #: SHA-256 of that of the client by which it was approved; empty: it had none
    approved_over: str  #: what that client had read of it
    speed_m_per_s: float | None  #: up to which a configuration was let through


class FigureResult(Strict):
    name: str
    value: float | None
    unit: str


class OptionResult(Strict):
    id: str
    title: str
    figures: list[FigureResult]


class NoteResult(Strict):
    """What an agent looked up before it answered."""

    title: str
    tier: int
    score: float


class AskedResult(Strict):
    """A question that was asked of an agent, and what came of it."""

    interaction: str  #: id in the agents' log (`r2rgate log`)
    at: str  #: ISO 8601
    agent: str
    decision: str
    task: str  #: what was to be decided
    options: list[OptionResult]
    usual: str  #: what the rules choose
    notes: list[NoteResult]
    chosen: str
    factors: dict[str, float]  #: by knob; what is not named stayed
    by: str  #: the agent, or "rules"
    instead: str  #: why the rules, where a model was asked; empty: it answered, or none was
    reason: str
    model: str  #: language model and digest; empty: none was asked
    tokens: int  #: read and written
    seconds: float
    proposal: str  #: hash of what was proposed next; empty: nothing came of it


class SwapResult(Strict):
    """A configuration took over while the line ran."""

    configuration: str  #: hash
    at_s: float  #: since the first control period on record
    largest_step_nm: float  #: of any drive's torque from one command to the next, in the second around it
    before_nm: float  #: the same of the second before, in which nothing is swapped


class AuditResult(Strict):
    records: int
    head: str  #: of the last record: whoever knows it knows all of them
    sound: bool
    problems: list[str]


class ChainResult(Strict):
    """How the configurations came to the line."""

    reached: bool
    text: str
    changes: list[ChangeResult]
    asked: list[AskedResult]  #: in the order in which they were
    deployments: int
    swaps: list[SwapResult]
    step_allowed_nm: float  #: in one period, by the line's limits
    step_elsewhere_nm: float  #: the largest of the whole run
    left_out: list[str]  #: cases that a configuration was not judged for
    audit: AuditResult


class Percentiles(Strict):
    p50: float
    p99: float
    p999: float
    max: float


class TimingResult(Strict):
    period_s: float
    periods: int  #: control periods in telemetry
    missed: int  #: skipped since the loop's start
    lateness_us: Percentiles  #: wake-up after the due time
    cycle_us: Percentiles  #: from the wake-up to the last write handed over


class DemoResult(Strict):
    format: Literal[4] = 4
    command: str
    date: str  #: ISO 8601
    seed: int
    versions: dict[str, str]
    machine: list[str]
    configurations: list[ConfigurationResult]  #: in the order in which they ran
    truth_rmse_n: dict[str, float]  #: by case, in stepped time: an MPC designed on the true line
    chain: ChainResult | None  #: None: one configuration, with which the loop was started
    timing: TimingResult
    unsafe_events: dict[str, int]  #: by kind, over the whole run, with 0 where none was seen
    stops: list[str]  #: why the line stopped by itself and a case was begun anew; empty in a smooth run
    wall_s: float

    def rmse_n(self, configuration: int, case: str) -> float | None:
        """None: it was not run."""
        cases = self.configurations[configuration].cases
        return next((one.rmse_n for one in cases if one.name == case), None)

    def improvement_pct(self, configuration: int, case: str) -> float | None:
        """Of the RMSE from the configuration before; None: there is none, or one of the two was not run."""
        if configuration == 0:
            return None
        before, now = self.rmse_n(configuration - 1, case), self.rmse_n(configuration, case)
        return None if before is None or now is None else 100.0 * (1.0 - now / before)


def paper_improvement_pct(configuration: str, case: str) -> float | None:
    """Of the paper's own RMSE, from the configuration before."""
    names = list(PAPER_RMSE_N)
    if configuration not in names[1:]:
        return None
    before = PAPER_RMSE_N[names[names.index(configuration) - 1]][case]
    return 100.0 * (1.0 - PAPER_RMSE_N[configuration][case] / before)
