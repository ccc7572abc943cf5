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


STATE_OF: dict[Phase, LoopState] = {
    Phase.SILENT: LoopState.SILENT,
    Phase.ARMING: LoopState.SILENT,
    Phase.READY: LoopState.READY,
    Phase.ENABLING: LoopState.RUN,
    Phase.TENSIONING: LoopState.RUN,
    Phase.RUNNING: LoopState.RUN,
    Phase.HOLDING: LoopState.HOLD,
    Phase.SLOWING: LoopState.STOP,
    Phase.UNLOADING: LoopState.STOP,
    Phase.OFF: LoopState.STOP,
}

OPERATORS_STOP = "operator's stop"  #: the reason of a stop that a person wanted
