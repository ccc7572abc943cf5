"""The loop's state machine. Pure: what was observed in a period and the time go in, the next phase comes out.

    SILENT --arm--> ARMING --> READY --start--> ENABLING --> TENSIONING --> RUNNING <--hold, start--> HOLDING

    ARMING, READY, ENABLING       --stop, or a finding of safety/--> OFF
    TENSIONING, RUNNING, HOLDING  --stop, or a finding of safety/--> SLOWING --> UNLOADING --> OFF --arm--> ARMING

From OFF and SILENT only a person's `arm` leads on.
"""

from dataclasses import dataclass, replace

from gateway.core.states import STATE_OF, LoopState, Phase
from safety.actions import Action

ARMING_TIME_S = 2.0  #: a drive that is not ready by then refuses the arming
ENABLING_TIME_S = 2.0
STEADY_TIME_S = 0.5  #: all tensions inside their band for this long: the web is tensioned
STANDSTILL_M_PER_S = 0.002
#: Only a command or a finding leads out of these.
LASTING = (Phase.SILENT, Phase.READY, Phase.RUNNING, Phase.HOLDING, Phase.OFF)


@dataclass(frozen=True, slots=True)
class Times:
    """How long a phase may take. From the line's file."""

    tensioning_s: float
    stop_s: float


@dataclass(frozen=True, slots=True)
class Machine:
    phase: Phase = Phase.SILENT
    since_s: float = 0.0  #: when the phase began
    reason: str = ""  #: why the line stopped, or why an arming failed
    steady_since_s: float | None = None  #: since when the tensions have been inside their band, while tensioning

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


def to_phase(machine: Machine, phase: Phase, now_s: float, reason: str | None = None) -> Machine:
    return Machine(phase, now_s, machine.reason if reason is None else reason)


def stop(machine: Machine, now_s: float, reason: str) -> Machine:
    """The way to STOP from any phase: controlled where there is torque, at once where there is none."""
    match machine.phase:
        case Phase.TENSIONING | Phase.RUNNING | Phase.HOLDING:
            return to_phase(machine, Phase.SLOWING, now_s, reason)
        case Phase.ARMING | Phase.READY | Phase.ENABLING:
            return to_phase(machine, Phase.OFF, now_s, reason)
        case _:  # SILENT has nothing to stop; the phases of STOP are under way
            return machine


def torque_off(machine: Machine, now_s: float, reason: str) -> Machine:
    """The way to STOP when tension control must not go on: torque ramps to zero at once."""
    if machine.phase in (Phase.TENSIONING, Phase.RUNNING, Phase.HOLDING, Phase.SLOWING):
        return to_phase(machine, Phase.UNLOADING, now_s, reason)
    return stop(machine, now_s, reason)


def advance(times: Times, machine: Machine, seen: Observation, now_s: float) -> Machine:
    """The machine after a period."""
    if seen.action >= Action.STOP:
        machine = _trip(machine, seen, now_s)
    elapsed = now_s - machine.since_s
    match machine.phase:
        case Phase.ARMING:
            return _arming(machine, seen, now_s, elapsed)
        case Phase.ENABLING:
            return _enabling(machine, seen, now_s, elapsed)
        case Phase.TENSIONING:
            return _tensioning(times, machine, seen, now_s, elapsed)
        case Phase.SLOWING:
            over = seen.standstill or not seen.plc_answers or not seen.feedback or elapsed > times.stop_s
            return to_phase(machine, Phase.UNLOADING, now_s) if over else machine
        case Phase.UNLOADING:
            return to_phase(machine, Phase.OFF, now_s) if seen.torque_zero else machine
        case _:
            return machine


def _trip(machine: Machine, seen: Observation, now_s: float) -> Machine:
    if seen.action is Action.TORQUE_OFF:
        return torque_off(machine, now_s, seen.reason)
    # A controlled stop that is under way goes on: its cause may well persist.
    return stop(machine, now_s, seen.reason)


def _arming(machine: Machine, seen: Observation, now_s: float, elapsed: float) -> Machine:
    if not seen.not_ready:
        return to_phase(machine, Phase.READY, now_s, "")
    if elapsed <= ARMING_TIME_S:
        return machine
    return to_phase(machine, Phase.OFF, now_s, f"drives that do not become ready: {seen.not_ready}")


def _enabling(machine: Machine, seen: Observation, now_s: float, elapsed: float) -> Machine:
    if not seen.not_enabled:
        return to_phase(machine, Phase.TENSIONING, now_s)
    if elapsed <= ENABLING_TIME_S:
        return machine
    return to_phase(machine, Phase.OFF, now_s, f"drives that do not take over torque control: {seen.not_enabled}")


def _tensioning(times: Times, machine: Machine, seen: Observation, now_s: float, elapsed: float) -> Machine:
    if not seen.tensioned:
        machine = replace(machine, steady_since_s=None)
    elif machine.steady_since_s is None:
        machine = replace(machine, steady_since_s=now_s)
    if machine.steady_since_s is not None and now_s - machine.steady_since_s >= STEADY_TIME_S:
        return to_phase(machine, Phase.RUNNING, now_s)
    if elapsed > times.tensioning_s:
        return stop(machine, now_s, f"the web could not be tensioned within {times.tensioning_s:g} s: is it threaded?")
    return machine
