"""A linear law whose gains follow the line's speed, without a jump.

The laws of a fine grid of speeds are built once; each period the one nearest to the measured speed is asked. What a
state holds is torque (integral, torques in flight, disturbance) or a quantity of the line, never what a gain has still
to be applied to (Leith and Leithead, "Survey of gain-scheduling analysis and design", 2000, on where to put the
integrator). So it can be passed from law to law, and the torque changes only by the change of gain from one grid point
to the next, times the deviation at that moment.
"""

from bisect import bisect_right
from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise
from math import ceil, inf
from typing import Any

import numpy as np

from gateway.control.deviation import Measured
from gateway.control.law import Decision, Law
from gateway.control.reference import Reference
from gateway.core.controller_schedule import LinearConfig, ScheduledConfig, law_at
from gateway.core.signals import FloatArray

STEPS = 48  #: of the grid over the whole range, at least
HYSTERESIS = 0.25  #: of a step, beyond the middle between two grid points


class SpeedGrid:
    """The speeds of a schedule's laws: its nodes, and evenly between each two."""

    def __init__(self, config: ScheduledConfig) -> None:
        self._config = config
        nodes = config.speed_m_per_s
        step = (nodes[-1] - nodes[0]) / STEPS
        fine = [
            np.linspace(low, high, ceil((high - low) / step - 1e-9), endpoint=False) for low, high in pairwise(nodes)
        ]
        self.speeds_m_per_s: list[float] = [*np.concatenate(fine).tolist(), nodes[-1]]
        self._middles = [0.5 * (low + high) for low, high in pairwise(self.speeds_m_per_s)]
        wider = [HYSTERESIS * (high - low) for low, high in pairwise(self.speeds_m_per_s)]
        self._lowest = [-inf, *(m - w for m, w in zip(self._middles, wider, strict=True))]
        self._highest = [*(m + w for m, w in zip(self._middles, wider, strict=True)), inf]

    @cached_property
    def laws(self) -> list[LinearConfig]:
        """One for each speed."""
        return [law_at(self._config, speed) for speed in self.speeds_m_per_s]

    def nearest(self, speed_m_per_s: float) -> int:
        """The grid point for a speed."""
        return bisect_right(self._middles, speed_m_per_s)

    def following(self, at: int, speed_m_per_s: float) -> int:
        """The grid point after `at`: noise of the speed does not move it to and fro."""
        if self._lowest[at] <= speed_m_per_s <= self._highest[at]:
            return at
        return self.nearest(speed_m_per_s)

    def course(self, speeds_m_per_s: list[float]) -> list[int]:
        """The grid points of a law that engages at the first speed and goes through all."""
        found = [self.nearest(speeds_m_per_s[0])]
        for speed in speeds_m_per_s:
            found.append(self.following(found[-1], speed))
        return found[1:]


@dataclass(slots=True)
class ScheduledState:
    at: int  #: grid point
    inner: Any  #: the state of its law


@dataclass(slots=True)
class Asked(Decision):
    """A decision, and whose it was."""

    at: int = 0
    inner: Decision | None = None


class Scheduled:
    """The law of `ScheduledConfig`: `laws` has one for each point of `grid`."""

    def __init__(self, grid: SpeedGrid, laws: list[Law[Any]]) -> None:
        self.n = laws[0].n
        self._grid = grid
        self._laws = laws

    def engage(self, measured: Measured, reference: Reference, applied_nm: FloatArray) -> ScheduledState:
        at = self._grid.nearest(measured.unwind_speed_m_per_s)
        return ScheduledState(at, self._laws[at].engage(measured, reference, applied_nm))

    def ask(self, state: ScheduledState, measured: Measured, reference: Reference) -> Asked:
        at = self._grid.following(state.at, measured.unwind_speed_m_per_s)
        inner = self._laws[at].ask(state.inner, measured, reference)
        return Asked(inner.torque_nm, inner.errors, inner.fallback, at, inner)

    def commit(self, state: ScheduledState, decision: Decision, applied_nm: FloatArray) -> ScheduledState:
        assert isinstance(decision, Asked) and decision.inner is not None
        return ScheduledState(decision.at, self._laws[decision.at].commit(state.inner, decision.inner, applied_nm))
