"""What the loop watches beside its envelope: samples that cannot be true, and doubts that block proposals."""

import numpy as np

from gateway.core import finding as data
from gateway.core.doubts import Doubt
from gateway.core.drive_tells import DriveTells
from gateway.core.line import Line
from gateway.core.line_scales import line_scales
from gateway.core.signals import BoolArray, FloatArray, Inputs
from gateway.core.tension_estimate import MEAN_PERIODS
from gateway.loop.drive_watch import DriveWatch
from gateway.loop.setpoints import Setpoints
from safety import cell_zero, frozen
from safety.actions import Action, Finding, found
from safety.cell_balance import CellState, cell_limits, find_contradicted
from safety.drift import DriftState, drift_limits, restart, watch_balance
from safety.estimated_tension import EstimateState, estimate_limits, find_estimated, steady_n
from safety.impossible import ValueState, reject_impossible, value_limits
from safety.jumps import UNWINDER_SPEED, JumpState, jump_limits, reject_jumps, reject_unwinder
from safety.limits import envelope_limits
from safety.rejections import rejections, take_in
from safety.stuck import StuckState, find_stuck, stuck_limits

CREEPING = 0.02  #: of the greatest speed; below it torques say nothing about load cells
_AVERAGED_PERIODS = 6 * MEAN_PERIODS  #: after which averages of averages hold 2 % of what was before
SATURATED = 100.0  #: moments at a limit, net of the time away from it, until proposals are blocked
CODES = {
    Doubt.SATURATED: "saturated",
    Doubt.CELL_STUCK: "cell-stuck",
    Doubt.CELL_DRIFTS: "cell-drifts",
    Doubt.TORQUE_UNCOMPARED: "torque-not-compared",
}
DOUBTED = {
    Doubt.SATURATED: "doubt-saturated",
    Doubt.CELL_STUCK: "doubt-cell-stuck",
    Doubt.CELL_DRIFTS: "doubt-cell-drifts",
    Doubt.TORQUE_UNCOMPARED: "doubt-torque-not-compared",
}


