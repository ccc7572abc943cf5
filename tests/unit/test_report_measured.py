"""What the line has shown, in its report: how much of it is read, and what is said where not all of it is there."""

from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest

from gateway.cli import report_measured
from gateway.cli.line_records import LineRecords
from gateway.cli.report_measured import MOST_CHARTS, Measured, measured_section, read_measured
from gateway.core.line_past import TensionsBetween, TensionsTold
from gateway.core.messages import Event
from gateway.supervisor.historian import FILE_NAME as HISTORY
from gateway.supervisor.past_tensions import NotTold
from tests.unit.supervisor_support import line_of
from tests.unit.test_historian import writer_of

BEGIN_S, BETWEEN_S = 1.8e9, 100.0


class Past:
    """In place of what a history tells of tensions. `asked`: middles of what was asked for."""

    def __init__(self, ends_after: int = 1000) -> None:
        self.asked: list[float] = []
        self._ends_after = ends_after

    def thinned(self, history: object, asked: TensionsBetween, period_s: float) -> TensionsTold:
        if len(self.asked) == self._ends_after:
            raise NotTold("the disk is gone")
        self.asked.append(asked.from_wall_s + report_measured.BEFORE_S)
        times = np.linspace(asked.from_wall_s, asked.to_wall_s, 5).tolist()
        return TensionsTold(
            format=1, wall_s=times, tension_n=[[20.0] * 5], setpoint_n=[[20.0] * 5], speed_m_per_s=[0.01] * 5
        )


def told(folder: Path, past: Past, deployments: int, monkeypatch: pytest.MonkeyPatch) -> Measured:
    """Of a line with one alarm and so many deployments."""
    writer = writer_of(folder / HISTORY)
    writer.store([], [Event(time_s=1.0, kind="alarm", text="load-cell: a load cell cannot be trusted", data={})], 2.0)
    writer.disconnect()

    def recorded(k: int) -> Any:
        return SimpleNamespace(hash=f"{k:064x}", step=lambda kind: SimpleNamespace(wall_s=BEGIN_S + k * BETWEEN_S))

    proposals = [recorded(k) for k in range(deployments)]
    records = cast(LineRecords, SimpleNamespace(proposals=proposals, book=SimpleNamespace(entries={})))
    monkeypatch.setattr(report_measured, "thinned", past.thinned)
    monkeypatch.setattr(report_measured, "what_of", lambda one: "a controller")
    return read_measured(folder, line_of(1), records, 0.0, {})


def test_of_many_deployments_the_newest_are_read_and_the_report_says_so(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    past = Past()
    found = told(tmp_path, past, MOST_CHARTS + 3, monkeypatch)
    assert past.asked == [BEGIN_S + k * BETWEEN_S for k in range(3, MOST_CHARTS + 3)]  # the others are not even read
    assert len(found.around) == MOST_CHARTS and found.problems == []
    assert f"the newest {MOST_CHARTS} of {MOST_CHARTS + 3} deployments" in " ".join(
        measured_section(found, {}).paragraphs
    )


def test_of_few_all_are_told(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    found = told(tmp_path, Past(), 2, monkeypatch)
    assert len(found.around) == 2 and "after each deployment" in " ".join(measured_section(found, {}).paragraphs)


def test_where_tensions_cannot_be_read_to_the_end_alarms_and_the_first_of_them_stand_there(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    found = told(tmp_path, Past(ends_after=1), 3, monkeypatch)
    assert (len(found.alarms), len(found.around)) == (1, 1)
    assert found.problems == ["of tensions around deployments not all is told: the disk is gone"]


def test_without_a_history_it_is_said_what_is_missing(tmp_path: Path) -> None:
    records = cast(LineRecords, SimpleNamespace(proposals=[]))
    (problem,) = read_measured(tmp_path, line_of(1), records, 0.0, {}).problems
    assert problem.startswith("of alarms, and of tensions around deployments, nothing is told: there is no history")
