"""Recordings from where data are kept: the historian, CSV and MCAP files."""

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gateway.cli.recordings_csv import read_csv
from gateway.cli.recordings_mcap import read_mcap
from gateway.cli.recordings_table import RecordingRefused
from gateway.core.recording import Recording, recording_of
from gateway.core.telemetry import FLOAT_FIELDS, frame_dtype
from gateway.supervisor.history import History, HistoryError

#: What of a frame a recording is made from.
FIELDS = (*FLOAT_FIELDS, "unwind_speed_m_per_s", "tension_quality", "state", "held")
READERS = {".csv": read_csv, ".mcap": read_mcap}


def read_recording(path: Path, period_s: float | None = None) -> Recording:
    """Of a file, by the end of its name; `period_s` is for files that do not say theirs. Raises RecordingRefused."""
    reader = READERS.get(path.suffix.lower())
    if reader is None:
        raise RecordingRefused(f"{path}: its name should end in {' or '.join(READERS)}")
    try:
        return reader(path, period_s)
    except OSError as error:
        raise RecordingRefused(f"{path}: {error.strerror or error}") from error


def recording_of_history(path: Path, start_s: float, end_s: float, period_s: float | None = None) -> Recording:
    """What a historian has kept between two instants of Unix time. Raises RecordingRefused.

    Without `period_s` the median interval is taken, to the microsecond.
    """
    try:
        with History(path) as history:
            columns = history.read_wall(start_s, end_s, FIELDS)
            damaged = history.damaged
    except HistoryError as error:
        raise RecordingRefused(str(error)) from error
    if damaged:
        raise RecordingRefused(f"{path}: part of this time is damaged ({damaged[0]}): choose a time without it")
    frames = _frames(columns)
    step = np.diff(frames["time_s"])
    if len(step) == 0:
        raise RecordingRefused(f"{path}: {len(frames)} samples from {start_s:.3f} to {end_s:.3f} s of Unix time")
    if (step <= 0.0).any():
        raise RecordingRefused(f"{path}: the machine was started anew in this time: choose a time before or after it")
    return recording_of(frames, period_s or round(float(np.median(step)), 6), f"{path.name}, {len(frames)} samples")


def _frames(columns: dict[str, NDArray[Any]]) -> NDArray[np.void]:
    frames = np.zeros(len(columns["time_s"]), frame_dtype(columns["tension_n"].shape[1]))
    for name, column in columns.items():
        frames[name] = column
    return frames
