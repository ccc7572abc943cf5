"""What the configuration that controls the line has shown of itself: a move of a tension and a change of speed. Pure.

A person may confirm a first configuration only after both. Compared are points at which the line has settled in RUN
with the web moving. The first of them is where the start has led to, so that neither the tensioning of the web nor the
first ramp from standstill counts: both are led by the start's own stages and say little of the law at work. What was
measured must have gone along: a set-point alone shows nothing.
"""

import numpy as np

from gateway.core.deployment import least_shown
from gateway.core.line import Line
from gateway.core.line_scales import ANSWERED, line_scales
from gateway.core.signals import FloatArray, Inputs
from gateway.core.states import LoopState, Phase
from gateway.loop.machine import Machine
from gateway.loop.setpoints import Setpoints

LED = (Phase.TENSIONING, Phase.RUNNING, Phase.HOLDING)  #: an arming that fails, say, speaks of no configuration
GONE_ALONG = 0.5  #: the share of a move that the mean of what is measured must have made with the set-point


class Settled:
    """Where set-points stand, and what is measured there in the mean once they have stood for long enough."""

    def __init__(self, setpoints: Setpoints) -> None:
        self.target_n = setpoints.tension_target_n.copy()
        self.target_m_per_s = setpoints.speed_target_m_per_s
        self.periods = 0
        self.tension_n: FloatArray = np.zeros(len(self.target_n))
        self.speed_m_per_s = 0.0

    def is_at(self, setpoints: Setpoints) -> bool:
        if self.target_m_per_s != setpoints.speed_target_m_per_s:
            return False
        return not np.count_nonzero(self.target_n != setpoints.tension_target_n)

    def take(self, inputs: Inputs) -> None:
        self.periods += 1
        self.tension_n += (inputs.tension.value - self.tension_n) / self.periods
        self.speed_m_per_s += (float(inputs.unwind_speed.value[0]) - self.speed_m_per_s) / self.periods


class Trial:
    """Of the configuration that controls the line, since it does."""

    def __init__(self, line: Line, setpoints: Setpoints) -> None:
        scales = line_scales(line)
        self.tension_moved = False
        self.speed_changed = False
        self._setpoints = setpoints
        self._periods = scales.periods(ANSWERED)
        self._small_m_per_s = scales.speed_m_per_s
        self._least_n, self._least_m_per_s = least_shown(line)
        self._measured = np.array([1.0 if span.control == "tension" else 0.0 for span in line.spans])
        self._first: Settled | None = None  #: where the start has led to
        self._last: Settled | None = None  #: that was compared with it
        self._now: Settled | None = None  #: that is being measured
        self._leads = False  #: it controls the web, or has until a stop whose torque is not off yet

    def begin(self) -> None:
        """Another configuration controls the line, or it was stopped half way."""
        self.tension_moved = self.speed_changed = False
        self._first = self._last = self._now = None

    def step(self, machine: Machine, inputs: Inputs, usable: bool) -> None:
        """Once a period. `usable`: the samples are."""
        complete = self.tension_moved and self.speed_changed
        if machine.state is LoopState.STOP:
            # What a person stops has shown what it has; whatever else stops a line that it leads speaks against it.
            if self._leads and not (complete and machine.by_person):
                self.begin()
            self._leads = self._leads and machine.phase is not Phase.OFF
            return
        self._leads = machine.phase in LED
        if complete:
            return
        if self._last is not None and self._last.is_at(self._setpoints):  # as nearly always
            return
        if machine.phase is not Phase.RUNNING or not usable or not self._stands(inputs):
            self._now = None
            return
        if self._now is None or not self._now.is_at(self._setpoints):
            self._now = Settled(self._setpoints)
        self._now.take(inputs)
        if self._now.periods >= self._periods:
            self._compare(self._now)

    def _stands(self, inputs: Inputs) -> bool:
        """Whether the web moves as it shall, every set-point at its target, and what is measured near it."""
        setpoints = self._setpoints
        if not (setpoints.speed_m_per_s > 0.0 and setpoints.at_rest()):
            return False
        away_m_per_s = abs(float(inputs.unwind_speed.value[0]) - setpoints.speed_m_per_s)
        near = away_m_per_s <= self._small_m_per_s + 0.2 * setpoints.speed_m_per_s
        return near and setpoints.followed_by(inputs.tension.value, self._measured)

    def _compare(self, now: Settled) -> None:
        self._last, self._now = now, None
        first = self._first
        if first is None:
            self._first = now
            return
        asked_n = now.target_n - first.target_n
        gone = (now.tension_n - first.tension_n) * np.sign(asked_n) >= GONE_ALONG * np.abs(asked_n)
        if not self._measured.any():  # then nothing shows that it went along
            gone[:] = True
        self.tension_moved |= bool(np.any(gone & (np.abs(asked_n) >= self._least_n)))
        asked_m_per_s = now.target_m_per_s - first.target_m_per_s
        gone_m_per_s = now.speed_m_per_s - first.speed_m_per_s
        if abs(asked_m_per_s) >= self._least_m_per_s:
            self.speed_changed |= gone_m_per_s / asked_m_per_s >= GONE_ALONG
