"""The master's side of the CiA 402 power drive state machine (IEC 61800-7-201, 6.2). Pure.

A statusword and what is wanted give the next controlword, one transition at a time. The machine never enables
from a fault, and acknowledges a fault only when that is asked for, with a rising edge of bit 7.
"""

from enum import IntEnum

from gateway.core.signals import DriveRequest, DriveState


class PowerState(IntEnum):
    NOT_READY = 1  # none of them is 0, which would count as false
    SWITCH_ON_DISABLED = 2
    READY_TO_SWITCH_ON = 3
    SWITCHED_ON = 4
    OPERATION_ENABLED = 5
    QUICK_STOP_ACTIVE = 6
    FAULT_REACTION = 7
    FAULT = 8


DISABLE_VOLTAGE = 0x0000
QUICK_STOP = 0x0002
SHUTDOWN = 0x0006
SWITCH_ON = 0x0007
ENABLE_OPERATION = 0x000F
FAULT_RESET = 0x0080

# Statusword bits 0 to 3, 5 and 6; bit 5 says nothing in the states of the second table.
_WITH_BIT_5 = {
    0x21: PowerState.READY_TO_SWITCH_ON,
    0x23: PowerState.SWITCHED_ON,
    0x27: PowerState.OPERATION_ENABLED,
    0x07: PowerState.QUICK_STOP_ACTIVE,
}
_WITHOUT_BIT_5 = {
    0x00: PowerState.NOT_READY,
    0x40: PowerState.SWITCH_ON_DISABLED,
    0x0F: PowerState.FAULT_REACTION,
    0x08: PowerState.FAULT,
}

_DRIVE_STATE = {
    PowerState.NOT_READY: DriveState.OFF,
    PowerState.SWITCH_ON_DISABLED: DriveState.OFF,
    PowerState.READY_TO_SWITCH_ON: DriveState.READY,
    PowerState.SWITCHED_ON: DriveState.READY,
    PowerState.OPERATION_ENABLED: DriveState.ENABLED,
    PowerState.QUICK_STOP_ACTIVE: DriveState.STOPPING,
    PowerState.FAULT_REACTION: DriveState.FAULT,
    PowerState.FAULT: DriveState.FAULT,
}

_TOWARDS_READY = {
    PowerState.SWITCH_ON_DISABLED: SHUTDOWN,
    PowerState.READY_TO_SWITCH_ON: SHUTDOWN,
    PowerState.SWITCHED_ON: SHUTDOWN,
    PowerState.OPERATION_ENABLED: SHUTDOWN,
}
_TOWARDS_ENABLED = {
    PowerState.SWITCH_ON_DISABLED: SHUTDOWN,
    PowerState.READY_TO_SWITCH_ON: SWITCH_ON,
    PowerState.SWITCHED_ON: ENABLE_OPERATION,
    PowerState.OPERATION_ENABLED: ENABLE_OPERATION,
}
_TOWARDS_STOP = {
    PowerState.OPERATION_ENABLED: QUICK_STOP,
    PowerState.QUICK_STOP_ACTIVE: QUICK_STOP,
}


def _power_state(statusword: int) -> PowerState | None:
    return _WITH_BIT_5.get(statusword & 0x6F) or _WITHOUT_BIT_5.get(statusword & 0x4F)


# Seven bits decide, so every answer is worked out once.
_POWER_STATE = [_power_state(bits) for bits in range(0x80)]


def power_state(statusword: int) -> PowerState:
    """The state in a statusword. A combination the profile does not know counts as a fault."""
    return _POWER_STATE[statusword & 0x7F] or PowerState.FAULT


def is_barred(statusword: int) -> bool:
    """Whether the power stage is off and needs an order to be switched on again: switch on disabled, or fault.

    Neither is a fault reaction, in which torque may go on, nor "not ready", nor what the profile does not know.
    """
    return statusword & 0x4F in (0x40, 0x08)


def drive_state(state: PowerState) -> DriveState:
    """The same in the gateway's words (safe torque off is not in the statusword)."""
    return _DRIVE_STATE[state]


def controlword(state: PowerState, request: int, previous: int) -> int:
    """The next controlword.

    `request` is a DriveRequest; `previous` is the controlword sent last, of which the edge of a fault reset is
    made: a drive that stays in fault sees bit 7 rise, fall and rise again.
    """
    if request == DriveRequest.ENABLE:
        return _TOWARDS_ENABLED.get(state, DISABLE_VOLTAGE)
    if request == DriveRequest.READY:
        return _TOWARDS_READY.get(state, DISABLE_VOLTAGE)
    if request == DriveRequest.QUICK_STOP:
        return _TOWARDS_STOP.get(state, DISABLE_VOLTAGE)
    if request == DriveRequest.RESET_FAULT and state is PowerState.FAULT and not previous & FAULT_RESET:
        return FAULT_RESET
    return DISABLE_VOLTAGE
