"""The stage that tensions the web, without a loop: what it hands over, and how fast set-points move in it."""

import numpy as np
import pytest

from gateway.core.line import Line
from gateway.core.signals import Inputs
from gateway.core.states import Phase
from gateway.core.theta import expected_noise
from gateway.loop.tensioning import TensioningStage
from safety.tensioning import AIM_SHARE, tensioning_speed_m_per_s
from tests.closed_loop.conftest import demo_line
from tests.support.reel_line import reel_line

TARGET_N = np.array([20.0, 30.0, 25.0])


def stage_of(line: Line, count_m_per_s: float = 0.0) -> TensioningStage:
    stage = TensioningStage(line, np.full(line.n, count_m_per_s))
    inputs = Inputs(line.n)
    inputs.unwind_speed.put(0, 0.0, 0.0)
    for i in range(line.n):
        inputs.tension.put(i, 0.0, 0.0)
        inputs.speed.put(i, 0.0, 0.0)
    assert stage.applies(Phase.TENSIONING)
    stage.begin(inputs)
    return stage


def drawn_line(*seen: int) -> Line:
    """The second span draw-controlled; `seen`: with a load cell all the same."""
    line = demo_line(3)
    spans = [span.model_copy(update={"control": "draw"}) if i == 1 else span for i, span in enumerate(line.spans)]
    cells = [cell for cell in line.load_cells if cell.span != 2 or 2 in seen]
    return line.model_copy(update={"spans": spans, "load_cells": cells})


def rate_n_per_s(line: Line) -> float:
    moves = line.moves.model_copy(update={"tension_rate_n_per_s": 1e9})
    return stage_of(line).moves(moves, np.zeros(3), TARGET_N).tension_rate_n_per_s


def test_quiet_encoders_leave_no_noise_in_what_was_sent() -> None:
    assert stage_of(demo_line(3)).mean_nm() is None


@pytest.mark.parametrize("coarse", [False, True])
def test_of_encoders_that_shake_a_law_is_given_the_mean_of_what_was_sent(coarse: bool) -> None:
    line = demo_line(3) if coarse else reel_line()
    aim_m_per_s = AIM_SHARE * tensioning_speed_m_per_s(line)
    assert coarse or expected_noise(line).speed_m_per_s > 0.05 * aim_m_per_s
    stage = stage_of(line, count_m_per_s=aim_m_per_s if coarse else 0.0)
    dice = np.random.default_rng(1)
    for _ in range(2000):
        stage.sent(2.0 + 0.5 * dice.standard_normal(line.n))
    mean_nm = stage.mean_nm()
    assert mean_nm is not None
    assert np.abs(mean_nm - 2.0).max() < 0.5, "a third of the noise at most, at three of its deviations"


def test_set_points_leave_half_of_the_speed_to_the_trim_of_a_draw_that_no_load_cell_sees() -> None:
    assert rate_n_per_s(drawn_line()) == pytest.approx(0.5 * rate_n_per_s(drawn_line(2)))
