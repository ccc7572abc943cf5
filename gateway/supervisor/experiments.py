"""The data of experiments in a line's history: what the gate judges by, and what `r2rgate identify` takes."""

from collections.abc import Mapping
from math import inf
from pathlib import Path

from gateway.core.recording import Recording
from gateway.core.steady_clock import Moment, SteadyClock
from gateway.supervisor.history import History, HistoryError, StoredEvent
from gateway.supervisor.history_recording import recording_of_boot

MOST_EXPERIMENTS = 4  #: the newest, by which proposals are judged
ENDS = ("experiment-end", "experiment-abort")  #: kinds of events


def newest_experiments(path: Path, begin_s: float, until_s: float, most: int) -> list[tuple[Recording, float]]:
    """Experiments that ended between two instants of Unix time, the newest first, each with its end.

    Whoever asks gets the same samples of the same experiment. One that is too short to be read, or damaged, is
    left out. Raises HistoryError where there is no history.
    """
    with History(path) as history:
        ends = history.events(begin_s, until_s, ENDS)
    found: list[tuple[Recording, float]] = []
    for event in reversed(ends):
        if len(found) < most and (one := _recording(path, event)) is not None:
            found.append(one)
    return found


def recent_experiments(path: Path, most_s: float, clocks: SteadyClock, most: int) -> list[tuple[Recording, float]]:
    """Those that ended at most so long ago, for certain; each with its end in Unix time by the clock of now.

    Of another boot of the machine only where its wall clock was seen to agree. Raises HistoryError.
    """
    with History(path) as history:
        ahead_s = history.agreed_ahead()
        ends = history.events(-inf, inf, ENDS)
    found: list[tuple[Recording, float]] = []
    for event in sorted(ends, key=lambda one: clocks.age(_moment(one, ahead_s)).most_s):
        age_s = clocks.age(_moment(event, ahead_s)).most_s
        if age_s > most_s or len(found) == most:
            break
        if (one := _recording(path, event)) is not None:
            found.append((one[0], clocks.now().wall_s - age_s))
    return found


def _moment(event: StoredEvent, ahead_s: Mapping[str, float]) -> Moment:
    if event.boot not in ahead_s:
        return Moment(event.wall_s, event.boot, event.time_s)
    return Moment(event.time_s + ahead_s[event.boot], event.boot, event.time_s, agreed=True)


def _recording(path: Path, end: StoredEvent) -> tuple[Recording, float] | None:
    first_s, last_s = end.data.get("begin_s"), end.data.get("end_s")
    if not isinstance(first_s, float) or not isinstance(last_s, float):
        return None
    ahead_s = end.wall_s - end.time_s
    try:
        return recording_of_boot(path, end.boot, first_s, last_s), last_s + ahead_s
    except HistoryError:
        return None
