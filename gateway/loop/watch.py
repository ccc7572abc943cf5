"""What the loop watches beside its envelope: samples that cannot be true, and doubts that block proposals."""

import numpy as np

from gateway.core.doubts import Doubt
from gateway.core.line import Line
from gateway.core.signals import BoolArray, FloatArray, Inputs
from gateway.loop.setpoints import Setpoints
from safety import frozen
from safety.actions import Action, Finding
from safety.drift import DriftState, drift_limits, restart, watch_balance
from safety.jumps import JumpState, jump_limits, reject_jumps, reject_unwinder
from safety.stuck import StuckState, find_stuck, stuck_limits

CREEPING = 0.02  #: of the greatest speed; below it torques say nothing about load cells
SATURATED_S = 2.0  #: at a limit, net of the time away from it, until proposals are blocked


class Watch:
    """`doubts` is what blocks proposals now; `stuck` (n,) are the spans whose load cell stands still.

    `speed_steps_m_per_s` (n,) is what a count of each drive's speed is worth.
    """

    def __init__(self, line: Line, speed_steps_m_per_s: FloatArray) -> None:
        self.doubts = Doubt.NONE
        self.stuck: BoolArray = np.zeros(line.n, np.bool_)
        self._cells = {cell.span: cell.name for cell in line.load_cells}
        self._jump_limits, self._jumps = jump_limits(line, speed_steps_m_per_s), JumpState()
        self._applied_nm: FloatArray = np.zeros(line.n)
        self._stuck_limits, self._stuck = stuck_limits(line), StuckState()
        self._turning_m_per_s, self._frozen = frozen.turning_m_per_s(line), frozen.FrozenState()
        self._drift_limits, self._drift = drift_limits(line), DriftState()
        self._creeping_m_per_s = CREEPING * line.limits.speed_max_m_per_s
        self._saturated = 0  # periods, up and down
        self._saturated_periods = max(1, round(SATURATED_S / line.control.period_s))
        self._setpoints: tuple[bytes, float] | None = None  #: of the period before; None while control is off
        self._drifts = False  #: a cell has been told to drift
        restart(self._drift_limits, self._drift)

    def reject_jumps(self, inputs: Inputs, applied_nm: FloatArray) -> list[Finding]:
        """Discard roller speeds that cannot be true; what stops the line. `applied_nm` (n,) acts from now on."""
        acted_nm = (applied_nm, self._applied_nm)
        self._applied_nm = applied_nm
        return reject_jumps(self._jump_limits, self._jumps, inputs, acted_nm)

    def reject_unwinder(self, inputs: Inputs, request_m_per_s: float) -> None:
        """Discard a v0 that cannot be true. `request_m_per_s` is what the PLC was asked for last."""
        reject_unwinder(self._jump_limits, self._jumps, inputs, request_m_per_s)

    def find_stuck(self, inputs: Inputs) -> list[Finding]:
        """Load cells and drives whose samples stand still while the line is controlled: what stops the line."""
        findings = find_stuck(self._stuck_limits, self._stuck, inputs)
        self.stuck = self._stuck.stuck
        return findings + frozen.find_frozen(self._turning_m_per_s, self._frozen, inputs)

    def controlled(
        self, inputs: Inputs, setpoints: Setpoints, applied_nm: FloatArray, saturated: bool
    ) -> list[Finding]:
        """A period under control; `applied_nm` (n,) acted while the samples were taken. Returns what is to be told."""
        count = self._saturated + 1 if saturated else self._saturated - 1
        self._saturated = min(max(count, 0), self._saturated_periods)
        before, self._setpoints = self._setpoints, (setpoints.tension_n.tobytes(), setpoints.speed_m_per_s)
        creeping = setpoints.speed_m_per_s < self._creeping_m_per_s  # dry friction holds what it likes at standstill
        if creeping or self.any_stuck() or self._setpoints != before:
            restart(self._drift_limits, self._drift)
        else:
            watch_balance(self._drift_limits, self._drift, inputs.tension.value, inputs.speed.value, applied_nm)
        return self._tell(self._doubts())

    def off(self) -> None:
        """Control is off. What was doubted stays so, until somebody has looked and arms."""
        if self._setpoints is None:
            return
        self._setpoints = None
        self._saturated = 0
        self._stuck = StuckState()
        frozen.restart(self._frozen)
        self._drift = DriftState()
        restart(self._drift_limits, self._drift)

    def armed(self) -> list[Finding]:
        """A person arms: everything begins anew. Returns what is to be told."""
        self.stuck = np.zeros_like(self.stuck)
        self._drifts = False
        return self._tell(Doubt.NONE)

    def any_stuck(self) -> bool:
        """Whether a load cell stands still."""
        return any(self.stuck.tobytes())

    def _doubts(self) -> Doubt:
        doubts = Doubt.NONE
        lasting = self._saturated > 0 and Doubt.SATURATED in self.doubts
        if self._saturated >= self._saturated_periods or lasting:
            doubts |= Doubt.SATURATED
        if self.any_stuck():
            doubts |= Doubt.CELL_STUCK
        # It stays until somebody arms: a zero is checked at standstill, and a new set-point only hides it.
        self._drifts = self._drifts or bool(np.count_nonzero(self._drift.drift_n))
        if self._drifts:
            doubts |= Doubt.CELL_DRIFTS
        return doubts

    def _tell(self, doubts: Doubt) -> list[Finding]:
        """What has changed, once, in words."""
        if doubts == self.doubts:
            return []
        came, went = doubts & ~self.doubts, self.doubts & ~doubts
        self.doubts = doubts
        told = [Finding(_name(doubt), Action.NONE, self._text(doubt)) for doubt in came]
        return told + [Finding(_name(doubt), Action.NONE, f"over: {_name(doubt)}") for doubt in went]

    def _text(self, doubt: Doubt) -> str:
        if doubt == Doubt.SATURATED:
            return f"torques have been at their limits for {SATURATED_S:g} s: proposals are blocked"
        if doubt == Doubt.CELL_STUCK:
            cells = ", ".join(self._cell(int(i)) for i in np.flatnonzero(self.stuck))
            return f"stuck: {cells}; proposals are blocked: check cell, amplifier and cable"
        drift_n = self._drift.drift_n
        cells = ", ".join(f"{self._cell(int(i))} by about {drift_n[i]:+.1f} N" for i in np.flatnonzero(drift_n))
        first = " (or the friction of roller 1 has changed)" if drift_n[0] else ""
        return f"drifting: {cells}{first}; proposals are blocked: check the zero when the line stands"

    def _cell(self, i: int) -> str:
        return f"{self._cells.get(i + 1, 'load cell')} (span {i + 1})"


def _name(doubt: Doubt) -> str:
    return (doubt.name or "doubt").lower().replace("_", " ")
