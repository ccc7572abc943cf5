"""One control period, on one screen: wait -> read -> estimate -> control -> envelope -> write -> record."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from drivers.port import Link
from gateway.control.law import Measured
from gateway.control.laws import make_law
from gateway.core.controller import Controller, config_hash
from gateway.core.deployment import Deployment, Region
from gateway.core.line import Line
from gateway.core.signals import BoolArray, DriveRequest, DriveState, FloatArray, Inputs, Outputs, Quality
from gateway.core.states import OPERATORS_STOP, LoopState, Phase
from gateway.core.telemetry import Frame
from gateway.loop import machine as machines
from gateway.loop.admission import Admission, LawOf
from gateway.loop.configurations import Configuration, Configurations
from gateway.loop.containment import Containment, Part
from gateway.loop.experiment import Experiments, Tell
from gateway.loop.guard import Guard
from gateway.loop.kept import Kept
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

PERIOD, ENVELOPE = Part("the control period"), Part("the envelope")
JUMPS, STUCK = Part("the check for jumps"), Part("the check for stuck signals")
LEASE, MONITOR, DOUBTS = Part("the lease"), Part("the monitor"), Part("the watch for doubts")
EXPERIMENT = Part("the experiment")
TELEMETRY, EVENTS = Part("telemetry", of_configuration=False), Part("events", of_configuration=False)


@dataclass(slots=True)
class Account:
    """What happened so far."""

    sequence: int = 0
    skipped: int = 0  #: periods
    held: int = 0  #: periods in a row with held outputs
    ran: int = 0  #: periods in which the line ran


class Cycle:
    """The loop's whole state between two periods.

    What changes in it, a phase, the controller in service, an experiment, changes through the methods here, so that
    everything that depends on it hears of it: `change`, `deploy`, `roll_back`.
    """

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
        budget_period_s: float | None = None,
    ) -> None:
        """`law_of` makes laws of configurations. `budget_period_s`: the period that what is admitted must fit (s);

        None: the line's own.
        """
        self.line = line
        self.links = links
        self.limits = envelope_limits(line)
        self.machine = Machine(since_s=clock())
        self.inputs = Inputs(line.n)
        self.outputs = Outputs(line.n)
        self.setpoints = Setpoints(line.recipes[0])
        self.containment = Containment()
        self._tell = tell
        period_s = line.control.period_s if budget_period_s is None else budget_period_s
        self.admission = Admission(line, law_of, period_s)
        first = Configuration(config, config_hash(config), law_of(config), Region())
        self.torque_path = TorquePath(first.law, self.limits, line)
        self.configurations = Configurations(line, first, self.torque_path, self.setpoints, self.tell)
        self.guard = Guard(line)
        self.account = Account()
        self.watch = watch
        self.clock = clock
        self.experiments = Experiments(self.setpoints, self.limits, clock, self.tell, simulated=simulated)
        self._record = record
        self._announce = announce
        self._times = Times(line.limits.tensioning_time_s, line.moves.stop_time_s)
        self._envelope = EnvelopeState()
        self._latched_s = clock()  #: when the drives latched the torque of the period before
        self._still_on = np.zeros(line.n, dtype=np.int64)  #: periods in a row ENABLED while told OFF
        self._standstill = Standstill(line.control.period_s)
        self._shaped_moves = line.moves.model_copy(update={"shape": "minimum-jerk"})

    async def period(self, tick: Tick) -> None:
        """Read, decide, write. Raises only what fails second (`containment`)."""
        try:
            await self._run(tick)
        except Exception as error:  # of what is not a part of its own: there is no control to rely on
            self.containment.fail(PERIOD, error, Action.TORQUE_OFF)
            self._heed_failures(tick.now_s)
            self._write(self.torque_path.unload(self.outputs.torque_nm))

    async def _run(self, tick: Tick) -> None:
        await self._read(tick)
        seen = self._check(tick)
        self._step_machine(seen, tick.now_s)
        self._heed_failures(tick.now_s)
        before_nm = self.outputs.torque_nm
        self._end_what_lapsed(tick.now_s)
        torque_nm, saturated = self._torque(seen, tick)
        self._write(torque_nm)
        self.guard.sent(torque_nm)
        cycle_s = self.clock() - tick.now_s
        self._watch_after(seen, tick, before_nm, torque_nm, saturated)
        self.containment.run(TELEMETRY, None, self._frame, tick, saturated, cycle_s)
        self._heed_failures(tick.now_s)

    def _watch_after(
        self, seen: Assessment, tick: Tick, before_nm: FloatArray, torque_nm: FloatArray, saturated: bool
    ) -> None:
        """What only blocks proposals or ends an experiment: after the commands are out."""
        run = self.containment.run
        if self.machine.phase in CONTROLLED and seen.usable:
            controlled = self.watch.controlled
            self._alarm(run(DOUBTS, [], controlled, self.inputs, self.setpoints, before_nm, saturated))
        run(EXPERIMENT, None, self.experiments.look, self.inputs, torque_nm, self.account.held, tick.due_s)

    def _end_what_lapsed(self, now_s: float) -> None:
        configurations = self.configurations
        # Where it cannot be told whether the lease has ended, it has: a silent line is not stopped, so not taken back.
        why = self.containment.run(LEASE, "whether its lease has ended cannot be told", configurations.lapsed, now_s)
        if why and configurations.probation is not None:
            self.roll_back(why)
        configurations.settle_moves()

    def _heed_failures(self, now_s: float) -> None:
        """What has failed since is told, and stops the line."""
        for finding in self.containment.take_findings():
            way = machines.torque_off if finding.action is Action.TORQUE_OFF else machines.stop
            before = self.machine.phase
            self._move_to(way(self.machine, now_s, finding.text), [finding])
            if self.machine.phase is before:
                self._alarm([finding])

    def measure_given(self) -> str:
        """Before the first period: measure what the loop was given. Returns why it must not control the line, if so."""
        configurations = self.configurations
        configurations.running = configurations.good = self.admission.measured(configurations.running)
        return configurations.running.unfit

    def resume(self, kept: Kept, say: Callable[[str], None]) -> None:
        """Before the first period: what a loop before has kept. Raises ControllerRefused, with nothing changed."""
        running, good = self.admission.resumed(kept, say)
        self.configurations.resume(running, good, kept.epoch)

    def go_no_further(self, kept: Kept) -> None:
        """Before the first period: what the loop was given takes the place of what was kept, within its limits."""
        configurations = self.configurations
        given = configurations.running
        configurations.running = configurations.good = replace(given, region=given.region.no_further(kept.region))
        configurations.epoch = kept.epoch  # epochs go on

    def deploy(self, candidate: Configuration, deployment: Deployment, now_s: float) -> None:
        """`candidate` controls the line from the next period on, on probation. Between two periods only."""
        self.experiments.end("another controller takes over")
        self.configurations.take(candidate, deployment, now_s)

    def roll_back(self, reason: str) -> bool:
        """Back to the last known good controller, whoever asks for it; False where that runs already.

        An experiment was judged under the controller that is given up: it ends with it. Where the one that is gone back
        to must not control the line, torque goes off in order.
        """
        if not self.configurations.roll_back(reason):
            return False
        self.experiments.end(f"the controller was taken back: {reason}")
        if (unfit := self.configurations.running.unfit) and self.machine.phase in CONTROLLED:
            self._move_to(machines.torque_off(self.machine, self.clock(), f"{reason}; {unfit}"), [])
        return True

    def tell(self, kind: str, text: str, **data: object) -> None:
        """An event, to whoever listens."""
        if (tell := self._tell) is not None:
            self.containment.run(EVENTS, None, tell, kind, text, **data)

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
            self.containment.begin_anew()
            self.torque_path.lost[:] = False
            self._alarm(self.watch.armed())
        self._move_to(machine, [])

    async def _read(self, tick: Tick) -> None:
        links = self._usable_links()
        for link in links:
            try:
                link.trigger(tick.now_s)
            except Exception as error:
                self.containment.fail(_part(link), error, Action.TORQUE_OFF)
        self._latched_s = self.clock()  # later than it was: it may take time to be sent on a busy computer
        deadline_s = tick.now_s + READ_SHARE * self.limits.period_s
        for link in links:
            try:
                await link.collect(self.inputs, deadline_s)
            except Exception as error:  # a link promises not to: what it has left is not to be relied on
                self.containment.fail(_part(link), error, Action.TORQUE_OFF)
        if self.containment.failed:
            self._miss_failed_links()

    def _usable_links(self) -> list[Link]:
        failed = self.containment.failed
        return [link for link in self.links if _part(link).name not in failed] if failed else self.links

    def _miss_failed_links(self) -> None:
        """Whose samples a link that failed would have brought is not known here: none is relied on."""
        if len(self._usable_links()) < len(self.links):
            for channel in (self.inputs.tension, self.inputs.speed, self.inputs.torque, self.inputs.unwind_speed):
                for i in range(len(channel.value)):
                    channel.miss(i)

    def _check(self, tick: Tick) -> Assessment:
        phase, run = self.machine.phase, self.containment.run
        supervision = SUPERVISION[phase]
        jumps = run(JUMPS, [], self._reject_jumps, supervision)
        if phase in WITH_TORQUE:
            self.torque_path.lost |= self.inputs.drive_state != _ENABLED
        seen = run(ENVELOPE, None, self._check_envelope, tick, supervision)
        if seen is None:
            return Assessment([], usable=False, feedback_lost=True, plc_lost=True)
        if supervision.feedback:
            seen.findings.extend(jumps)
            if seen.usable:
                seen.findings.extend(run(STUCK, [], self.watch.find_stuck, self.inputs))
        return seen

    def _reject_jumps(self, supervision: Supervision) -> list[Finding]:
        jumps = self.watch.reject_jumps(self.inputs, self.outputs.torque_nm)
        if supervision.feedback:
            self.watch.reject_unwinder(self.inputs, self.outputs.speed_request_m_per_s)
        return jumps

    def _check_envelope(self, tick: Tick, supervision: Supervision) -> Assessment:
        late, self._envelope = check_timing(self.limits, self._envelope, tick.skipped)
        seen, self._envelope = check_inputs(self.limits, self._envelope, self.inputs, supervision)
        if self.machine.phase is Phase.SILENT:
            seen.findings.clear()
        elif self.machine.phase is not Phase.ARMING:
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
            self.roll_back(f"the line stopped: {machine.reason}")
        if machine.phase is Phase.OFF:  # a speed from before the stop is not taken up again
            self.setpoints.speed_target_m_per_s = self.setpoints.recipe.speed_m_per_s
        self.containment.run(EVENTS, None, self._announce, before, machine, findings)

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
        """The torque (n,) and whether a limit cut it. What fails on probation, or must not go on, gives way at once.

        Raises LawFailed.
        """
        configurations, path = self.configurations, self.torque_path
        measured = self._estimate()

        def controlled() -> tuple[FloatArray, bool]:
            return path.control(measured, self.setpoints, applied_nm, interval_s)

        try:
            found = controlled()
        except LawFailed as failed:
            if not self.roll_back(f"the law failed: {failed.finding.text}"):
                raise
            return self._after_roll_back(controlled)
        if self.machine.phase not in SUPERVISED:
            return found
        guard, setpoint_n = self.guard, self.setpoints.tension_n
        against = self.containment.run(MONITOR, [], guard.against, configurations, path, measured, setpoint_n, found)
        self._heed_failures(now_s)
        if not against:
            return found
        reason = "; ".join(finding.text for finding in against)
        if self.roll_back(reason):
            self._alarm(against)
            return self._after_roll_back(controlled)
        self._move_to(machines.stop(self.machine, now_s, reason), against)
        return found

    def _after_roll_back(self, controlled: Callable[[], tuple[FloatArray, bool]]) -> tuple[FloatArray, bool]:
        """What the last known good asks for; on the way to zero where it must not control the line."""
        if self.machine.phase not in CONTROLLED:
            return self.torque_path.unload(self.outputs.torque_nm), False
        return controlled()

    def _estimate(self) -> Measured:
        # The measured values as they are: a law that wants an observer brings its own.
        inputs = self.inputs
        return Measured(inputs.tension.value, inputs.speed.value, float(inputs.unwind_speed.value[0]))

    def _advance_setpoints(self) -> None:
        moves = self._shaped_moves if self.configurations.shaped else self.line.moves
        phase = self.machine.phase
        goal = self.setpoints.speed_target_m_per_s if phase is Phase.RUNNING else 0.0
        if (run := self.experiments.run) is not None:
            goal = self.containment.run(EXPERIMENT, 0.0, run.advance, self.setpoints)
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
        for link in self._usable_links():
            try:
                link.write(outputs)
            except Exception as error:
                self.containment.fail(_part(link), error, Action.TORQUE_OFF)

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
            self.containment.run(EVENTS, None, self._announce, self.machine, self.machine, findings)

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
        account.ran += self.machine.phase is Phase.RUNNING
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


def _part(link: Link) -> Part:
    return Part(f"the link {link.name}", of_configuration=False)
