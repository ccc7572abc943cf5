"""The columns of a recording in a file: one name for each channel, with its unit and, from 1, its span or roller."""

import re
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from gateway.core.nearest import nearest
from gateway.core.recording import Recording
from gateway.core.signals import FloatArray

#: Arrays of a recording that have a column per span or roller, and the name of a column. Needed: speeds and torques.
PER_SPAN = {
    "tension_n": "tension_{}_n",
    "tension_setpoint_n": "tension_setpoint_{}_n",
    "speed_m_per_s": "speed_{}_m_per_s",
    "torque_nm": "torque_{}_nm",
    "torque_actual_nm": "torque_actual_{}_nm",
}
SINGLE = ("time_s", "unwind_speed_m_per_s", "controlled")
NEEDED, NEEDED_EACH = ("time_s", "unwind_speed_m_per_s"), ("speed_m_per_s", "torque_nm")
MOST_SPANS = 60  #: as in the line's file
_NUMBER = re.compile(r"_([1-9][0-9]{0,2})(?=_)")


class RecordingRefused(Exception):
    """Data that are not a recording. The text says where, what, and what is allowed."""


def heads(n: int) -> list[str]:
    """Names of all columns, in the order of a file."""
    first, *others = SINGLE
    return [first, *(name.format(i + 1) for name in PER_SPAN.values() for i in range(n)), *others]


def columns_of(recording: Recording) -> dict[str, NDArray[np.float64]]:
    """Each column by its name; `controlled` as 0 and 1."""
    found: dict[str, NDArray[np.float64]] = {"time_s": recording.time_s}
    for array, name in PER_SPAN.items():
        values = getattr(recording, array)
        found |= {name.format(i + 1): values[:, i] for i in range(recording.n)}
    found["unwind_speed_m_per_s"] = recording.unwind_speed_m_per_s
    found["controlled"] = recording.controlled.astype(np.float64)
    return found


def spans_of(names: Sequence[str], where: str) -> int:
    """Number of spans that a file's columns have. Raises RecordingRefused for what is unknown, twice or missing."""
    numbers = [int(found[1]) for name in names if (found := _NUMBER.search(name))]
    n = min(max(numbers, default=1), MOST_SPANS)
    known = heads(n)
    for column, name in enumerate(names, 1):
        if name not in known:
            raise RecordingRefused(f"{where}, column {column}: there is no column {name!r}; {_nearest(name, known)}")
        if names.index(name) != column - 1:
            raise RecordingRefused(
                f"{where}, column {column}: {name} is there twice, first in column {names.index(name) + 1}"
            )
    needed = [*NEEDED, *(PER_SPAN[array].format(i + 1) for array in NEEDED_EACH for i in range(n))]
    missing = [name for name in needed if name not in names]
    if missing:
        raise RecordingRefused(f"{where}: needed for {n} spans and missing: {', '.join(missing)}")
    return n


def recording_from(columns: dict[str, FloatArray], n: int, period_s: float | None, source: str) -> Recording:
    """Of columns as `spans_of` has checked them. What is absent is NaN, and under control. Raises RecordingRefused."""
    time_s = columns["time_s"]
    if len(time_s) < 2:
        raise RecordingRefused(f"{source}: {len(time_s)} samples are no recording")
    absent = np.full(len(time_s), np.nan)

    def together(name: str) -> FloatArray:
        return np.column_stack([columns.get(name.format(i + 1), absent) for i in range(n)])

    return Recording(
        time_s=time_s,
        unwind_speed_m_per_s=columns["unwind_speed_m_per_s"],
        controlled=columns.get("controlled", np.ones(len(time_s))) == 1.0,
        period_s=usual_step_s(time_s) if period_s is None else period_s,
        source=source,
        **{array: together(name) for array, name in PER_SPAN.items()},
    )


def usual_step_s(time_s: FloatArray) -> float:
    """Of times (k,) that may be anything: what is wrong with them is for the assessment to say."""
    with np.errstate(over="ignore", invalid="ignore"):
        return float(np.median(np.diff(time_s)))


def _nearest(name: str, known: Sequence[str]) -> str:
    like = nearest(name, known)
    allowed = ", ".join((*SINGLE, *(pattern.format("K") for pattern in PER_SPAN.values())))
    return (f"did you mean {like}? " if like else "") + f"allowed are {allowed} with K from 1"