class Watch:
    """`doubts` is what blocks proposals now; `stuck` (n,) are the spans whose load cell stands still.

    `speed_steps_m_per_s` (n,) is what a count of each drive's speed is worth; `tells` what else the drives' maps know,
    None for drives that keep to the profile and report torques without steps.
    """

    def __init__(self, line: Line, speed_steps_m_per_s: FloatArray, tells: DriveTells | None = None) -> None:
        self.doubts = Doubt.NONE
        self.speed_steps_m_per_s = speed_steps_m_per_s
        self.drives = DriveWatch(line, tells)
        self.stuck: BoolArray = np.zeros(line.n, np.bool_)
        self._cells = {cell.span: cell.name for cell in line.load_cells}
        self._jump_limits, self._jumps = jump_limits(line, speed_steps_m_per_s), JumpState()
        self._value_limits, self._values = value_limits(line, speed_steps_m_per_s), ValueState()
        self._rejections = rejections(line)
        self._applied_nm: FloatArray = np.zeros(line.n)
        self._stuck_limits, self._stuck = stuck_limits(line), StuckState()
        self._turning_m_per_s, self._frozen = frozen.turning_m_per_s(line), frozen.FrozenState()
        self._estimate_limits, self._estimate = estimate_limits(line, envelope_limits(line)), EstimateState()
        self._cell_limits, self._balance = cell_limits(line), CellState()
        self._zero = cell_zero.zero_state(line)
        self._unreliable = MEAN_PERIODS  #: periods until the estimate is of drives and cells that were reliable alone
        self._drift_limits, self._drift = drift_limits(line), DriftState()
        self._creeping_m_per_s = CREEPING * line.limits.speed_max_m_per_s
        self._saturated = 0  # periods, up and down
        self._saturated_periods = line_scales(line).periods(SATURATED)
        self._saturated_s = SATURATED * line_scales(line).moment_s
        self._setpoints: tuple[bytes, float] | None = None  #: of the period before; None while control is off
        self._drifts = False  #: a cell has been told to drift
        restart(self._drift_limits, self._drift)

    def reject_jumps(self, inputs: Inputs, applied_nm: FloatArray) -> list[Finding]:
        """Discard roller speeds that cannot be true; what stops the line. `applied_nm` (n,) acts from now on."""
        acted_nm = (applied_nm, self._applied_nm)
        self._applied_nm = applied_nm
        return reject_jumps(self._jump_limits, self._jumps, inputs, acted_nm)

    def forget_speeds(self) -> None:
        """What comes next is believed, as the first sample of all is."""
        self._jumps = JumpState()

    def reject_impossible(self, inputs: Inputs, request_m_per_s: float, asked_nm: FloatArray) -> list[Finding]:
        """Discard what tension, torque and v0 cannot be, while the line is controlled. What is told, or stops the line.

        `request_m_per_s` is what the PLC was asked for last, `asked_nm` (n,) what the drives were.
        """
        reject_unwinder(self._jump_limits, self._jumps, inputs, request_m_per_s)
        found = reject_impossible(self._value_limits, self._values, inputs, request_m_per_s, asked_nm)
        if self._jumps.rejected:
            found += self._jumps.rejected
            self._jumps.rejected.clear()
        confirmed = self._values.confirmed
        if self._jumps.unwind_confirmed:
            confirmed = [*confirmed, UNWINDER_SPEED]
        return take_in(self._rejections, found, confirmed)

    def believe_again(self) -> None:
        """The line is not controlled: whoever threads it moves what he likes, and what comes next is believed."""
        self._jumps.rejected.clear()
        self._rejections.waiting.clear()
        if len(self._values.tension_n):
            self._values = ValueState()

    def find_stuck(self, inputs: Inputs) -> list[Finding]:
        """Load cells and drives whose samples stand still while the line is controlled: what stops the line."""
        findings = find_stuck(self._stuck_limits, self._stuck, inputs)
        self.stuck = self._stuck.stuck
        return findings + frozen.find_frozen(self._turning_m_per_s, self._frozen, inputs)

    def find_estimated(
        self, inputs: Inputs, applied_nm: FloatArray, set_n: FloatArray, *, floor: bool
    ) -> list[Finding]:
        """Spans without a load cell whose tension cannot be within its band, or has fallen: what stops the line.

        `applied_nm` (n,) acted while the samples were taken, `set_n` (n,) are the set-points; `floor`: the web has been
        tensioned.
        """
        if self._estimate_limits is None:
            return []
        return find_estimated(self._estimate_limits, self._estimate, inputs, applied_nm, set_n, floor=floor)

    def find_contradicted(self, inputs: Inputs, applied_nm: FloatArray, *, doubted: bool) -> list[Finding]:
        """Load cells that torques and the cells beside them contradict: what stops the line.

        `applied_nm` (n,) acted while the samples were taken. `doubted`: a drive is lost, or nobody knows.
        """
        if doubted or self.silent or any(self.drives.suspected.tobytes()):
            self._balance = CellState()
            return []
        return find_contradicted(self._cell_limits, self._balance, inputs, applied_nm)

    def forget_balance(self) -> None:
        """Torques say nothing of load cells now."""
        if self._balance.block.size:
            self._balance = CellState()

    def below_zero(self, inputs: Inputs) -> list[data.Finding]:
        """Load cells that show less than a slack web can: nothing is armed, nor started, on them."""
        return cell_zero.below_zero(self._zero, inputs)

    def find_below_zero(self, inputs: Inputs) -> list[Finding]:
        """The same, once a period, and what it does while the web is controlled."""
        return cell_zero.find_below_zero(self._zero, inputs)

    def estimated_n(self, *, doubted: bool) -> FloatArray | None:
        """Once a period: the least and the most (2, n) that tensions may be, by torques and speeds where no cell is.

        None where every span has a load cell, and until drives and cells have been reliable for as long as it averages.
        `doubted`: a drive is lost, or nobody knows.
        """
        if self._estimate_limits is None:
            return None
        drives = self.drives
        if doubted or any(drives.suspected.tobytes()) or self.silent or drives.any_uncompared():
            self._unreliable = _AVERAGED_PERIODS
        elif self._unreliable:
            self._unreliable -= 1
        return None if self._unreliable else steady_n(self._estimate_limits, self._estimate)

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
        if self._estimate.means is not None:
            self._estimate = EstimateState()
        self._unreliable = MEAN_PERIODS  # averages begin with what is there
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
        self.drives.armed()
        self._drifts = False
        return self._tell(Doubt.NONE)

    def doubted(self) -> list[data.Finding]:
        """What is doubted now, and what a person can do: for a refusal."""
        return [data.finding(DOUBTED[doubt]) for doubt in self.doubts]

    @property
    def silent(self) -> list[int]:
        """Spans, from 0, whose load cell has shown one value for longer than its noise allows."""
        return self._stuck.silent

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
        if self.drives.any_uncompared():
            doubts |= Doubt.TORQUE_UNCOMPARED
        return doubts

    def _tell(self, doubts: Doubt) -> list[Finding]:
        """What has changed, once."""
        if doubts == self.doubts:
            return []
        came, went = doubts & ~self.doubts, self.doubts & ~doubts
        self.doubts = doubts
        over = [found("doubt-over", Action.NONE, doubt=CODES[doubt]) for doubt in went]
        return [finding for doubt in came for finding in self._found(doubt)] + over

    def _found(self, doubt: Doubt) -> list[Finding]:
        """What is told of a doubt that comes; drives that are not compared are told one by one (`uncompared`)."""
        if doubt == Doubt.SATURATED:
            return [found(CODES[doubt], Action.NONE, lasted_s=self._saturated_s)]
        if doubt == Doubt.CELL_STUCK:
            stuck = np.flatnonzero(self.stuck).tolist()
            return [found(CODES[doubt], Action.NONE, span=i + 1, cell=self._cell(i)) for i in stuck]
        if doubt == Doubt.CELL_DRIFTS:
            drifts = [(i, drift_n) for i, drift_n in enumerate(self._drift.drift_n.tolist()) if drift_n]
            return [found(CODES[doubt], Action.NONE, span=i + 1, cell=self._cell(i), drift_n=n) for i, n in drifts]
        return []

    def _cell(self, i: int) -> str:
        return self._cells.get(i + 1, "?")
