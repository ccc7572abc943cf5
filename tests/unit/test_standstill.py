"""When everything is known to stand still: nobody is told so while anything may move."""

import numpy as np
import pytest

from gateway.core.signals import Inputs, Quality
from gateway.loop.standstill import MOVES, Standstill
from tests.closed_loop.conftest import demo_line

LINE = demo_line(3)
STANDSTILL_M_PER_S, PERIODS = 0.002, 30
MOVES_M_PER_S = MOVES * STANDSTILL_M_PER_S


def still() -> Inputs:
    inputs = Inputs(3)
    for channel in (inputs.speed, inputs.unwind_speed):
        channel.value[:] = STANDSTILL_M_PER_S
        channel.quality[:] = Quality.GOOD
    inputs.speed.value[1] = -STANDSTILL_M_PER_S
    return inputs


def told(inputs: Inputs, periods: int, asked: bool = False) -> bool:
    standstill = Standstill(LINE, STANDSTILL_M_PER_S, PERIODS)
    return [standstill.look(inputs, asked) for _ in range(periods)][-1]


def test_it_is_told_after_a_while_and_no_sooner() -> None:
    assert told(still(), PERIODS) and not told(still(), PERIODS - 1)


def moving_unwinder(inputs: Inputs) -> None:
    inputs.unwind_speed.value[0] = 1.01 * STANDSTILL_M_PER_S


def moving_roller(inputs: Inputs) -> None:
    inputs.speed.value[2] = -1.01 * STANDSTILL_M_PER_S


def old_unwinder(inputs: Inputs) -> None:
    inputs.unwind_speed.quality[0] = Quality.STALE


def silent_roller(inputs: Inputs) -> None:
    inputs.speed.quality[0], inputs.speed.value[0] = Quality.MISSING, np.nan


@pytest.mark.parametrize("change", [moving_unwinder, moving_roller, old_unwinder, silent_roller])
def test_it_is_not_told_while_anything_moves_or_is_not_known(change) -> None:
    inputs = still()
    change(inputs)
    assert not told(inputs, 10 * PERIODS)


def test_it_is_not_told_while_a_speed_is_asked_for() -> None:
    assert not told(still(), 10 * PERIODS, asked=True)


def test_what_stands_moves_again_only_where_it_is_more_than_noise() -> None:
    standstill, inputs = Standstill(LINE, STANDSTILL_M_PER_S, PERIODS), still()
    for _ in range(PERIODS):
        standstill.look(inputs, asked=False)
    inputs.speed.value[0] = MOVES_M_PER_S
    assert standstill.look(inputs, asked=False)
    inputs.speed.value[0] = 1.01 * MOVES_M_PER_S
    assert not standstill.look(inputs, asked=False)
    inputs.speed.value[0] = MOVES_M_PER_S  # from here it has to be less again
    assert not [k for k in range(2 * PERIODS) if standstill.look(inputs, asked=False)]


def test_one_movement_begins_it_anew() -> None:
    standstill, inputs, moved = Standstill(LINE, STANDSTILL_M_PER_S, PERIODS), still(), still()
    moved.speed.value[2] = -1.01 * MOVES_M_PER_S
    for _ in range(2 * PERIODS):
        standstill.look(inputs, asked=False)
    assert not standstill.look(moved, asked=False)
    assert [standstill.look(inputs, asked=False) for _ in range(PERIODS)] == [False] * (PERIODS - 1) + [True]
