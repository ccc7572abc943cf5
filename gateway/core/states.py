"""The states of the loop, the only names under which they appear anywhere."""

from enum import IntEnum


class LoopState(IntEnum):
    SILENT = 0  #: nothing is sent to a drive
    READY = 1  #: limits valid, watchdogs confirmed, armed, zero torque
    RUN = 2  #: tension and speed control
    HOLD = 3  #: on the operator's word: speed ramped to standstill, tension control stays on
    STOP = 4  #: controlled stop, then torque off; latched until `arm`
