"""The loop's state machine. Pure: what was observed in a period and the time go in, the next phase comes out.

    SILENT --arm--> ARMING --> READY --start--> WARNING --> ENABLING --> TENSIONING --> RUNNING
    RUNNING <--hold, start (where the web stands, after a warning)--> HOLDING
    SILENT, OFF --drill--> DRILLING --it is over, or stop--> OFF
    READY --prove--> WARNING --> ENABLING --> PROVING --it is over, stop, or a finding of safety/--> UNLOADING --> OFF

    WARNING                          --something speaks against the start--> READY
    ARMING, READY, WARNING, ENABLING --stop, or a finding of safety/--> OFF
    TENSIONING, RUNNING, HOLDING     --stop, or a finding of safety/--> SLOWING --> UNLOADING --> OFF --arm--> ARMING
    RUNNING, HOLDING, SLOWING        --the web has broken--> BRAKING --> UNLOADING --> OFF
    SLOWING                          --at speed tension control cannot go on--> BRAKING --> UNLOADING --> OFF

From OFF and SILENT only a person's `arm` leads on.
"""

from dataclasses import dataclass, replace

from gateway.core.states import STATE_OF, LoopState, Phase
from safety.actions import Action

ARMING_TIME_S = 2.0  #: a drive that is not ready by then refuses the arming
ENABLING_TIME_S = 2.0
STEADY_MOMENTS = 25.0  #: all tensions inside their band for so long: the web is tensioned
#: Only a command or a finding leads out of these.
LASTING = (Phase.SILENT, Phase.READY, Phase.RUNNING, Phase.HOLDING, Phase.OFF)


@dataclass(frozen=True, slots=True)
class Times:
    """How long a phase may take. From the line's file."""

    tensioning_s: float  #: without the time for web that is taken up
    stop_s: float
    steady_s: float = 0.5  #: for which all tensions must be inside their band
    warning_s: float = 0.0  #: that WARNING lasts
    braking_s: float = 0.0  #: 0: no drive may brake
    proving_s: float = 0.0


@dataclass(frozen=True, slots=True)
class Machine:
    phase: Phase = Phase.SILENT
    since_s: float = 0.0  #: when the phase began
    reason: str = ""  #: why the line stopped, or why an arming failed
    by_person: bool = False  #: a person stopped it
    proved: bool = False  #: it stopped because a proof of the wiring ended well: as whoever asked for it wanted
    steady_since_s: float | None = None  #: since when the tensions have been inside their band, while tensioning
    proves: bool = False  #: what was started is no production: the wiring is proved
    resumes: bool = False  #: while HOLDING: the line PLC warns, and then the web that stands is set in motion

    @property
    def state(self) -> LoopState:
        return STATE_OF[self.phase]


@dataclass(frozen=True, slots=True)
class Observation:
    """What a period showed, as far as the machine cares."""

    action: Action
    reason: str  #: the texts of the findings
    not_ready: str  #: while ARMING: the drives that may not be enabled, and what they say; empty when all may
    not_enabled: str  #: while ENABLING: the drives that do not follow yet
    tensioned: bool  #: set-points reached, every tension inside its band
    standstill: bool  #: request and measured unwinder speed are zero
    plc_answers: bool
    feedback: bool  #: every signal that the law needs is there
    torque_zero: bool  #: no torque is applied any more
    braked: bool = True  #: while BRAKING: nothing that may be braked turns any more
    not_startable: str = ""  #: while WARNING, or while it resumes: what speaks against the start now
    fast: bool = False  #: something turns, as far as is known, faster than the web is tensioned with
    taking_up_s: float = 0.0  #: while TENSIONING: what the web that was taken up so far may have taken
    drilled: str = ""  #: while DRILLING: that it is over, in words
    proved: str = ""  #: while PROVING: that it is over, in words
    proved_well: bool = False  #: and that nothing speaks against the wiring


def to_phase(
    machine: Machine, phase: Phase, now_s: float, reason: str | None = None, *, by_person: bool = False
) -> Machine:
    """In `phase` from now on. Without a `reason` it is the one of before, and whose it was."""
    proves = machine.proves and phase in (Phase.WARNING, Phase.ENABLING, Phase.PROVING)
    if reason is None:
        return Machine(phase, now_s, machine.reason, machine.by_person, machine.proved, proves=proves)
    return Machine(phase, now_s, reason, by_person, proves=proves)


def resume(machine: Machine, now_s: float) -> Machine:
    """The way to RUNNING of a web that stands: held until the warning is over."""
    return replace(to_phase(machine, Phase.HOLDING, now_s, ""), resumes=True)


def stop(machine: Machine, now_s: float, reason: str | None, *, by_person: bool = False) -> Machine:
    """The way to STOP from any phase: controlled where there is torque, at once where there is none."""
    match machine.phase:
        case Phase.TENSIONING | Phase.RUNNING | Phase.HOLDING:
            return to_phase(machine, Phase.SLOWING, now_s, reason, by_person=by_person)
        case Phase.ARMING | Phase.DRILLING | Phase.READY | Phase.WARNING | Phase.ENABLING:
            return to_phase(machine, Phase.OFF, now_s, reason, by_person=by_person)
        case Phase.PROVING:  # the line stands, and no law holds the web
            return to_phase(machine, Phase.UNLOADING, now_s, reason, by_person=by_person)
        case _:  # SILENT has nothing to stop; the phases of STOP are under way
            return machine


