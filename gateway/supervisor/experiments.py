"""The data of experiments in a line's history: what the gate judges by, and what `r2rgate identify` takes."""

from pathlib import Path

from gateway.core.recording import Recording
from gateway.supervisor.history import History, HistoryError, StoredEvent
from gateway.supervisor.history_recording import recording_between

MOST_EXPERIMENTS = 4  #: the newest, by which proposals are judged
ENDS = ("experiment-end", "experiment-abort")  #: kinds of events


def newest_experiments(path: Path, begin_s: float, until_s: float, most: int) -> list[tuple[Recording, float]]:
    """Experiments that ended between two instants of Unix time, the newest first, each with its end.

    Whoever asks gets the same samples of the same experiment. One that is too short to be read, or damaged, is
    left out. Raises HistoryError where there is no history.
    """
    with History(path) as history:
        ends = [event for event in history.events(begin_s, until_s) if event.kind in ENDS]
    found: list[tuple[Recording, float]] = []
    for event in reversed(ends):
        if len(found) < most and (one := _recording(path, event)) is not None:
            found.append(one)
    return found


def _recording(path: Path, end: StoredEvent) -> tuple[Recording, float] | None:
    first_s, last_s = end.data.get("begin_s"), end.data.get("end_s")
    if not isinstance(first_s, float) or not isinstance(last_s, float):
        return None
    ahead_s = end.wall_s - end.time_s
    try:
        return recording_between(path, first_s + ahead_s, last_s + ahead_s), last_s + ahead_s
    except HistoryError:
        return None
