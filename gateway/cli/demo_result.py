"""What the demonstration measured, as data: `result.json`. Schema in docs/schemas/demo-result.schema.json."""

from typing import Literal

from gateway.core.line import Strict


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
    format: Literal[1] = 1
    command: str
    date: str  #: ISO 8601
    law: str
    seed: int
    controller: str  #: hash of the configuration
    versions: dict[str, str]
    machine: list[str]
    cases: list[CaseResult]
    timing: TimingResult
    unsafe_events: dict[str, int]  #: by kind, over the whole run, with 0 where none was seen
    stops: list[str]  #: why the line stopped by itself and a case was begun anew; empty in a smooth run
    wall_s: float
