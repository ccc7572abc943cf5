"""One control period, on one screen: wait -> read -> estimate -> control -> envelope -> write -> record."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from drivers.port import Link
from gateway.control.law import Law, Measured
from gateway.core.line import Line
from gateway.core.signals import DriveRequest, DriveState, FloatArray, Inputs, Outputs, Quality
from gateway.core.states import LoopState, Phase
from gateway.core.telemetry import Frame
from gateway.loop import machine as machines
from gateway.loop.machine import Machine, Observation, Times
from gateway.loop.pacer import Tick
from gateway.loop.setpoints import Setpoints
from safety.actions import Action, Finding, most_severe
from safety.envelope import (
    EnvelopeState,
    Supervision,
    check_inputs,
    check_timing,
    check_torque,
    feedback_usable,
    limit_torque,
)
from safety.limits import envelope_limits

READ_SHARE = 0.5  #: of a period, for samples to arrive; the rest is for control and writing

CONTROLLED = (Phase.TENSIONING, Phase.RUNNING, Phase.HOLDING, Phase.SLOWING)
TENSIONED = (Phase.RUNNING, Phase.HOLDING, Phase.SLOWING)
REQUEST_OF = {
    Phase.READY: DriveRequest.READY,
    Phase.ENABLING: DriveRequest.ENABLE,
    Phase.TENSIONING: DriveRequest.ENABLE,
    Phase.RUNNING: DriveRequest.ENABLE,
    Phase.HOLDING: DriveRequest.ENABLE,
    Phase.SLOWING: DriveRequest.ENABLE,
    Phase.UNLOADING: DriveRequest.ENABLE,
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
        law: Law[Any],
        links: list[Link],
        clock: Callable[[], float],
        record: Callable[[Frame], None],
        announce: Callable[[Machine, Machine, list[Finding]], None],
    ) -> None:
        self.line = line
        self.law = law
        self.links = links
        self.limits = envelope_limits(line)
        self.machine = Machine(since_s=clock())
        self.inputs = Inputs(line.n)
        self.outputs = Outputs(line.n)
        recipe = line.recipes[0]
        targets = np.array(recipe.tension_n)
        self.setpoints = Setpoints(np.zeros(line.n), targets, 0.0, recipe.speed_m_per_s)
        self.account = Account()
        self._clock = clock
        self._record = record
        self._announce = announce
        self._times = Times(line.limits.tensioning_time_s, line.moves.stop_time_s)
        self._envelope = EnvelopeState()
        self._law_state: Any = None  #: None while the law is not engaged

    async def period(self, tick: Tick) -> None:
        await self._read(tick)
        findings = self._check(tick)
        self._step_machine(findings, tick.now_s)
        torque, saturated = self._torque(tick)
        self._write(torque)
        self._frame(tick, saturated)

    def change(self, machine: Machine) -> None:
        """Take over what a command decided. Between two periods only."""
        self._move_to(machine, [])

    async def _read(self, tick: Tick) -> None:
        for link in self.links:
            link.trigger(tick.now_s)
        deadline_s = tick.now_s + READ_SHARE * self.limits.period_s
        for link in self.links:
            await link.collect(self.inputs, deadline_s)

    def _check(self, tick: Tick) -> list[Finding]:
        phase = self.machine.phase
        supervision = Supervision(
            feedback=phase in CONTROLLED,
            tension_floor=phase in TENSIONED,
            drives_enabled=phase in CONTROLLED,
        )
        late, self._envelope = check_timing(self.limits, self._envelope, tick.skipped)
        findings, self._envelope = check_inputs(self.limits, self._envelope, self.inputs, supervision)
        return [] if phase is Phase.SILENT else late + findings

    def _step_machine(self, findings: list[Finding], now_s: float) -> None:
        states = self.inputs.drive_state
        unwind = self.inputs.unwind_speed
        tension = self.inputs.tension.value[self.limits.measured > 0]
        seen = Observation(
            action=most_severe(findings),
            reason="; ".join(finding.text for finding in findings if finding.action >= Action.STOP),
            drives_ready=bool(((states == DriveState.READY) | (states == DriveState.ENABLED)).all()),
            drives_enabled=bool((states == DriveState.ENABLED).all()),
            tensioned=self.setpoints.reached()
            and bool(((tension >= self.limits.tension_min_n) & (tension <= self.limits.tension_max_n)).all()),
            standstill=self.setpoints.speed_m_per_s == 0.0
            and unwind.quality[0] == Quality.GOOD
            and abs(unwind.value[0]) <= machines.STANDSTILL_M_PER_S,
            plc_answers=self._envelope.plc_missing_periods < self.limits.hold_periods,
            feedback=self._envelope.missing_periods < self.limits.hold_periods,
            torque_zero=not self.outputs.torque_nm.any(),
        )
        self._move_to(machines.advance(self._times, self.machine, seen, now_s), findings)

    def _move_to(self, machine: Machine, findings: list[Finding]) -> None:
        before, self.machine = self.machine, machine
        if before.phase is not machine.phase:
            self._announce(before, machine, findings)

    def _torque(self, tick: Tick) -> tuple[FloatArray, bool]:
        """The torque (n,) to apply in this period, and whether a limit cut it."""
        applied = self.outputs.torque_nm
        if self.machine.phase not in CONTROLLED:
            self._law_state = None
            self.account.held = 0
            return self._unload(applied), False
        self._advance_setpoints()
        if not feedback_usable(self.limits, self.inputs):
            self.account.held += 1
            return applied, False
        self.account.held = 0
        measured = self._estimate()
        if self._law_state is None:
            self.setpoints.begin_at(np.where(self.limits.measured > 0, measured.tension_n, 0.0))
            self._law_state = self.law.engage(measured, self.setpoints.tension_n, applied)
        decision = self.law.ask(self._law_state, measured, self.setpoints.tension_n)
        unusable = check_torque(decision.torque_nm)
        if unusable:
            self._move_to(machines.torque_off(self.machine, tick.now_s, unusable[0].text), unusable)
            return self._torque(tick)
        # It is latched at the next tick: after a late wake-up that is less than a period away.
        interval_s = tick.due_s + self.limits.period_s - tick.now_s
        torque = limit_torque(self.limits, decision.torque_nm, applied, interval_s)
        self._law_state = self.law.commit(self._law_state, decision, torque)
        return torque, bool((torque != decision.torque_nm).any())

    def _estimate(self) -> Measured:
        # The measured values as they are; a law with an observer takes its place here.
        inputs = self.inputs
        return Measured(inputs.tension.value, inputs.speed.value, float(inputs.unwind_speed.value[0]))

    def _unload(self, applied: FloatArray) -> FloatArray:
        if self.machine.phase is not Phase.UNLOADING:
            return np.zeros(self.line.n)
        reach = self.line.moves.torque_off_rate_nm_per_s * self.limits.period_s
        return np.sign(applied) * np.maximum(np.abs(applied) - reach, 0.0)

    def _advance_setpoints(self) -> None:
        moves = self.line.moves
        running = self.machine.phase is Phase.RUNNING
        goal = self.setpoints.speed_target_m_per_s if running else 0.0
        stopping = self.machine.state is LoopState.STOP
        rate = moves.stop_rate_m_per_s2 if stopping else moves.speed_rate_m_per_s2
        self.setpoints.advance(moves, self.limits.period_s, goal, rate)

    def _write(self, torque: FloatArray) -> None:
        outputs, machine = self.outputs, self.machine
        request = REQUEST_OF.get(machine.phase, DriveRequest.OFF)
        outputs.torque_nm = torque
        outputs.drive_request[:] = request
        if machine.phase is Phase.ARMING:
            faulty = self.inputs.drive_state == DriveState.FAULT
            outputs.drive_request[:] = np.where(faulty, DriveRequest.RESET_FAULT, DriveRequest.READY)
        if machine.phase not in CONTROLLED:
            self.setpoints.speed_m_per_s = 0.0
        outputs.speed_request_m_per_s = self.setpoints.speed_m_per_s
        outputs.run = machine.phase in CONTROLLED
        for link in self.links:
            link.write(outputs)

    def _frame(self, tick: Tick, saturated: bool) -> None:
        inputs, account = self.inputs, self.account
        account.skipped += tick.skipped
        account.sequence += 1
        self._record(
            Frame(
                sequence=account.sequence,
                time_s=tick.due_s,
                lateness_s=tick.now_s - tick.due_s,
                cycle_s=self._clock() - tick.now_s,
                missed=account.skipped,
                unwind_speed_m_per_s=float(inputs.unwind_speed.value[0]),
                speed_setpoint_m_per_s=self.setpoints.speed_m_per_s,
                state=self.machine.state,
                saturated=saturated,
                held=account.held,
                tension_n=inputs.tension.value,
                tension_setpoint_n=self.setpoints.tension_n,
                speed_m_per_s=inputs.speed.value,
                torque_nm=self.outputs.torque_nm,
                torque_actual_nm=inputs.torque.value,
                tension_quality=inputs.tension.quality,
                drive_state=inputs.drive_state,
            )
        )
