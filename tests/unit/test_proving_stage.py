"""The stage of a proof by itself, on rollers that no web holds: each turns under its own torque and friction."""

import numpy as np
import pytest

from gateway.core.line import Line
from gateway.core.line_file import load_line
from gateway.core.line_template import line_template
from gateway.core.signals import Inputs
from gateway.loop.proving import ProvingStage

N, LONGEST_S = 3, 600.0


def line_of(draw: set[int]) -> Line:
    """Without a load cell on spans `draw`, and with little slack: a way that is soon gone."""
    line = load_line(line_template(N, "line.toml"), "line.toml")
    spans = [
        span.model_copy(update={"slack_max_m": 0.001, "control": "draw" if i in draw else "tension"})
        for i, span in enumerate(line.spans, 1)
    ]
    cells = [cell for cell in line.load_cells if cell.span not in draw]
    return line.model_copy(update={"spans": spans, "load_cells": cells})


def without_web(line: Line) -> ProvingStage:
    """A stage that has come to its end."""
    stage, inputs, period_s = ProvingStage(line), Inputs(N), line.control.period_s
    friction, inertia = stage.limits.prior[:, 1], stage.limits.prior[:, 2]
    speed_m_per_s = np.zeros(N)
    stage.begin()
    for k in range(round(LONGEST_S / period_s)):
        for i in range(N):
            inputs.tension.put(i, 0.0, k * period_s)
            inputs.speed.put(i, float(speed_m_per_s[i]), k * period_s)
        torque_nm = stage.step(inputs)
        if stage.over:
            return stage
        speed_m_per_s = speed_m_per_s + period_s * (torque_nm - friction * speed_m_per_s) / inertia
    raise AssertionError("it does not come to an end")


def found(stage: ProvingStage) -> tuple[list[tuple[str, object]], list[int]]:
    """Codes and rollers of what was found, and the rollers of the drives that have pulled."""
    assert stage.judged is not None
    told = [(one.rule, one.parameters["roller"]) for one in stage.judged.findings]
    return told, [drive.roller for drive in stage.judged.drives]


def test_a_roller_that_no_web_holds_is_found_and_the_others_are_not_tried() -> None:
    assert found(without_web(line_of(set()))) == ([("no-answer", 3)], [3])


@pytest.mark.slow
def test_one_whose_span_no_load_cell_sees_is_asked_about_and_leaves_the_others_their_turn() -> None:
    stage = without_web(line_of({3}))
    assert found(stage) == ([("no-answer", 2)], [2, 3])
    assert stage.judged is not None
    assert ("drive-direction-unseen", 3) in [(one.code, one.parameters.get("roller")) for one in stage.judged.questions]


@pytest.mark.slow
def test_where_no_load_cell_is_every_drive_is_asked_about() -> None:
    stage = without_web(line_of({1, 2, 3}))
    assert found(stage) == ([], [1, 2, 3])
    assert stage.judged is not None
    asked = [(one.code, one.parameters["roller"]) for one in stage.judged.questions]
    assert asked == [("drive-direction-unseen", roller) for roller in (1, 2, 3)]
