"""A rewind by draw, without a load cell, whose tension goes where nobody asked it to: who tells?"""

import numpy as np
import pytest

from gateway.cli.stepped import SteppedLoop
from gateway.control.design import design_lqi, task_of
from gateway.core.states import LoopState
from sim_plant.plant import Plant
from tests.support.reel_line import TENSION_MAX_N, TENSION_N, reel_line, reel_loop

SPEED_M_PER_S = 4.0


def draw_loop(**rollers: object) -> SteppedLoop:
    """The reel's span has no load cell; the true rollers differ by `rollers`."""
    line, measured = reel_line(), reel_loop()
    spans = [*line.spans[:2], line.spans[2].model_copy(update={"control": "draw"})]
    line = line.model_copy(update={"spans": spans, "load_cells": line.load_cells[:2]})
    plant: Plant = measured.plant.model_copy(
        update={"rollers": measured.plant.rollers.model_copy(update=dict(rollers))}
    )
    loop = SteppedLoop(line, design_lqi(task_of(line)), plant, 1)
    loop.begin_in_production(np.array(TENSION_N), SPEED_M_PER_S)
    return loop


@pytest.mark.parametrize("share", [0.8, 1.0, 1.2])
def test_a_rewind_within_its_tolerances_runs_on(share):
    friction = [share * 0.2, share * 0.2, share * 0.4]
    loop = draw_loop(friction_nms_per_rad=friction)
    loop.step(1000)
    assert not loop.transitions and not loop.alarms


def test_a_rewind_that_is_pulled_beyond_its_limit_stops_the_line_before_it_goes_far():
    """Its reel's encoder shows too little: the draw that it keeps is more than was asked for."""
    loop = draw_loop()
    loop.step(100)
    encoder = loop.truth.encoders[2]
    for step in range(200):
        encoder.offset(-4e-4 * (step + 1), 0.0, loop.truth.world.steps)
        loop.step(5)
        if loop.transitions:
            break
    told = loop.transitions[0][2]
    assert loop.cycle.machine.state is LoopState.STOP and "span 3 has" in told
    assert TENSION_MAX_N < float(loop.truth.world.tension_n[2]) < 1.5 * TENSION_MAX_N
