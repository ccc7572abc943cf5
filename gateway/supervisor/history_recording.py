"""A recording out of the history."""

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gateway.core.recording import Recording, recording_of
from gateway.core.telemetry import FLOAT_FIELDS, frame_dtype
from gateway.supervisor.history import History, HistoryError

#: What of a frame a recording is made from.
FIELDS = (*FLOAT_FIELDS, "unwind_speed_m_per_s", "tension_quality", "state", "held")


def recording_between(path: Path, start_s: float, end_s: float, period_s: float | None = None) -> Recording:
    """What a historian has kept between two instants of Unix time. Raises HistoryError.

    Without `period_s` the median interval is taken, to the microsecond.
    """
    with History(path) as history:
        columns = history.read_wall(start_s, end_s, FIELDS)
        return _recording(path, columns, history.damaged, f"from {start_s:.3f} to {end_s:.3f} s of Unix time", period_s)


def recording_of_boot(path: Path, boot: str, start_s: float, end_s: float) -> Recording:
    """The same between two monotonic times of a boot, whatever the wall clock did meanwhile. Raises HistoryError."""
    with History(path) as history:
        columns = history.read(start_s, end_s, FIELDS, boot)
        return _recording(path, columns, history.damaged, f"from {start_s:.3f} to {end_s:.3f} s of boot {boot}", None)


def _recording(
    path: Path, columns: dict[str, NDArray[Any]], damaged: list[str], when: str, period_s: float | None
) -> Recording:
    if damaged:
        raise HistoryError(f"{path}: part of this time is damaged ({damaged[0]}): choose a time without it")
    frames = _frames(columns)
    step = np.diff(frames["time_s"])
    if len(step) == 0:
        raise HistoryError(f"{path}: {len(frames)} samples {when}")
    if (step <= 0.0).any():
        raise HistoryError(f"{path}: the machine was started anew in this time: choose a time before or after it")
    return recording_of(frames, period_s or round(float(np.median(step)), 6), f"{path.name}, {len(frames)} samples")


def _frames(columns: dict[str, NDArray[Any]]) -> NDArray[np.void]:
    frames = np.zeros(len(columns["time_s"]), frame_dtype(columns["tension_n"].shape[1]))
    for name, column in columns.items():
        frames[name] = column
    return frames
