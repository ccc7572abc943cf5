"""The signals of a line as the loop sees them: one sample is a value, a monotonic time and a quality.

Arrays are indexed from 0: element k belongs to roller k+1 and to span k+1 (the unwinder, roller 0, is driven
by the line PLC). Everything is SI and positive in the direction of transport.
"""

from dataclasses import dataclass, field
from enum import IntEnum, IntFlag
from math import isfinite, nan

import numpy as np
from numpy.typing import NDArray

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int8]
BoolArray = NDArray[np.bool_]
CountArray = NDArray[np.int64]


class Quality(IntEnum):
    """How far a sample may be trusted. Only GOOD may be controlled on."""

    GOOD = 0  #: arrived in this cycle and is plausible
    STALE = 1  #: nothing new in this cycle; the value is the last good one
    BAD = 2  #: arrived, but not usable (not finite, out of range, the device says so); the value is the last good one
    MISSING = 3  #: never seen since the link was opened; the value is NaN


class DriveState(IntEnum):
    """What a drive says of itself, whatever its protocol calls it."""

    ABSENT = 0  #: never heard, or lost
    OFF = 1  #: alive, no torque, not ready (CiA 402: not ready to switch on, switch on disabled)
    READY = 2  #: alive, no torque, may be enabled (ready to switch on, switched on)
    ENABLED = 3  #: follows its torque command (operation enabled)
    STOPPING = 4  #: quick stop active
    FAULT = 5  #: fault or fault reaction
    STO = 6  #: safe torque off is active, from the hard-wired circuit


class DriveCondition(IntFlag):
    """What a drive says of itself beside its state, as far as its map knows where it says so."""

    NONE = 0
    WRONG_MODE = 1  #: its mode of operation is not the one it was told
    MODE_UNCONFIRMED = 2  #: enabled, and has not said yet in which mode
    NO_POWER = 4  #: its power stage has no supply
    LIMITED = 8  #: a limit of its own acts
    WARNS = 16  #: it warns of something, and goes on


class DriveRequest(IntEnum):
    """What the loop wants of a drive; the link finds the protocol's steps to it, one at a time."""

    OFF = 0  #: take torque off and stay off
    READY = 1  #: no torque, ready to be enabled
    ENABLE = 2  #: follow the torque command
    QUICK_STOP = 3
    RESET_FAULT = 4  #: acknowledge a fault and stay OFF; never enables


class Channel:
    """`n` samples of one quantity, written in place by a driver and read by the cycle."""

    __slots__ = ("quality", "time_s", "value")

    def __init__(self, n: int) -> None:
        self.value: FloatArray = np.full(n, nan)
        self.time_s: FloatArray = np.full(n, nan)
        self.quality: IntArray = np.full(n, Quality.MISSING, dtype=np.int8)

    def put(self, index: int, value: float, time_s: float) -> None:
        """A fresh sample taken at `time_s` (monotonic). A value that is not finite is refused: quality BAD."""
        if isfinite(value):
            self.value[index] = value
            self.time_s[index] = time_s
            self.quality[index] = Quality.GOOD
        else:
            self.reject(index)

    def reject(self, index: int) -> None:
        """A sample came that must not be used; the last good value stays."""
        self.quality[index] = Quality.BAD

    def miss(self, index: int) -> None:
        """No sample came in this cycle; the last good value stays."""
        if self.quality[index] != Quality.MISSING:
            self.quality[index] = Quality.STALE

    def good(self) -> bool:
        """Whether every sample of the channel is GOOD."""
        return not any(self.quality.tobytes())  # GOOD is 0; `any` of numpy takes ten times as long for a few


@dataclass(slots=True)
class PlcStatus:
    """What the line PLC says. Until it has been heard everything is on the safe side."""

    quality: Quality = Quality.MISSING
    time_s: float = nan
    permissive: bool = False  #: the line may run
    emergency_stop: bool = True  #: the emergency stop circuit is open
    running: bool = False  #: the line's transport is on
    tripped: bool = False  #: its command watchdog has fired
    local: bool = False  #: somebody works at the line: it is not started from elsewhere. A PLC without the signal: no


class Inputs:
    """Everything that is read in a cycle, for `n` spans."""

    __slots__ = (
        "drive_condition", "drive_mode", "drive_state", "drive_warning", "n", "plc", "power_barred", "speed", "tension",
        "torque", "unwind_speed",
    )  # fmt: skip

    def __init__(self, n: int) -> None:
        self.n = n
        self.tension = Channel(n)  #: N, span k+1
        self.speed = Channel(n)  #: m/s, web speed at roller k+1
        self.torque = Channel(n)  #: Nm, as the drive reports it
        self.unwind_speed = Channel(1)  #: m/s, v0
        self.drive_state: IntArray = np.full(n, DriveState.ABSENT, dtype=np.int8)
        self.drive_condition: IntArray = np.zeros(n, dtype=np.int8)  #: of DriveCondition
        self.drive_mode: CountArray = np.zeros(n, dtype=np.int64)  #: of operation, where WRONG_MODE is set
        #: The error code that it warns of, with the error register (CiA 301, 1001h) above 16 bits; 0: none it names
        self.drive_warning: CountArray = np.zeros(n, dtype=np.int64)
        #: The statusword of this cycle says fault or switch on disabled; whatever else speaks against a drive is not in
        #: it, nor a safe torque off. False where no statusword came.
        self.power_barred: BoolArray = np.zeros(n, dtype=np.bool_)
        self.plc = PlcStatus()


class Outputs:
    """Everything that is written in a cycle, for `n` spans. It starts silent: no torque, drives off."""

    __slots__ = ("drive_request", "n", "run", "speed_request_m_per_s", "torque_nm", "warning")

    def __init__(self, n: int) -> None:
        self.n = n
        self.torque_nm: FloatArray = np.zeros(n)
        self.drive_request: IntArray = np.full(n, DriveRequest.OFF, dtype=np.int8)
        self.speed_request_m_per_s = 0.0  #: asked of the line PLC for the unwinder
        self.run = False  #: asks the line PLC for transport
        self.warning = False  #: asks the line PLC to warn whoever is near: something is about to move


@dataclass(slots=True)
class LinkHealth:
    """What a link has lived through since it was opened."""

    timeouts: int = 0  #: samples that did not come in time
    malformed: int = 0  #: frames or answers that were discarded
    reconnects: int = 0
    last_error: str = ""
    absent: list[str] = field(default_factory=list[str])  #: names of the devices that do not answer now
