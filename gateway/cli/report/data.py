"""What a report says, as frozen data. Whoever fills it in measures; the report only shows.

Arrays run over n spans and k samples. NaN stands for "not measured" and is drawn as a gap; infinity is refused.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field
from datetime import datetime

import numpy as np
from numpy.typing import NDArray

FloatArray = NDArray[np.floating]


@dataclass(frozen=True, slots=True)
class Comparison:
    """A figure to hold this run's total RMSE against."""

    label: str  #: where it comes from, such as "the same case in stepped time"
    rmse_n: float


@dataclass(frozen=True, slots=True)
class EventCount:
    """One kind of event that was watched for, and how often it was seen; a kind never seen counts 0."""

    kind: str
    count: int


@dataclass(frozen=True, slots=True)
class RunEvent:
    time_s: float  #: since the start of the run
    kind: str
    text: str


@dataclass(frozen=True, slots=True)
class Machine:
    cpu_count: int
    kernel: str
    realtime: tuple[str, ...]  #: sentences: what was permitted, and what was not


@dataclass(frozen=True, slots=True, eq=False)
class Case:
    """One experiment on the line, as seen by whoever `source` names.

    Raises ValueError when shapes disagree, a value is infinite, or time does not increase.
    """

    name: str
    title: str
    description: str  #: one sentence: "Span 3 steps from 20 to 44 N at 1 s."
    law: str  #: the control law in one sentence
    source: str  #: one sentence: who measured
    time_s: FloatArray  #: (k,), from the start of the case
    tension_n: FloatArray  #: (n, k)
    setpoint_n: FloatArray  #: (n, k)
    torque_nm: FloatArray  #: (n, k), applied
    speed_m_per_s: FloatArray  #: (n, k), web speed at roller i
    unwind_speed_m_per_s: FloatArray  #: (k,), v0
    torque_limit_nm: float  #: either direction
    tension_min_n: float  #: the band the tension must never leave
    tension_max_n: float
    rmse_n: float  #: root of the time mean of the squared 2-norm over the spans
    rmse_per_span_n: FloatArray  #: (n,)
    unsafe_events: int  #: at the drives, during this case
    missed_cycles: int  #: during this case
    goal: Comparison | None = None  #: met when rmse_n is not above it
    comparisons: tuple[Comparison, ...] = ()
    span_names: tuple[str, ...] = ()  #: one each, or none

    def __post_init__(self) -> None:
        where = f"case {self.name!r}"
        k, n = len(self.time_s), len(self.tension_n)
        shapes = {
            "time_s": (k,),
            "unwind_speed_m_per_s": (k,),
            "tension_n": (n, k),
            "setpoint_n": (n, k),
            "torque_nm": (n, k),
            "speed_m_per_s": (n, k),
            "rmse_per_span_n": (n,),
        }
        for name, shape in shapes.items():
            _check_array(f"{where}: {name}", getattr(self, name), shape)
        _check_time(where, self.time_s)
        for name in ("torque_limit_nm", "tension_min_n", "tension_max_n", "rmse_n"):
            if not np.isfinite(getattr(self, name)):
                raise ValueError(f"{where}: {name} is {getattr(self, name)}; a finite number is needed")
        if n == 0:
            raise ValueError(f"{where}: no spans; at least one is needed")
        if self.span_names and len(self.span_names) != n:
            raise ValueError(f"{where}: {len(self.span_names)} span names for {n} spans; give one each, or none")

    @property
    def span_labels(self) -> tuple[str, ...]:
        """One per span: its number, and its name where spans have names."""
        names = self.span_names or ("",) * len(self.tension_n)
        return tuple(f"Span {i} ({name})" if name else f"Span {i}" for i, name in enumerate(names, 1))


@dataclass(frozen=True, slots=True, eq=False)
class Timing:
    """Every cycle of the loop.

    Raises ValueError when shapes disagree, a value is infinite, or time does not increase.
    """

    time_s: FloatArray  #: (m,), since the start of the run
    lateness_us: FloatArray  #: (m,), wake-up after the due time
    cycle_us: FloatArray  #: (m,), from the wake-up to the last write handed over
    period_us: float
    missed: int  #: periods skipped

    def __post_init__(self) -> None:
        m = len(self.time_s)
        for name in ("time_s", "lateness_us", "cycle_us"):
            _check_array(f"timing: {name}", getattr(self, name), (m,))
        _check_time("timing", self.time_s)


@dataclass(frozen=True, slots=True, eq=False)
class Report:
    """Raises ValueError when `when` is no ISO date, there is no case, or nothing was watched for at the drives."""

    title: str
    line: str
    plant: str
    when: str  #: ISO 8601
    command: str  #: that makes this report again
    versions: Mapping[str, str]  #: by name of the program or library
    machine: Machine
    cases: tuple[Case, ...]
    unsafe_events: tuple[EventCount, ...]  #: at the drives, over the whole run: every kind watched for, seen or not
    timing: Timing | None = None  #: None in stepped time
    events: tuple[RunEvent, ...] = ()
    notes: tuple[str, ...] = field(default=())

    def __post_init__(self) -> None:
        datetime.fromisoformat(self.when)
        if not self.cases:
            raise ValueError("a report needs at least one case")
        if not self.unsafe_events:
            raise ValueError("unsafe_events is empty; name every kind that was watched for, with 0 where none was seen")


def _check_array(what: str, values: FloatArray, shape: tuple[int, ...]) -> None:
    if values.shape != shape:
        raise ValueError(f"{what} has shape {values.shape}; {shape} is needed")
    if np.isinf(values).any():
        raise ValueError(f"{what} holds an infinite value; give NaN for what was not measured")


def _check_time(where: str, time_s: FloatArray) -> None:
    if len(time_s) < 2 or not (np.diff(time_s) > 0).all():
        raise ValueError(f"{where}: time_s must have two samples or more, and increase from each to the next")
