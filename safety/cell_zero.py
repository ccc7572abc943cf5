"""Load cells that show less than nothing: their zero is wrong, and the tension is higher than what they show. Pure.

A cell that was zeroed with the web in it (automatic zero tracking, a power dip, a tare that was pressed in service)
shows far below zero once the web is slack. Control would pull until it shows its set-point.
"""

from dataclasses import dataclass, field

import numpy as np

from gateway.core import finding as data
from gateway.core.line import Line
from gateway.core.signals import CountArray, FloatArray, Inputs, Quality
from safety.actions import Action, Finding, found
from safety.proving import spans_with_cells, zero_allowed_n

PERIODS = 3  #: in a row: one sample may be torn
CODE = "load-cell-below-zero"
_GOOD = int(Quality.GOOD)


@dataclass(slots=True)
class ZeroState:
    """`least_n` (n,) is what a cell with a usable zero shows at the least; NaN where there is none."""

    least_n: FloatArray
    below: CountArray = field(init=False)  #: (n,), periods in a row
    any: bool = False

    def __post_init__(self) -> None:
        self.below = np.zeros(len(self.least_n), np.int64)


def zero_state(line: Line) -> ZeroState:
    """Of `line`: a cell that passed its proof may show so much of a slack web, either way."""
    return ZeroState(np.where(spans_with_cells(line), -zero_allowed_n(line), np.nan))


def find_below_zero(state: ZeroState, inputs: Inputs) -> list[Finding]:
    """Once a period, in every phase. What it does where the web is controlled: no loop may follow such a cell."""
    is_below = inputs.tension.value < state.least_n  # NaN is not
    if not (state.any or np.count_nonzero(is_below)):
        return []
    usable = inputs.tension.quality == _GOOD
    state.below = np.where(usable, np.where(is_below, state.below + 1, 0), state.below)
    state.any = bool(np.count_nonzero(state.below))
    return [found(one.code, Action.BRAKE, **one.parameters) for one in below_zero(state, inputs)]


def below_zero(state: ZeroState, inputs: Inputs) -> list[data.Finding]:
    """The cells that have shown less than their zero allows for long enough."""
    if not state.any:
        return []
    return [
        data.finding(CODE, span=i + 1, shown_n=inputs.tension.value.item(i), least_n=state.least_n.item(i))
        for i in np.flatnonzero(state.below >= PERIODS).tolist()
    ]
