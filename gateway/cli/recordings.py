"""Recordings from where data are kept: the historian, CSV and MCAP files."""

from pathlib import Path

from gateway.cli.recordings_csv import read_csv
from gateway.cli.recordings_mcap import read_mcap
from gateway.cli.recordings_table import RecordingRefused
from gateway.core.recording import Recording
from gateway.supervisor.history import HistoryError
from gateway.supervisor.history_recording import recording_between

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
    """What a historian has kept between two instants of Unix time. Raises RecordingRefused."""
    try:
        return recording_between(path, start_s, end_s, period_s)
    except HistoryError as error:
        raise RecordingRefused(str(error)) from error