def torque_off(machine: Machine, now_s: float, reason: str | None) -> Machine:
    """The way to STOP when tension control must not go on: torque ramps to zero at once."""
    if machine.phase in (Phase.TENSIONING, Phase.RUNNING, Phase.HOLDING, Phase.SLOWING, Phase.BRAKING, Phase.PROVING):
        return to_phase(machine, Phase.UNLOADING, now_s, reason)
    return stop(machine, now_s, reason)


def brake(times: Times, machine: Machine, now_s: float, reason: str | None) -> Machine:
    """The way to STOP when the web has broken, is slack, or no tension control holds it at speed.

    Braked where something turns and a drive may brake it.
    """
    if machine.phase is Phase.BRAKING:
        return machine
    if times.braking_s > 0.0 and machine.phase in (Phase.RUNNING, Phase.HOLDING, Phase.SLOWING):
        return to_phase(machine, Phase.BRAKING, now_s, reason)
    return torque_off(machine, now_s, reason)


def advance(times: Times, machine: Machine, seen: Observation, now_s: float) -> Machine:
    """The machine after a period."""
    if seen.action >= Action.STOP:
        machine = _trip(times, machine, seen, now_s)
    elapsed = now_s - machine.since_s
    match machine.phase:
        case Phase.ARMING:
            return _arming(machine, seen, now_s, elapsed)
        case Phase.WARNING | Phase.HOLDING:
            return _warning(times, machine, seen, now_s, elapsed)
        case Phase.ENABLING:
            return _enabling(machine, seen, now_s, elapsed)
        case Phase.TENSIONING:
            return _tensioning(times, machine, seen, now_s, elapsed)
        case Phase.DRILLING | Phase.PROVING:
            return _proving(times, machine, seen, now_s, elapsed)
        case Phase.SLOWING:
            return _slowing(times, machine, seen, now_s, elapsed)
        case Phase.BRAKING:
            over = seen.braked or elapsed > times.braking_s
            return to_phase(machine, Phase.UNLOADING, now_s) if over else machine
        case Phase.UNLOADING:
            return to_phase(machine, Phase.OFF, now_s) if seen.torque_zero else machine
        case _:
            return machine


def _trip(times: Times, machine: Machine, seen: Observation, now_s: float) -> Machine:
    if seen.action is Action.TORQUE_OFF:
        return torque_off(machine, now_s, seen.reason)
    if seen.action is Action.BRAKE:
        return brake(times, machine, now_s, seen.reason)
    # A controlled stop that is under way goes on: its cause may well persist.
    return stop(machine, now_s, seen.reason)


def _arming(machine: Machine, seen: Observation, now_s: float, elapsed: float) -> Machine:
    if not seen.not_ready:
        return to_phase(machine, Phase.READY, now_s, "")
    if elapsed <= ARMING_TIME_S:
        return machine
    return to_phase(machine, Phase.OFF, now_s, f"drives that do not become ready: {seen.not_ready}")


def _warning(times: Times, machine: Machine, seen: Observation, now_s: float, elapsed: float) -> Machine:
    held = machine.phase is Phase.HOLDING
    if held and not machine.resumes:
        return machine
    if seen.not_startable:
        back = Phase.HOLDING if held else Phase.READY
        return to_phase(machine, back, now_s, f"not started: {seen.not_startable}")
    on = Phase.RUNNING if held else Phase.ENABLING
    return to_phase(machine, on, now_s) if elapsed >= times.warning_s else machine


def _enabling(machine: Machine, seen: Observation, now_s: float, elapsed: float) -> Machine:
    if not seen.not_enabled:
        return to_phase(machine, Phase.PROVING if machine.proves else Phase.TENSIONING, now_s)
    if elapsed <= ENABLING_TIME_S:
        return machine
    return to_phase(machine, Phase.OFF, now_s, f"drives that do not take over torque control: {seen.not_enabled}")


def _proving(times: Times, machine: Machine, seen: Observation, now_s: float, elapsed: float) -> Machine:
    if machine.phase is Phase.DRILLING:  # there is no torque
        return to_phase(machine, Phase.OFF, now_s, seen.drilled) if seen.drilled else machine
    over = f"the wiring could not be proved within {times.proving_s:.3g} s" if elapsed > times.proving_s else ""
    reason = seen.proved or over
    if not reason:
        return machine
    return replace(to_phase(machine, Phase.UNLOADING, now_s, reason), proved=bool(seen.proved) and seen.proved_well)


def _slowing(times: Times, machine: Machine, seen: Observation, now_s: float, elapsed: float) -> Machine:
    if seen.standstill:
        return to_phase(machine, Phase.UNLOADING, now_s)
    if seen.plc_answers and seen.feedback and elapsed <= times.stop_s:
        return machine
    # Tension control cannot go on. What is fast would coast, and whoever comes to look finds it turning.
    return brake(times, machine, now_s, None) if seen.fast else to_phase(machine, Phase.UNLOADING, now_s)


def _tensioning(times: Times, machine: Machine, seen: Observation, now_s: float, elapsed: float) -> Machine:
    if not seen.tensioned:
        machine = replace(machine, steady_since_s=None)
    elif machine.steady_since_s is None:
        machine = replace(machine, steady_since_s=now_s)
    if machine.steady_since_s is not None and now_s - machine.steady_since_s >= times.steady_s:
        return to_phase(machine, Phase.RUNNING, now_s)
    allowed_s = times.tensioning_s + seen.taking_up_s
    if elapsed > allowed_s:
        return stop(machine, now_s, f"the web could not be tensioned within {allowed_s:.3g} s: is it threaded?")
    return machine
