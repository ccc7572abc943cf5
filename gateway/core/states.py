"""The states of the loop, the only names under which they appear anywhere."""

from enum import IntEnum


class LoopState(IntEnum):
    SILENT = 0  #: nothing is sent to a drive, but for what `arm` configures
    READY = 1  #: limits valid, watchdogs confirmed, armed, zero torque
    RUN = 2  #: tension and speed control
    HOLD = 3  #: on the operator's word: speed ramped to standstill, tension control stays on
    STOP = 4  #: controlled stop, then torque off; latched until `arm`


class Phase(IntEnum):
    """Where in a state the loop is. One phase belongs to one state."""

    SILENT = 0
    ARMING = 1  #: watchdogs are confirmed; faults are acknowledged, drives become ready
    READY = 2
    ENABLING = 3  #: the drives take over at zero torque
    TENSIONING = 4  #: the web is brought to its tensions at standstill
    RUNNING = 5
    HOLDING = 6
    SLOWING = 7  #: the speed is ramped down, tension control goes on
    UNLOADING = 8  #: torque is ramped to zero
    OFF = 9  #: torque is off
    #: Started: the line PLC warns whoever is near, nothing moves yet. Behind the others: the numbers are a format.
    WARNING = 10
    BRAKING = 11  #: the web has broken: rollers and reels are braked on their own speed
    DRILLING = 13  #: at rest, without torque: watchdogs are not fed, and their reactions seen
    PROVING = 12  #: at standstill one drive at a time pulls a little: the wiring is proved


STATE_OF: dict[Phase, LoopState] = {
    Phase.SILENT: LoopState.SILENT,
    Phase.ARMING: LoopState.SILENT,
    Phase.READY: LoopState.READY,
    Phase.WARNING: LoopState.READY,
    Phase.ENABLING: LoopState.RUN,
    Phase.TENSIONING: LoopState.RUN,
    Phase.RUNNING: LoopState.RUN,
    Phase.HOLDING: LoopState.HOLD,
    Phase.SLOWING: LoopState.STOP,
    Phase.UNLOADING: LoopState.STOP,
    Phase.OFF: LoopState.STOP,
    Phase.BRAKING: LoopState.STOP,
    Phase.PROVING: LoopState.RUN,
    Phase.DRILLING: LoopState.SILENT,
}

#: Phases in which the line has been stopped or is being: what a stop that was asked for leads to.
STOPPING = frozenset(phase for phase, state in STATE_OF.items() if state is LoopState.STOP) | {Phase.SILENT}


def shows_stop(phase: int | str) -> bool:
    """Whether a line in `phase`, as its number or its name, has been stopped or is being. No phase: it does not."""
    if isinstance(phase, str):
        return phase in Phase.__members__ and Phase[phase] in STOPPING
    return phase in STOPPING
