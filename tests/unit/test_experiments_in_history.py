"""An experiment's data are the same samples for the gate that judges a model as for the command that identifies it."""

from pathlib import Path

import numpy as np
import pytest

from gateway.cli.identify_data import Asked, recordings_of
from gateway.core.messages import Event
from gateway.core.recording import Recording
from gateway.core.signals import Quality
from gateway.core.states import LoopState
from gateway.supervisor.experiments import newest_experiments
from tests.unit.supervisor_support import frame_of, line_of
from tests.unit.test_historian import WALL_AHEAD_S, writer_of

LINE = line_of(2)
PERIOD_S = 0.01


@pytest.fixture
def history(tmp_path: Path) -> Path:
    """Ten seconds; an experiment from 1 to 3 s, one that was aborted from 5 to 6 s, one that never began."""
    good = np.full(2, Quality.GOOD, np.int8)
    frames = [
        frame_of(k, k * PERIOD_S, 2, tension_quality=good, state=LoopState.RUN, held=0, tension_n=np.array([k, -k]))
        for k in range(1000)
    ]
    times = [("experiment-end", 1.0, 3.0), ("experiment-abort", 5.0, 6.0), ("experiment-abort", None, 7.0)]
    events = [
        Event(time_s=end_s, kind=kind, text="", data={"begin_s": begin_s, "end_s": end_s})
        for kind, begin_s, end_s in times
    ]
    writer = writer_of(tmp_path / "history.sqlite", spans=2)
    writer.store(frames, events, WALL_AHEAD_S)
    writer.disconnect()
    return tmp_path / "history.sqlite"


def span_s(recording: Recording) -> tuple[float, float]:
    return round(recording.tension_n[0, 0] * PERIOD_S, 3), round(recording.tension_n[-1, 0] * PERIOD_S, 3)


def test_experiments_are_found_the_newest_first_and_what_never_began_is_left_out(history: Path) -> None:
    found = newest_experiments(history, WALL_AHEAD_S, WALL_AHEAD_S + 20.0, 4)
    assert [span_s(one) for one, _ in found] == [(5.0, 6.0), (1.0, 3.0)]
    assert [end_s - WALL_AHEAD_S for _, end_s in found] == [6.0, 3.0]
    assert len(newest_experiments(history, WALL_AHEAD_S, WALL_AHEAD_S + 20.0, 1)) == 1
    assert newest_experiments(history, WALL_AHEAD_S + 8.0, WALL_AHEAD_S + 20.0, 4) == []


def test_identify_takes_the_samples_by_which_the_gate_judges(history: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("gateway.cli.identify_data.time.time", lambda: WALL_AHEAD_S + 10.0)
    (taken,) = recordings_of(LINE, [], Asked(None, history, None))
    (judged, _), *_ = newest_experiments(history, WALL_AHEAD_S, WALL_AHEAD_S + 20.0, 4)
    assert taken.digest() == judged.digest() and "experiment until" in taken.source
    (asked,) = recordings_of(LINE, [], Asked("2s", history, None))
    assert span_s(asked) == (8.0, 9.99)
