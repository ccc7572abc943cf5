"""What `r2rgate identify` found, as data in SI units. Schema in docs/schemas/identify.schema.json.

What is not finite is null.
"""

from typing import Literal

from gateway.core.line import Strict

Told = Literal["strongly", "weakly", "not"]


class FindingRow(Strict):
    """What speaks against data."""

    kind: str  #: one word: "gap", "frozen", "unit", "swapped", "mixed", "excitation", ...
    severity: Literal["note", "warning", "refusal"]
    where: str
    what: str
    value: float | None
    limit: float | None
    mend: str  #: what would mend it; "": nothing to be said
    experiment: str  #: which experiment would provide what is missing; "": none


class OffsetRow(Strict):
    """By how much a channel is late; negative for one that is early. The interval is of 95 %."""

    channel: str
    offset_s: float
    low_s: float | None  #: null: the data do not say
    high_s: float | None
    reference: bool  #: the channel to which the others are relative


class RecordingRow(Strict):
    source: str
    digest: str
    samples: int
    controlled: int  #: samples under control
    period_s: float
    findings: list[FindingRow]  #: the gravest first
    offsets: list[OffsetRow]
    taken_out: list[OffsetRow]  #: offsets that the recording had before --align
    foreseen: dict[str, float | None]  #: relative half-widths that simple regressions promise


class IntervalRow(Strict):
    """Of 95 %."""

    value: float
    low: float
    high: float


class ErrorsRow(Strict):
    """Root mean squares in standard deviations of a sample's noise."""

    tension: float | None
    speed: float | None


class MethodRow(Strict):
    """An estimate from the part of the data that does not judge."""

    method: str
    structure: str
    seconds: float
    score: float | None  #: error of free runs on held-out data, tension and speed; null: it ran away
    behind: float | None  #: the best, in standard errors; null likewise
    free_run: ErrorsRow
    one_step: ErrorsRow
    intervals: dict[str, IntervalRow]


class StructureRow(Strict):
    structure: str
    parameters: int
    evidence: float  #: logarithm
    held_out: float | None  #: log-likelihood per sample of held-out data
    normalised: float | None  #: innovation squared on them
    chosen: bool


class ParameterRow(Strict):
    """Of the model, against the line's file. Intervals are of 95 %."""

    name: str
    symbol: str
    file: IntervalRow
    model: IntervalRow
    told: Told  #: by the data


class CombinationRow(Strict):
    """One that the data tell independently of the others."""

    combination: str
    information: float  #: of the data, over that of the prior


class OutputRow(Strict):
    """Of one load cell or encoder, in its own unit."""

    name: str
    normalised: float  #: innovation squared over its variance; 1 is right
    portmanteau: float | None  #: Ljung-Box statistic over its quantile: white up to 1
    r2: float | None
    r2_free: float | None  #: left to itself for 1 s
    mae: float
    mae_free: float | None


class ValidationRow(Strict):
    """Of the chosen structure, on held-out data."""

    valid: bool
    samples: int
    normalised: float
    portmanteau: float | None
    outputs: list[OutputRow]
    findings: list[str]
    recommendations: list[str]


class NoiseRow(Strict):
    tension_n: float
    speed_m_per_s: float
    acceleration_m_per_s1_5: float


class Found(Strict):
    """A model, and what it rests on."""

    parameters: list[ParameterRow]
    noise: NoiseRow
    structures: list[StructureRow]  #: the most evidence first
    why: str  #: this one was chosen
    cautions: list[str]
    prior: list[str] = []  #: what is to be said of a model that should be the prior; empty: it was the line's file
    parent: str | None = None  #: hash of the model that was the prior; null: the line's file
    methods: list[MethodRow]  #: the best first
    windows: int  #: of 1 s, free runs that judge the methods
    failed: dict[str, str]  #: methods that gave no estimate, and why
    words: list[str]  #: what the data tell, and what would help
    combinations: list[CombinationRow]  #: the best known first
    remedies: dict[str, dict[str, float]]  #: by what is measured: standard deviation of the others' logarithms then
    validation: ValidationRow


class Kept(Strict):
    id: str  #: hash of the model
    out: str
    report: str
    version: int | None  #: in the repository; null: it is not there
    repository: str | None


class IdentifyResult(Strict):
    """Phase 0 of a line: either a model, or every reason why there is none."""

    format: Literal[1] = 1
    command: str
    date: str  #: ISO 8601
    versions: dict[str, str]
    machine: str
    line: str  #: site/line
    measured: dict[str, IntervalRow]  #: known by other means: value, and tolerance either way
    recordings: list[RecordingRow]
    refused: list[str]  #: why there is no model
    found: Found | None
    kept: Kept | None = None
