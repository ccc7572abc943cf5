"""One control period, on one screen: wait -> read -> estimate -> control -> envelope -> write -> record."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from drivers.port import Link
from gateway.control.law import Measured
from gateway.control.laws import make_law
from gateway.core.braking import longest_braking_s
from gateway.core.controller import Controller, config_hash
from gateway.core.deployment import Deployment, InService, Region, first_region
from gateway.core.line import Line
from gateway.core.line_scales import line_scales
from gateway.core.signals import BoolArray, DriveRequest, DriveState, FloatArray, Inputs, Outputs, Quality
from gateway.core.states import LoopState, Phase
from gateway.core.telemetry import Frame
from gateway.loop import machine as machines
from gateway.loop.admission import Admission, LawOf
from gateway.loop.brake import Brake
from gateway.loop.configurations import Configuration, Configurations
from gateway.loop.containment import Containment, Part
from gateway.loop.draw_trim import DrawTrim
from gateway.loop.drill import Drill
from gateway.loop.experiment import Experiments, Tell
from gateway.loop.guard import Guard
from gateway.loop.kept import Kept
from gateway.loop.machine import Machine, Observation, Times
from gateway.loop.mounting import Mounting
from gateway.loop.pacer import Tick
from gateway.loop.proving import ProvingStage
from gateway.loop.setpoints import Setpoints
from gateway.loop.standstill import STILL_MOMENTS, Standstill, standing
from gateway.loop.tensioning import TensioningStage
from gateway.loop.torque import LawFailed, TorquePath
from gateway.loop.watch import Watch
from gateway.loop.wiring import Wiring
from safety.actions import Action, Finding, found, most_severe
from safety.envelope import (
    NOTHING,
    Assessment,
    EnvelopeState,
    Supervision,
    check_inputs,
    check_timing,
    limit_torque,
)
from safety.limits import envelope_limits
from safety.recoverability import Shortfall

READ_SHARE = 0.5  #: of a period, for samples to arrive; the rest is for control and writing
_ENABLED = int(DriveState.ENABLED)
_BAD = int(Quality.BAD)
LONGEST_GAP = 2  #: periods without samples, until averages of forces begin anew
STILL_ON_PERIODS = 10  #: a drive that is told OFF and still says ENABLED is told to stop quickly

CONTROLLED = (Phase.TENSIONING, Phase.RUNNING, Phase.HOLDING, Phase.SLOWING)
SUPERVISED = (Phase.RUNNING, Phase.HOLDING)  #: by the monitor: the web is tensioned, and nothing stops it yet
TRANSPORTING = (*CONTROLLED, Phase.BRAKING)  #: the line PLC is asked for transport, if only to slow down
BEFORE_RUNNING = (Phase.ENABLING, Phase.TENSIONING, Phase.PROVING)  #: nobody who works at the line is pulled at
WITH_TORQUE = (*TRANSPORTING, Phase.UNLOADING, Phase.PROVING)
_PRODUCTION = Supervision(
    feedback=True, standstill=False, tension_floor=True, drives=DriveState.ENABLED, transport=True
)
SUPERVISION = {
    Phase.SILENT: NOTHING,
    Phase.ARMING: NOTHING,
    Phase.DRILLING: NOTHING,
    Phase.READY: Supervision(
        feedback=False, standstill=False, tension_floor=False, drives=DriveState.READY, transport=False
    ),
    Phase.WARNING: Supervision(
        feedback=False, standstill=False, tension_floor=False, drives=DriveState.READY, transport=False
    ),
    Phase.ENABLING: NOTHING,
    Phase.TENSIONING: Supervision(
        feedback=True, standstill=True, tension_floor=False, drives=DriveState.ENABLED, transport=False
    ),
    Phase.PROVING: Supervision(
        feedback=True, standstill=True, tension_floor=False, drives=DriveState.ENABLED, transport=False
    ),
    Phase.RUNNING: _PRODUCTION,
    Phase.HOLDING: _PRODUCTION,
    Phase.SLOWING: replace(_PRODUCTION, transport=False),
    Phase.BRAKING: Supervision(feedback=True, standstill=False, tension_floor=False, drives=None, transport=False),
    Phase.UNLOADING: NOTHING,
    Phase.OFF: NOTHING,
}

PERIOD, ENVELOPE = Part("the control period"), Part("the envelope")
DRIVES = Part("the comparison of the drives")
ESTIMATE = Part("the estimate of tensions without a load cell")
JUMPS, STUCK = Part("the check for jumps"), Part("the check for stuck signals")
CELLS = Part("the watch for load cells that are contradicted")
ZEROS = Part("the look at the zeros of load cells", of_configuration=False)
FIRST = Part("the guards of a first configuration")
LEASE, MONITOR, DOUBTS = Part("the lease"), Part("the monitor"), Part("the watch for doubts")
EXPERIMENT = Part("the experiment")
TRIAL = Part("the look at what a configuration has shown", of_configuration=False)
TENSIONING = Part("the watch for a missing web", of_configuration=False)
DRILL = Part("the drill of the watchdogs", of_configuration=False)
PROOF = Part("the proof of the wiring", of_configuration=False)
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
        wiring: Wiring | None = None,
    ) -> None:
        """`law_of` makes laws of configurations. `budget_period_s`: the period that what is admitted must fit (s);

        None: the line's own. `wiring`: whether it is proved; None: it is not.
        """
        scales = line_scales(line)
        self.line = line
        self.links = links
        self.limits = envelope_limits(line, watch.speed_steps_m_per_s)
        self.machine = Machine(since_s=clock())
        self.inputs = Inputs(line.n)
        self.mounting = Mounting(line, self.inputs)
        self.outputs = Outputs(line.n)
        self.setpoints = Setpoints(line.recipes[0], scales.moment_s)
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
        self.stage = TensioningStage(line, watch.speed_steps_m_per_s)
        self.trim = DrawTrim(line)
        self.proving = ProvingStage(line)
        self._proving_limits = replace(self.limits, measured=np.where(self.proving.limits.measured, 1.0, 0.0))
        self.drill = Drill(line, links)
        self.wiring = Wiring(line, {}) if wiring is None else wiring
        steady_s, warning_s = machines.STEADY_MOMENTS * scales.moment_s, line.stages.start_warning_s
        self._times = Times(
            line.limits.tensioning_time_s, line.moves.stop_time_s, steady_s, warning_s, longest_braking_s(line),
            self.proving.longest_s,
        )  # fmt: skip
        self.brake = Brake(line, self.limits)
        self._envelope = EnvelopeState()
        self._latched_s = clock()  #: when the drives latched the torque of the period before
        self._still_on = np.zeros(line.n, dtype=np.int64)  #: periods in a row ENABLED while told OFF
        self.standstill = Standstill(line, self.limits.standstill_m_per_s, scales.periods(STILL_MOMENTS))
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
        self.stage.sent(torque_nm)
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
        self._alarm(run(DRIVES, [], self.watch.drives.find_told, self.inputs))
        run(EXPERIMENT, None, self.experiments.look, self.inputs, torque_nm, self.account.held, tick.due_s)
        run(TRIAL, None, self.configurations.trial.step, self.machine, self.inputs, seen.usable)

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

    def confine_unconfirmed(self) -> None:
        """Before the first period: what no verdict has let through goes no further than a first configuration."""
        configurations, region = self.configurations, first_region(self.line)
        alone = configurations.running is configurations.good

        def confined(one: Configuration) -> Configuration:
            return one if one.confirmed else replace(one, region=one.region.no_further(region))

        configurations.good = confined(configurations.good)
        configurations.running = configurations.good if alone else confined(configurations.running)
        self.setpoints.speed_target_m_per_s = self._production_speed()

    def deploy(self, candidate: Configuration, deployment: Deployment, now_s: float) -> None:
        """`candidate` controls the line from the next period on, on probation. Between two periods only."""
        self.experiments.end("another controller takes over")
        self.configurations.take(candidate, deployment, now_s)

    def in_service(self) -> InService:
        """What controls the line, and whether its wiring is proved."""
        running = self.configurations.in_service(self.clock())
        return running.model_copy(update={"wiring": self.wiring.status()})

    def roll_back(self, reason: str) -> bool:
        """Back to the last known good controller, whoever asks for it; False where that runs already.

        An experiment was judged under the controller that is given up: it ends with it. Where the one that is gone back
        to must not control the line, torque goes off in order.
        """
        if not self.configurations.roll_back(reason):
            return False
        self.experiments.end(f"the controller was taken back: {reason}")
        if (unfit := self.configurations.running.unfit) and self.machine.phase in CONTROLLED:
            self._move_to(self._given_up(self.clock(), f"{reason}; {unfit}"), [])
        return True

    def tell(self, kind: str, text: str, **data: object) -> None:
        """An event, to whoever listens."""
        if (tell := self._tell) is not None:
            self.containment.run(EVENTS, None, tell, kind, text, **data)

    def foreseen(self, setpoint_n: FloatArray, unwind_speed_m_per_s: float | None = None) -> Shortfall | None:
        """What would come of these set-points (n,), or this speed, at once, as the accepted model has it; or None.

        Between two periods only.
        """
        measured = self._estimate()
        if unwind_speed_m_per_s is not None:
            measured = replace(measured, unwind_speed_m_per_s=unwind_speed_m_per_s)
        return self.guard.foresees(self.configurations, self.torque_path, measured, setpoint_n)

    def any_enabled(self) -> bool:
        """Whether a drive says that it is enabled."""
        return _ENABLED in self.inputs.drive_state.tolist()

    def _against_start(self) -> list[Finding]:
        """What on the line speaks against a start that only waits for its warning to end."""
        local = [found("line-local", Action.NONE)] if self.inputs.plc.local else []
        if self.machine.resumes:  # its rollers are controlled
            return local
        turning = self.standstill.turning(self.inputs, self.clock())
        below_zero = [] if self.machine.proves else self.watch.below_zero(self.inputs)  # a proof names them
        against = [*turning, *below_zero]
        return local + [found(data.code, Action.NONE, **data.parameters) for data in against]

    def change(self, machine: Machine) -> None:
        """Take over what a command decided. Between two periods only."""
        if machine.phase in (Phase.ARMING, Phase.DRILLING):
            self.containment.begin_anew()
            self.torque_path.lost[:] = False
            self.proving.forget()
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
                await link.collect(self.mounting.raw, deadline_s)
            except Exception as error:  # a link promises not to: what it has left is not to be relied on
                self.containment.fail(_part(link), error, Action.TORQUE_OFF)
        self.mounting.take()
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
        unlike = run(DRIVES, [], self._compare_drives, supervision)
        seen = run(ENVELOPE, None, self._check_envelope, tick, supervision)
        if seen is None:
            return Assessment(unlike, usable=False, feedback_lost=True, plc_lost=True)
        seen.findings.extend(unlike)
        below_zero = run(ZEROS, [], self.watch.find_below_zero, self.inputs)
        if phase in BEFORE_RUNNING and self.inputs.plc.local:
            seen.findings.append(found("line-local", Action.STOP))
        if phase not in CONTROLLED or max(self.account.held, tick.skipped) > LONGEST_GAP:
            self.watch.forget_balance()
        if supervision.feedback:
            seen.findings.extend(jumps)
            if seen.usable and phase is not Phase.PROVING:
                seen.findings.extend(run(STUCK, [], self.watch.find_stuck, self.inputs))
                floor, acted_nm = supervision.tension_floor, self.outputs.torque_nm
                set_n, find = self.setpoints.tension_n, self.watch.find_estimated
                seen.findings.extend(run(ESTIMATE, [], find, self.inputs, acted_nm, set_n, floor=floor))
                seen.findings.extend(below_zero)
                if phase in CONTROLLED:
                    seen.findings.extend(run(CELLS, [], self._find_contradicted, acted_nm))
                if phase is Phase.TENSIONING:
                    target_n = self.setpoints.tension_target_n
                    seen.findings.extend(run(TENSIONING, [], self.stage.watch, self.inputs, target_n))
        return seen

    def _find_contradicted(self, applied_nm: FloatArray) -> list[Finding]:
        """Their proof holds no more: only `prove` leads back."""
        found = self.watch.find_contradicted(self.inputs, applied_nm, doubted=self.torque_path.any_lost())
        if found:
            self.wiring.contradict(found)
        return found

    def _reject_jumps(self, supervision: Supervision) -> list[Finding]:
        # A web that whips moves its rollers by more than any torque explains; so does a drive that turns backwards.
        if self.machine.phase in (Phase.BRAKING, Phase.PROVING):
            self.watch.forget_speeds()
            self.watch.believe_again()
            return []
        jumps = self.watch.reject_jumps(self.inputs, self.outputs.torque_nm)
        if not supervision.feedback:
            self.watch.believe_again()
            return jumps
        asked_m_per_s, asked_nm = self.outputs.speed_request_m_per_s, self.outputs.torque_nm
        found = self.watch.reject_impossible(self.inputs, asked_m_per_s, asked_nm)
        self._alarm([finding for finding in found if finding.action is Action.NONE])
        return jumps + [finding for finding in found if finding.action is not Action.NONE]

    def _compare_drives(self, supervision: Supervision) -> list[Finding]:
        """What drives do otherwise than they were asked: they count as lost, as one that has left by itself."""
        drives, path = self.watch.drives, self.torque_path
        braking = self.machine.phase is Phase.BRAKING
        if supervision.drives is None and not braking:
            drives.rest()
            return []
        unlike = drives.compare(self.inputs, self.outputs.torque_nm, path.lost)
        path.held, path.held_nm = drives.suspected, drives.held_nm
        if braking:
            path.lost |= drives.powerless(self.inputs)
            self._alarm(unlike)  # they stop nothing any more: they are told here
        elif unlike:
            path.lost |= drives.blamed
        return unlike

    def _check_envelope(self, tick: Tick, supervision: Supervision) -> Assessment:
        late, self._envelope = check_timing(self.limits, self._envelope, tick.skipped)
        # While the wiring is proved a load cell that only shows must be there as any other.
        limits = self._proving_limits if self.machine.phase is Phase.PROVING else self.limits
        seen, self._envelope = check_inputs(limits, self._envelope, self.inputs, supervision)
        if self.machine.phase is Phase.SILENT:
            seen.findings.clear()
        elif self.machine.phase is not Phase.ARMING:
            seen.findings.extend(late)
        return seen

    def _step_machine(self, seen: Assessment, now_s: float) -> None:
        phase, drives, resumes = self.machine.phase, self.watch.drives, self.machine.resumes
        if phase in machines.LASTING and not seen.findings and not resumes:
            return
        if phase is Phase.DRILLING:
            not_ready = drives.against(self.inputs, DriveState.READY)
            self.containment.run(DRILL, None, self.drill.step, self.inputs, not_ready, now_s)
        against = self._against_start() if phase is Phase.WARNING or resumes else []
        observation = Observation(
            action=most_severe(seen.findings),
            reason="; ".join(finding.text for finding in seen.findings if finding.action >= Action.STOP),
            not_ready=drives.against(self.inputs, DriveState.READY) if phase is Phase.ARMING else "",
            not_enabled=drives.against(self.inputs, DriveState.ENABLED) if phase is Phase.ENABLING else "",
            tensioned=not self.stage.taking_up
            and self.setpoints.followed_by(self.inputs.tension.value, self.limits.measured),
            standstill=self.setpoints.speed_m_per_s == 0.0 and standing(self.inputs, self.limits.standstill_m_per_s),
            fast=self._is_fast(),
            plc_answers=not seen.plc_lost,
            feedback=not seen.feedback_lost,
            torque_zero=not self.outputs.torque_nm.any(),
            braked=self.brake.over,
            not_startable="; ".join(finding.text for finding in against),
            taking_up_s=self.stage.taking_up_s() if phase is Phase.TENSIONING else 0.0,
            drilled=self.drill.ending() if phase is Phase.DRILLING else "",
            proved=self.proving.ending() if phase is Phase.PROVING else "",
            proved_well=not self.proving.findings(),
        )
        unfit = drives.standing if phase in (Phase.ARMING, Phase.ENABLING) else []
        if phase is Phase.PROVING:
            unfit = self.proving.findings()
        if phase is Phase.DRILLING:
            unfit = self.drill.findings
        self._move_to(machines.advance(self._times, self.machine, observation, now_s), seen.findings + unfit + against)
        if resumes and self.machine.phase is Phase.HOLDING:
            self._alarm(against)  # why it stays held: its phase does not change

    def _move_to(self, machine: Machine, findings: list[Finding]) -> None:
        before, self.machine = self.machine, machine
        if before.phase is machine.phase:
            return
        if before.phase is Phase.PROVING and self.proving.over:
            self.tell("proved", self.proving.ending(), **self.proving.as_data())
        if machine.phase is Phase.TENSIONING:
            self.stage.begin(self.inputs)
            self.setpoints.begin_at(np.zeros(self.line.n))
        if machine.phase is Phase.PROVING:
            self.proving.begin()
        if machine.phase is Phase.DRILLING:
            self.drill.begin(self.clock())
        if before.phase is Phase.DRILLING:
            self.drill.end()
        if machine.phase is not Phase.RUNNING:
            self.experiments.end(f"the line left RUN: {machine.reason or machine.state.name}")
        if machine.state is LoopState.STOP and self.configurations.probation is not None:
            self.roll_back(f"the line stopped: {machine.reason}")
        if machine.phase is Phase.OFF:  # a speed from before the stop is not taken up again
            self.setpoints.speed_target_m_per_s = self._production_speed()
        self.containment.run(EVENTS, None, self._announce, before, machine, findings)

    def _production_speed(self) -> float:
        """The recipe's, or as far as an unconfirmed configuration goes, if that is less."""
        own, running = self.setpoints.recipe.speed_m_per_s, self.configurations.running
        most = running.region.speed_max_m_per_s
        return own if running.confirmed or most is None else min(own, most)

    def _torque(self, seen: Assessment, tick: Tick) -> tuple[FloatArray, bool]:
        """The torque (n,) to apply in this period, and whether a limit cut it."""
        applied_nm = self.outputs.torque_nm
        staged = self.stage.applies(self.machine.phase)
        if self.machine.phase not in CONTROLLED:
            self.torque_path.disengage()
            self.guard.off()
            self.watch.off()
            if self.trim.any:
                self.trim.off()
            self.account.held = 0
            if self.machine.phase is Phase.BRAKING:
                return self._braked(applied_nm, signals_lost=seen.feedback_lost), False
            if self.machine.phase is Phase.PROVING:
                return self._proved(seen, applied_nm), False
            unloading = self.machine.phase is Phase.UNLOADING
            return self.torque_path.unload(applied_nm) if unloading else np.zeros(self.line.n), False
        if not seen.usable:
            self.account.held += 1
            return np.where(self.torque_path.lost, 0.0, applied_nm), False
        self.account.held = 0
        # It is latched at the next tick: after a late wake-up that is less than a period from the last.
        interval_s = tick.due_s + self.limits.period_s - self._latched_s
        if staged and self.stage.taking_up:
            return self._take_up(applied_nm, interval_s), False
        self._advance_setpoints()
        before, path = self.torque_path.fallback, self.torque_path
        try:
            governed = self._governed(applied_nm, interval_s, tick.now_s)
            if path.fallback and not before:
                self._alarm([found("law-fallback", Action.NONE, because=path.fallback)])
            return governed
        except LawFailed as failed:
            self._move_to(self._given_up(tick.now_s, failed.finding.text), [failed.finding])
            return self._torque(seen, tick)

    def _braked(self, applied_nm: FloatArray, *, signals_lost: bool) -> FloatArray:
        """The torque (n,) that brakes what turns; on the way to zero where that would hurt.

        `signals_lost`: what is missing has been missing for too long.
        """
        self.torque_path.lost |= self.inputs.drive_state != _ENABLED
        lost = self.torque_path.lost
        found = self.brake.step(self.inputs, self.setpoints, lost, applied_nm, signals_lost=signals_lost)
        self._alarm(found.findings)
        return self.torque_path.braked(found.torque_nm, found.released, applied_nm)

    def _proved(self, seen: Assessment, applied_nm: FloatArray) -> FloatArray:
        """The torque (n,) of a period in which the wiring is proved; none where that fails."""
        if not seen.usable:
            return applied_nm
        none_nm = np.zeros(self.line.n)
        asked_nm = self.containment.run(PROOF, none_nm, self.proving.step, self.inputs)
        for pull in self.proving.take_news():
            way = "forwards" if pull.direction > 0 else "backwards"
            text = f"drive {pull.i + 1} pulls {way}: {1000.0 * pull.reach_m:.0f} mm and {pull.longest_s:.0f} s at most"
            self.tell("proving", text, roller=pull.i + 1, rollers=self.line.n, direction=pull.direction)
        return limit_torque(
            self.limits, np.where(self.torque_path.lost, 0.0, asked_nm), applied_nm, self.limits.period_s
        )

    def _governed(self, applied_nm: FloatArray, interval_s: float, now_s: float) -> tuple[FloatArray, bool]:
        """The torque (n,) and whether a limit cut it. What fails on probation, or must not go on, gives way at once.

        Raises LawFailed.
        """
        configurations, path = self.configurations, self.torque_path
        self._trim_draws()
        measured = self._estimate()
        staged = self.stage.applies(self.machine.phase)
        limit, mean_nm = (self._limit_in_stage, self.stage.mean_nm()) if staged else (None, None)

        def controlled() -> tuple[FloatArray, bool]:
            return path.control(measured, self.setpoints, applied_nm, interval_s, limit, mean_nm)

        try:
            found = controlled()
        except LawFailed as failed:
            if not self.roll_back(failed.finding.text):
                raise
            return self._after_roll_back(controlled)
        guard, setpoint_n = self.guard, self.setpoints.tension_n
        if not configurations.running.confirmed:
            against = self.containment.run(
                FIRST, [], guard.against_first, configurations.running, path, measured, setpoint_n
            )
            if against:
                return self._taken_off(against, now_s)
        if self.machine.phase not in SUPERVISED:
            return found
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

    def _is_fast(self) -> bool:
        """Whether anything that may be braked turns, as far as is known, faster than the web is tensioned with.

        Without the envelope nobody would see an emergency stop: nothing is braked then.
        """
        if ENVELOPE.name in self.containment.failed:
            return False
        speeds = (*self.inputs.unwind_speed.value.tolist(), *self.inputs.speed.value.tolist())
        return any(abs(speed) > self.limits.tensioning_speed_m_per_s for speed in speeds)

    def _given_up(self, now_s: float, reason: str) -> Machine:
        """The way to STOP without a law: what is fast is braked, for that needs none."""
        if self._is_fast():
            return machines.brake(self._times, self.machine, now_s, reason)
        return machines.torque_off(self.machine, now_s, reason)

    def _taken_off(self, against: list[Finding], now_s: float) -> tuple[FloatArray, bool]:
        """A law that drives the web apart, with nothing to go back to: off at once, on no ramp; a fast line is braked.

        Where rollers coast fast, what they have would pull the web against an unwinder that stops.
        """
        reason, applied_nm = "; ".join(finding.text for finding in against), self.outputs.torque_nm
        inputs, slow_m_per_s = self.inputs, self.limits.tensioning_speed_m_per_s
        slow = abs(inputs.unwind_speed.value.item(0)) <= slow_m_per_s
        way = machines.torque_off(self.machine, now_s, reason)
        self._move_to(way if slow else machines.brake(self._times, self.machine, now_s, reason), against)
        if self.machine.phase is Phase.BRAKING:
            return self._braked(applied_nm, signals_lost=False), False
        self.torque_path.lost[:] = True
        return np.zeros(self.line.n), False

    def _take_up(self, applied_nm: FloatArray, interval_s: float) -> FloatArray:
        """The torque (n,) of a period in which the law is not engaged yet: slack is taken up."""
        stage, path, lost = self.stage, self.torque_path, self.torque_path.lost
        stopping = self.machine.phase is not Phase.TENSIONING
        interval_n, target_n = self.containment.run(ESTIMATE, None, self._estimated_n), self.setpoints.tension_target_n
        least_n = np.zeros(self.line.n) if interval_n is None else interval_n[0]
        asked_nm = stage.take_up(self.inputs, target_n, least_n, path.hold, stopping=stopping)
        return limit_torque(self.limits, np.where(lost, 0.0, asked_nm), np.where(lost, 0.0, applied_nm), interval_s)

    def _limit_in_stage(self, asked_nm: FloatArray) -> FloatArray:
        return self.stage.limit(asked_nm, self.inputs, self.setpoints.tension_n)

    def _after_roll_back(self, controlled: Callable[[], tuple[FloatArray, bool]]) -> tuple[FloatArray, bool]:
        """What the last known good asks for; on the way to zero where it must not control the line."""
        if self.machine.phase not in CONTROLLED:
            return self.torque_path.unload(self.outputs.torque_nm), False
        return controlled()

    def _estimate(self) -> Measured:
        # The measured values as they are: a law that wants an observer brings its own.
        inputs, tension_n = self.inputs, self.inputs.tension.value
        if silent := self.watch.silent:  # what such a load cell shows is no error to act on
            tension_n = tension_n.copy()
            tension_n[silent] = self.setpoints.tension_n[silent]
        speed = inputs.speed.value - self.trim.added_m_per_s if self.trim.any else inputs.speed.value
        return Measured(tension_n, speed, float(inputs.unwind_speed.value[0]))

    def _estimated_n(self) -> FloatArray | None:
        """The least and the most (2, n) that tensions may be; None: nothing of it can be relied on."""
        doubted = self.torque_path.any_lost() or DRIVES.name in self.containment.failed
        return self.watch.estimated_n(doubted=doubted)

    def _trim_draws(self) -> None:
        """What rollers of draw-controlled spans turn faster by to hold the tension that no load cell sees."""
        if not self.trim.any:
            return
        self.containment.run(ESTIMATE, None, self._step_trim)
        if ESTIMATE.name in self.containment.failed:
            self.trim.off()

    def _step_trim(self) -> None:
        path, interval_n = self.torque_path, self._estimated_n()
        if path.state is None and interval_n is not None and not path.unmeasured_n.any():
            path.unmeasured_n = self.trim.begun_n(interval_n)
        stands = self.setpoints.speed_m_per_s <= self.limits.standstill_m_per_s
        self.trim.step(self.setpoints.tension_n, interval_n, stands=stands)

    def _advance_setpoints(self) -> None:
        moves = self._shaped_moves if self.configurations.shaped else self.line.moves
        phase = self.machine.phase
        if phase is Phase.TENSIONING:
            if self.stage.waits():
                return
            moves = self.stage.moves(moves, self.setpoints.tension_n, self.setpoints.tension_target_n)
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
        if phase not in TRANSPORTING:
            self.setpoints.begin_at_speed(0.0)
            self.brake.end()
        outputs.speed_request_m_per_s = self.setpoints.speed_m_per_s
        drills = phase is Phase.DRILLING
        outputs.run = phase in TRANSPORTING or (drills and self.drill.runs)
        outputs.warning = drills or self.machine.resumes or phase in (Phase.WARNING, Phase.ENABLING)
        given = self.mounting.given(outputs)
        for link in self._usable_links():
            try:
                link.write(given)
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
        if phase is Phase.ARMING or (phase is Phase.DRILLING and self.drill.resets):
            return np.where(states == DriveState.FAULT, int(DriveRequest.RESET_FAULT), int(DriveRequest.READY))
        if phase in (Phase.READY, Phase.WARNING, Phase.DRILLING):
            return int(DriveRequest.READY)
        return np.where(self._stays_on(), int(DriveRequest.QUICK_STOP), off)

    def _alarm(self, findings: list[Finding]) -> None:
        if findings:
            self.containment.run(EVENTS, None, self._announce, self.machine, self.machine, findings)

    def _stays_on(self) -> BoolArray:
        """Drives (n,) that do not obey OFF. Said once, when it begins."""
        on = self.inputs.drive_state == _ENABLED
        self._still_on = np.where(on, self._still_on + 1, 0)
        for i in np.flatnonzero(self._still_on == STILL_ON_PERIODS):
            self._alarm([found("drive-stays-on", Action.TORQUE_OFF, roller=int(i) + 1)])
        return self._still_on >= STILL_ON_PERIODS

    def _frame(self, tick: Tick, saturated: bool, cycle_s: float) -> None:
        inputs, account = self.inputs, self.account
        quality = inputs.tension.quality
        if self.watch.any_stuck():
            quality = np.where(self.watch.stuck, _BAD, quality).astype(np.int8)
        actual_nm = inputs.torque.value
        if self.watch.drives.any_uncompared():  # what it said last is no torque that it gives
            actual_nm = np.where(self.watch.drives.uncompared, np.nan, actual_nm)
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
                by_person=machine.state is LoopState.STOP and (machine.by_person or machine.proved),
                standstill=self.standstill.look(inputs, asked),
                saturated=saturated,
                held=account.held,
                doubts=int(self.watch.doubts),
                tension_n=inputs.tension.value,
                tension_setpoint_n=self.setpoints.tension_n,
                speed_m_per_s=inputs.speed.value,
                torque_nm=self.outputs.torque_nm,
                torque_actual_nm=actual_nm,
                tension_quality=quality,
                drive_state=inputs.drive_state,
            )
        )


def _part(link: Link) -> Part:
    return Part(f"the link {link.name}", of_configuration=False)
