"""The experiments in a history: the data by which proposals are judged, and of which models are made."""

from pathlib import Path

from gateway.core.recording import Recording
from gateway.supervisor.history import History, HistoryError
from gateway.supervisor.history_recording import recording_between

MOST_EXPERIMENTS = 4  #: the newest, on which the model must hold
ENDS = ("experiment-end", "experiment-abort")


def experiments_kept(path: Path, begin_s: float, now_s: float) -> list[tuple[Recording, float]]:
    """Between two instants of Unix time: the newest first, with the Unix time of their ends. Reads from the disk.

    None where there is no history; one that is too short or damaged is left out.
    """
    found: list[tuple[Recording, float]] = []
    try:
        with History(path) as history:
            ends = [event for event in history.events(begin_s, now_s + 1.0) if event.kind in ENDS]
    except HistoryError:
        return []
    for event in reversed(ends):
        first_s, last_s = event.data.get("begin_s"), event.data.get("end_s")
        if not isinstance(first_s, float) or not isinstance(last_s, float):
            continue
        ahead_s = event.wall_s - event.time_s
        try:
            found.append((recording_between(path, first_s + ahead_s, last_s + ahead_s), last_s + ahead_s))
        except HistoryError:
            continue  # too short, or damaged: others may do
        if len(found) == MOST_EXPERIMENTS:
            break
    return found
