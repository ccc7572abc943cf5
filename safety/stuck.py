"""Load cells that show one value while the line moves. Pure; time is counted in periods.

A cell whose noise spans several of its counts never shows one value for long. One with a coarse resolution, or a
long filter, may: it shows the same count again and again, and nothing can be told this way. Which kind a cell is, is
learnt from its own changes: their usual size against the smallest one. Only changes that reverse teach it: in a ramp of
the set-point a coarse cell changes by several counts with every sample, too.

Long before that is sure enough to stop a line, a fine cell that shows one value is no measurement any more: an integral
action that goes on by it takes the span out of its band. So what it shows drives no torque (`StuckState.silent`).
"""

from dataclasses import dataclass, field
from math import floor, inf

import numpy as np

from gateway.core.line import Line
from gateway.core.signals import BoolArray, Inputs, Quality
from safety.actions import Action, Finding, found

COUNTS = 3.0  #: that a usual change of a fine cell spans; the same value 60 times in a row is then beyond chance
SILENT_PERIODS = 10  #: of one value; by the noise of a fine cell in one of ten million
SILENT_RUNS = 3  #: and so many times as long as it has ever shown one value: a slow amplifier repeats itself
LEARNT_REVERSALS = 20  #: until a cell is judged
REMEMBERED = 100.0  #: reversals that the usual size of a change is the mean of, about; of fewer while there are fewer
_GOOD = int(Quality.GOOD)


@dataclass(frozen=True, slots=True)
class StuckLimits:
    measured: BoolArray  #: (n,), spans that are controlled by a load cell
    stuck_periods: int  #: without a change until a cell counts as stuck, at least


def stuck_limits(line: Line) -> StuckLimits:
    return StuckLimits(
        measured=np.array([span.control == "tension" for span in line.spans]),
        stuck_periods=max(1, floor(line.limits.stuck_s / line.control.period_s + 1e-9)),
    )


@dataclass(slots=True)
class Cell:
    """What is known of one load cell."""

    tension_n: float  #: last sample; NaN before the first
    same: int = 0  #: samples without a change, in a row
    longest: int = 0  #: such rows
    change_n: float = 0.0  #: the last one
    reversals: int = 0  #: changes against the one before
    smallest_n: float = inf  #: of their sizes
    usual_n: float = 0.0  #: of their sizes

    def change(self, change_n: float) -> None:
        """The value has changed."""
        self.longest = max(self.longest, self.same)
        self.same = 0
        if change_n * self.change_n < 0.0:
            self.reversals += 1
            self.smallest_n = min(self.smallest_n, abs(change_n))
            self.usual_n += (abs(change_n) - self.usual_n) / min(self.reversals, REMEMBERED)
        self.change_n = change_n

    def silent(self) -> bool:
        """Whether it has shown one value for longer than its noise allows."""
        return self.same >= max(SILENT_PERIODS, SILENT_RUNS * self.longest) and self.fine()

    def fine(self) -> bool:
        """Whether its noise is known to span several counts, so that it never shows one value for long."""
        return self.reversals >= LEARNT_REVERSALS and self.usual_n >= COUNTS * self.smallest_n


@dataclass(slots=True)
class StuckState:
    cells: list[Cell] = field(default_factory=list[Cell])  #: one per span
    speed_m_per_s: list[float] = field(default_factory=list[float])  #: last samples, one per roller
    stuck: BoolArray = field(default_factory=lambda: np.zeros(0, np.bool_))  #: (n,)
    silent: list[int] = field(default_factory=list[int])  #: spans, from 0, whose cell says nothing: no law acts on it


def find_stuck(limits: StuckLimits, state: StuckState, inputs: Inputs) -> list[Finding]:
    """Bring `state.stuck` (n,) and `state.silent` up to date; returns what stops the line.

    Nobody else knows the tension of that span. A cell that stays at one value counts only while some roller's speed
    changes: a line on which nothing at all moves tells nothing.
    """
    tensions, qualities = inputs.tension.value.tolist(), inputs.tension.quality.tolist()
    before, state.speed_m_per_s = state.speed_m_per_s, inputs.speed.value.tolist()
    if len(state.cells) != inputs.n:
        state.cells = [Cell(tension_n) for tension_n in tensions]
        state.stuck = np.zeros(inputs.n, np.bool_)
        return []
    alive = state.speed_m_per_s != before
    stuck, silent = list[int](), list[int]()
    # Plain numbers: for a handful of cells a loop takes less than arrays do.
    for i, (cell, tension_n, quality) in enumerate(zip(state.cells, tensions, qualities, strict=True)):
        if quality == _GOOD:
            change_n = tension_n - cell.tension_n  # NaN after the first sample of all
            if change_n != 0.0:
                cell.change(change_n)
            elif alive and limits.measured[i]:
                cell.same += 1
            cell.tension_n = tension_n
        if cell.same >= SILENT_PERIODS and cell.silent():
            silent.append(i)
        if cell.same >= limits.stuck_periods and cell.fine():
            stuck.append(i)
    state.silent = silent
    if stuck or np.count_nonzero(state.stuck):
        state.stuck = np.zeros(inputs.n, np.bool_)
        state.stuck[stuck] = True
    return [_finding(state.cells[i], i) for i in stuck]


def _finding(cell: Cell, i: int) -> Finding:
    return found("load-cell-stuck", Action.STOP, span=i + 1, tension_n=cell.tension_n, in_a_row=cell.same)
