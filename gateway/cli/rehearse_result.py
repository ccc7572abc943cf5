"""What a rehearsal has shown, as data: `rehearse.json`. Schema in docs/schemas/rehearse.schema.json."""

from typing import Literal

from gateway.core.line import Strict
from gateway.core.scenario import Scenario


class Spread(Strict):
    p50: float
    p99: float
    max: float


class NamedFile(Strict):
    file: str  #: as it was given
    name: str  #: as the file has it; of a line, site/line


class Conditions(Strict):
    """Under which all configurations ran: the tier's, or else those of the line's file."""

    period_s: float
    latency_s: float
    torque_nm: float
    torque_rate_nm_per_s: float


class CaseResult(Strict):
    """One configuration in one scenario, true values, judged by the recorder at the simulated devices."""

    scenario: str
    rmse_n: float  #: over all spans, whole scenario
    rmse_per_span_n: list[float]
    ratio_to_truth_design: float | None = None  #: RMSE over the best of the designs on the truth; null: no such run
    settling_s: list[float | None]  #: per span, from the change until it stays within 2 %; null: never
    settling_paper_s: float | None  #: eq. settling_time: norm over all spans, from the start of the run
    overshoot_pct: list[float]  #: per span, of the step; of the set-point where there is none
    overshoot_paper_pct: float  #: eq. overshoot
    effort_n2m2s: float
    compute_us: Spread  #: a step of the law on this computer, which runs other scenarios meanwhile
    tension_min_n: float  #: all spans
    tension_max_n: float
    unsafe_events: int
    stopped: str | None  #: "stopped at ...": when and why the gateway stopped the line; null: it ran to the end


class ConfigurationResult(Strict):
    """A design, whether it was offered, and what it was worth."""

    name: str
    law: str
    model: str  #: that it was designed on: "nominal" of the line's file, "truth" of the plant's, or "identified-K"
    controller: str | None  #: hash of the configuration; null: not offered
    refused: str | None  #: why it is not offered; null: it is
    cases: list[CaseResult]  #: in the order of `scenarios`
    failures: dict[str, str]  #: by scenario, why there is no case of it


class Found(Strict):
    """A parameter, and its interval of 95 %."""

    value: float
    low: float
    high: float


class AdaptationResult(Strict):
    """A round: experiment, model, and the designs on it, which are among the configurations."""

    number: int
    data_s: float  #: of data that the model was made from, those of earlier rounds included
    structure: str | None = None  #: what the model has beside the paper's parameters; null: there is no model
    intervals: dict[str, Found] = {}  #: by parameter and combination
    normalised_innovation: float | None = None  #: on held-out data; 1 is right
    valid: bool = False  #: whether the model holds there
    findings: list[str] = []  #: what speaks against it
    refused: list[str]  #: why there is no model
    deployments: int = 0  #: of controllers, through the gate
    tried: list[str] = []  #: what was proposed, and what became of it
    unsafe_events: int = 0  #: while the line was adapted; of all rounds together in the first
    wall_s: float  #: the same


class RehearseResult(Strict):
    format: Literal[1] = 1
    command: str
    date: str  #: ISO 8601
    machine: str
    versions: dict[str, str]
    seed: int  #: of the plant's noise
    adaptations: int  #: rounds that were asked for
    llm: str
    line: NamedFile
    plant: NamedFile
    tier: str | None  #: null: the line's own conditions
    conditions: Conditions
    scenarios: list[Scenario]  #: as they were run
    without_term: list[str]  #: what the plant's file has and no model of a design: the truth's designs lack it, too
    rounds: list[AdaptationResult] = []  #: of adaptation, as far as they came
    configurations: list[ConfigurationResult]
    unsafe_events: int  #: in all runs and experiments
    wall_s: float
