"""One control period, on one screen: wait -> read -> estimate -> control -> envelope -> write -> record."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from drivers.port import Link
from gateway.control.law import Measured
from gateway.control.laws import make_law
from gateway.core.controller import Controller
from gateway.core.line import Line
from gateway.core.signals import BoolArray, DriveRequest, DriveState, FloatArray, Inputs, Outputs, Quality
from gateway.core.states import OPERATORS_STOP, LoopState, Phase
from gateway.core.telemetry import Frame
from gateway.loop import machine as machines
from gateway.loop.configurations import Configurations, LawOf
from gateway.loop.experiment import Experiments, Tell
from gateway.loop.guard import Guard
from gateway.loop.machine import Machine, Observation, Times
from gateway.loop.pacer import Tick
from gateway.loop.setpoints import Setpoints
from gateway.loop.standstill import Standstill, standing
from gateway.loop.torque import LawFailed, TorquePath
from gateway.loop.watch import Watch
from safety.actions import Action, Finding, most_severe
from safety.envelope import NOTHING, Assessment, EnvelopeState, Supervision, check_inputs, check_timing
from safety.limits import envelope_limits

READ_SHARE = 0.5  #: of a period, for samples to arrive; the rest is for control and writing
_ENABLED = int(DriveState.ENABLED)
_BAD = int(Quality.BAD)
STILL_ON_PERIODS = 10  #: a drive that is told OFF and still says ENABLED is told to stop quickly

CONTROLLED = (Phase.TENSIONING, Phase.RUNNING, Phase.HOLDING, Phase.SLOWING)
SUPERVISED = (Phase.RUNNING, Phase.HOLDING)  #: by the monitor: the web is tensioned, and nothing stops it yet
WITH_TORQUE = (*CONTROLLED, Phase.UNLOADING)
_PRODUCTION = Supervision(
    feedback=True, standstill=False, tension_floor=True, drives=DriveState.ENABLED, transport=True
)
SUPERVISION = {
    Phase.SILENT: NOTHING,
    Phase.ARMING: NOTHING,
    Phase.READY: Supervision(
        feedback=False, standstill=False, tension_floor=False, drives=DriveState.READY, transport=False
    ),
    Phase.ENABLING: NOTHING,
    Phase.TENSIONING: Supervision(
        feedback=True, standstill=True, tension_floor=False, drives=DriveState.ENABLED, transport=False
    ),
    Phase.RUNNING: _PRODUCTION,
    Phase.HOLDING: _PRODUCTION,
    Phase.SLOWING: replace(_PRODUCTION, transport=False),
    Phase.UNLOADING: NOTHING,
    Phase.OFF: NOTHING,
}


@dataclass(slots=True)
class Account:
    """What happened so far."""

    sequence: int = 0
    skipped: int = 0  #: periods
    held: int = 0  #: periods in a row with held outputs


class Cycle:
    """The loop's whole state between two periods."""

    def __init__(
        self,
        line: Line,
        config: Controller,
        links: list[Link],
        watch: Watch,
        clock: Callable[[], float],
        record: Callable[[Frame], None],
        announce: Callable[[Machine, Machine, list[Finding]], None],
        tell: Tell | None = None,
        *,
        simulated: bool = False,
        law_of: LawOf = make_law,
    ) -> None:
        self.line = line
        self.links = links
        self.limits = envelope_limits(line)
        self.machine = Machine(since_s=clock())
        self.inputs = Inputs(line.n)
        self.outputs = Outputs(line.n)
        self.setpoints = Setpoints(line.recipes[0])
        self.configurations = Configurations(
            line, config, law_of, lambda law: TorquePath(law, self.limits, line), self.setpoints, tell
        )
        self.torque_path = self.configurations.path
        self.guard = Guard(line)
        self.account = Account()
        self.watch = watch
        self.clock = clock
        self.experiments = Experiments(self.setpoints, self.limits, clock, tell, simulated=simulated)
        self._record = record
        self._announce = announce
        self._times = Times(line.limits.tensioning_time_s, line.moves.stop_time_s)
        self._envelope = EnvelopeState()
        self._latched_s = clock()  #: when the drives latched the torque of the period before
        self._still_on = np.zeros(line.n, dtype=np.int64)  #: periods in a row ENABLED while told OFF
        self._standstill = Standstill(line.control.period_s)
        self._shaped_moves = line.moves.model_copy(update={"shape": "minimum-jerk"})

    async def period(self, tick: Tick) -> None:
        """Read, decide, write."""
        await self._read(tick)
        seen = self._check(tick)
        self._step_machine(seen, tick.now_s)
        before_nm = self.outputs.torque_nm
        self.configurations.look(tick.now_s)
        torque_nm, saturated = self._torque(seen, tick)
        self._write(torque_nm)
        self.guard.sent(torque_nm)
        cycle_s = self.clock() - tick.now_s
        if self.machine.phase in CONTROLLED and seen.usable:  # only blocks proposals: after the commands are out
            self._alarm(self.watch.controlled(self.inputs, self.setpoints, before_nm, saturated))
        self.experiments.look(self.inputs, torque_nm, self.account.held, tick.due_s)
        self._frame(tick, saturated, cycle_s)

    def foreseen(self, setpoint_n: FloatArray, unwind_speed_m_per_s: float | None = None) -> str:
        """What would come of these set-points (n,), or this speed, at once, as the accepted model has it; or nothing.

        Between two periods only.
        """
        measured = self._estimate()
        if unwind_speed_m_per_s is not None:
            measured = replace(measured, unwind_speed_m_per_s=unwind_speed_m_per_s)
        return self.guard.foresees(self.configurations, self.torque_path, measured, setpoint_n)

    def any_enabled(self) -> bool:
        """Whether a drive says that it is enabled."""
        return _ENABLED in self.inputs.drive_state.tolist()

    def change(self, machine: Machine) -> None:
        """Take over what a command decided. Between two periods only."""
        if machine.phase is Phase.ARMING:
            self.torque_path.lost[:] = False
            self._alarm(self.watch.armed())
        self._move_to(machine, [])

    async def _read(self, tick: Tick) -> None:
        for link in self.links:
            link.trigger(tick.now_s)
        self._latched_s = self.clock()  # later than it was: it may take time to be sent on a busy computer
        deadline_s = tick.now_s + READ_SHARE * self.limits.period_s
        for link in self.links:
            await link.collect(self.inputs, deadline_s)

    def _check(self, tick: Tick) -> Assessment:
        phase = self.machine.phase
        supervision = SUPERVISION[phase]
        jumps = self.watch.reject_jumps(self.inputs, self.outputs.torque_nm)
        if supervision.feedback:
            self.watch.reject_unwinder(self.inputs, self.outputs.speed_request_m_per_s)
        if phase in WITH_TORQUE:
            self.torque_path.lost |= self.inputs.drive_state != _ENABLED
        late, self._envelope = check_timing(self.limits, self._envelope, tick.skipped)
        seen, self._envelope = check_inputs(self.limits, self._envelope, self.inputs, supervision)
        if supervision.feedback:
            seen.findings.extend(jumps)
            seen.findings.extend(self.watch.find_stuck(self.inputs) if seen.usable else ())
        if phase is Phase.SILENT:
            seen.findings.clear()
        elif phase is not Phase.ARMING:
            seen.findings.extend(late)
        return seen

    def _step_machine(self, seen: Assessment, now_s: float) -> None:
        phase = self.machine.phase
        if phase in machines.LASTING and not seen.findings:
            return
        observation = Observation(
            action=most_severe(seen.findings),
            reason="; ".join(finding.text for finding in seen.findings if finding.action >= Action.STOP),
            not_ready=self._drives_other_than(DriveState.READY) if phase is Phase.ARMING else "",
            not_enabled=self._drives_other_than(DriveState.ENABLED) if phase is Phase.ENABLING else "",
            tensioned=self.setpoints.followed_by(self.inputs.tension.value, self.limits.measured),
            standstill=self.setpoints.speed_m_per_s == 0.0 and standing(self.inputs),
            plc_answers=not seen.plc_lost,
            feedback=not seen.feedback_lost,
            torque_zero=not self.outputs.torque_nm.any(),
        )
        self._move_to(machines.advance(self._times, self.machine, observation, now_s), seen.findings)

    def _drives_other_than(self, wanted: DriveState) -> str:
        """ "drive-3 STO, drive-5 FAULT": the drives that are not as wanted."""
        states = self.inputs.drive_state
        names = {drive.roller - 1: drive.name for drive in self.line.drives}
        return ", ".join(
            f"{names[i]} {DriveState(int(states[i])).name}" for i in range(self.line.n) if states[i] != wanted
        )

    def _move_to(self, machine: Machine, findings: list[Finding]) -> None:
        before, self.machine = self.machine, machine
        if before.phase is machine.phase:
            return
        if machine.phase is not Phase.RUNNING:
            self.experiments.end(f"the line left RUN: {machine.reason or machine.state.name}")
        if machine.state is LoopState.STOP and self.configurations.probation is not None:
            self.configurations.roll_back(f"the line stopped: {machine.reason}")
        if machine.phase is Phase.OFF:  # a speed from before the stop is not taken up again
            self.setpoints.speed_target_m_per_s = self.setpoints.recipe.speed_m_per_s
        self._announce(before, machine, findings)

    def _torque(self, seen: Assessment, tick: Tick) -> tuple[FloatArray, bool]:
        """The torque (n,) to apply in this period, and whether a limit cut it."""
        applied_nm = self.outputs.torque_nm
        if self.machine.phase not in CONTROLLED:
            self.torque_path.disengage()
            self.guard.off()
            self.watch.off()
            self.account.held = 0
            unloading = self.machine.phase is Phase.UNLOADING
            return self.torque_path.unload(applied_nm) if unloading else np.zeros(self.line.n), False
        if not seen.usable:
            self.account.held += 1
            return np.where(self.torque_path.lost, 0.0, applied_nm), False
        self.account.held = 0
        self._advance_setpoints()
        # It is latched at the next tick: after a late wake-up that is less than a period from the last.
        interval_s = tick.due_s + self.limits.period_s - self._latched_s
        before, path = self.torque_path.fallback, self.torque_path
        try:
            found = self._governed(applied_nm, interval_s, tick.now_s)
            if path.fallback and not before:
                self._alarm([Finding("fallback", Action.NONE, f"the law has no solution of its own: {path.fallback}")])
            return found
        except LawFailed as failed:
            off = machines.torque_off(self.machine, tick.now_s, failed.finding.text)
            self._move_to(off, [failed.finding])
            return self._torque(seen, tick)

    def _governed(self, applied_nm: FloatArray, interval_s: float, now_s: float) -> tuple[FloatArray, bool]:
        """As `TorquePath.control`. What fails on probation, or must not go on, gives way in this very period."""
        configurations, path = self.configurations, self.torque_path
        measured = self._estimate()
        try:
            found = path.control(measured, self.setpoints, applied_nm, interval_s)
        except Exception as failed:  # whatever a law on probation may raise
            reason = failed.finding.text if isinstance(failed, LawFailed) else f"{type(failed).__name__}: {failed}"
            if not configurations.roll_back(f"the law failed: {reason}"):
                raise
            return path.control(measured, self.setpoints, applied_nm, interval_s)
        if self.machine.phase not in SUPERVISED:
            return found
        findings = self.guard.against(configurations, path, measured, self.setpoints.tension_n, found)
        if not findings:
            return found
        if configurations.roll_back("; ".join(finding.text for finding in findings)):
            self._alarm(findings)
            return path.control(measured, self.setpoints, applied_nm, interval_s)
        reason = "; ".join(finding.text for finding in findings)
        self._move_to(machines.stop(self.machine, now_s, reason), findings)
        return found

    def _estimate(self) -> Measured:
        # The measured values as they are: a law that wants an observer brings its own.
        inputs = self.inputs
        return Measured(inputs.tension.value, inputs.speed.value, float(inputs.unwind_speed.value[0]))

    def _advance_setpoints(self) -> None:
        moves = self._shaped_moves if self.configurations.shaped else self.line.moves
        phase = self.machine.phase
        goal = self.setpoints.speed_target_m_per_s if phase is Phase.RUNNING else 0.0
        if self.experiments.run is not None:
            goal = self.experiments.run.advance(self.setpoints)
        rate = moves.stop_rate_m_per_s2 if phase is Phase.SLOWING else moves.speed_rate_m_per_s2
        shape = moves.shape if phase is Phase.RUNNING else "ramp"  # what stops does not wait for a curve to bend
        self.setpoints.advance(moves, self.limits.period_s, goal, rate, shape)

    def _write(self, torque_nm: FloatArray) -> None:
        outputs, phase = self.outputs, self.machine.phase
        outputs.torque_nm = torque_nm
        outputs.drive_request[:] = self._requests()
        if phase not in CONTROLLED:
            self.setpoints.begin_at_speed(0.0)
        outputs.speed_request_m_per_s = self.setpoints.speed_m_per_s
        outputs.run = phase in CONTROLLED
        for link in self.links:
            link.write(outputs)

    def _requests(self) -> Any:
        """What is asked of each drive: enabling only while ENABLING, and again only after a person has armed."""
        states, phase = self.inputs.drive_state, self.machine.phase
        off, enable = int(DriveRequest.OFF), int(DriveRequest.ENABLE)
        if phase in WITH_TORQUE:
            return np.where(self.torque_path.lost, off, enable) if self.torque_path.any_lost() else enable
        if phase is Phase.ENABLING:
            return enable
        if phase is Phase.READY:
            return int(DriveRequest.READY)
        if phase is Phase.ARMING:
            return np.where(states == DriveState.FAULT, int(DriveRequest.RESET_FAULT), int(DriveRequest.READY))
        return np.where(self._stays_on(), int(DriveRequest.QUICK_STOP), off)

    def _alarm(self, findings: list[Finding]) -> None:
        if findings:
            self._announce(self.machine, self.machine, findings)

    def _stays_on(self) -> BoolArray:
        """Drives (n,) that do not obey OFF. Said once, when it begins."""
        on = self.inputs.drive_state == _ENABLED
        self._still_on = np.where(on, self._still_on + 1, 0)
        for i in np.flatnonzero(self._still_on == STILL_ON_PERIODS):
            text = f"drive {i + 1} stays enabled though it was told off; it is told to stop quickly: cut its power"
            self._alarm([Finding("drive stays on", Action.TORQUE_OFF, text)])
        return self._still_on >= STILL_ON_PERIODS

    def _frame(self, tick: Tick, saturated: bool, cycle_s: float) -> None:
        inputs, account = self.inputs, self.account
        quality = inputs.tension.quality
        if self.watch.any_stuck():
            quality = np.where(self.watch.stuck, _BAD, quality).astype(np.int8)
        account.skipped += tick.skipped
        account.sequence += 1
        machine = self.machine
        asked = machine.phase is not Phase.OFF and self.setpoints.speed_m_per_s != 0.0
        self._record(
            Frame(
                sequence=account.sequence,
                time_s=tick.due_s,
                lateness_s=tick.now_s - tick.due_s,
                cycle_s=cycle_s,
                missed=account.skipped,
                unwind_speed_m_per_s=float(inputs.unwind_speed.value[0]),
                speed_setpoint_m_per_s=self.setpoints.speed_m_per_s,
                state=machine.state,
                phase=machine.phase,
                by_person=machine.state is LoopState.STOP and machine.reason.startswith(OPERATORS_STOP),
                standstill=self._standstill.look(inputs, asked),
                saturated=saturated,
                held=account.held,
                doubts=int(self.watch.doubts),
                tension_n=inputs.tension.value,
                tension_setpoint_n=self.setpoints.tension_n,
                speed_m_per_s=inputs.speed.value,
                torque_nm=self.outputs.torque_nm,
                torque_actual_nm=inputs.torque.value,
                tension_quality=quality,
                drive_state=inputs.drive_state,
            )
        )
