"""The CiA 402 state machine of a drive, without a wire, a clock or a motor: controlword in, next state out.

Source: CiA 402-2 (IEC 61800-7-201), device control. Numbers in comments are the transitions of its state diagram.
"""

from enum import IntEnum, auto
from typing import NamedTuple

CYCLIC_SYNCHRONOUS_TORQUE = 10  #: modes of operation 6060h

# Bits of the statusword that are no part of the state's code.
VOLTAGE_ENABLED = 1 << 4
WARNING = 1 << 7
REMOTE = 1 << 9
INTERNAL_LIMIT = 1 << 11
FOLLOWS_COMMAND = 1 << 12  #: in a cyclic synchronous mode: the target value is followed, not ignored

MAKERS_OWN = 1 << 14 | 1 << 15  #: set for reasons of its own; whoever compares whole words is wrong

FAULT_RESET = 1 << 7  #: bit of the controlword


class State(IntEnum):
    """The states; the value is the state's code in the statusword (bits 0 to 3, 5 and 6)."""

    NOT_READY_TO_SWITCH_ON = 0x00
    SWITCH_ON_DISABLED = 0x40
    READY_TO_SWITCH_ON = 0x21
    SWITCHED_ON = 0x23
    OPERATION_ENABLED = 0x27
    QUICK_STOP_ACTIVE = 0x07
    FAULT_REACTION_ACTIVE = 0x0F
    FAULT = 0x08


class Command(IntEnum):
    DISABLE_VOLTAGE = auto()
    QUICK_STOP = auto()
    SHUTDOWN = auto()
    SWITCH_ON = auto()  #: from operation enabled the same bits are "disable operation"
    ENABLE_OPERATION = auto()
    NONE = auto()


class Machine(NamedTuple):
    """Where a drive stands. The last controlword is kept because fault reset is an edge."""

    state: State = State.SWITCH_ON_DISABLED
    controlword: int = 0


def command_of(controlword: int) -> Command:
    """The command in bits 0 to 3. With bit 7 set only the commands that take torque off are understood."""
    if not controlword & 0b0010:
        return Command.DISABLE_VOLTAGE
    if not controlword & 0b0100:
        return Command.QUICK_STOP
    if controlword & FAULT_RESET:
        return Command.NONE
    if not controlword & 0b0001:
        return Command.SHUTDOWN
    return Command.ENABLE_OPERATION if controlword & 0b1000 else Command.SWITCH_ON


_S, _C = State, Command
_TRANSITIONS: dict[tuple[State, Command], State] = {
    (_S.SWITCH_ON_DISABLED, _C.SHUTDOWN): _S.READY_TO_SWITCH_ON,  # 2
    (_S.READY_TO_SWITCH_ON, _C.SWITCH_ON): _S.SWITCHED_ON,  # 3
    (_S.READY_TO_SWITCH_ON, _C.ENABLE_OPERATION): _S.OPERATION_ENABLED,  # 3 and 4
    (_S.READY_TO_SWITCH_ON, _C.QUICK_STOP): _S.SWITCH_ON_DISABLED,  # 7
    (_S.READY_TO_SWITCH_ON, _C.DISABLE_VOLTAGE): _S.SWITCH_ON_DISABLED,  # 7
    (_S.SWITCHED_ON, _C.ENABLE_OPERATION): _S.OPERATION_ENABLED,  # 4
    (_S.SWITCHED_ON, _C.SHUTDOWN): _S.READY_TO_SWITCH_ON,  # 6
    (_S.SWITCHED_ON, _C.QUICK_STOP): _S.SWITCH_ON_DISABLED,  # 10
    (_S.SWITCHED_ON, _C.DISABLE_VOLTAGE): _S.SWITCH_ON_DISABLED,  # 10
    (_S.OPERATION_ENABLED, _C.SWITCH_ON): _S.SWITCHED_ON,  # 5, disable operation
    (_S.OPERATION_ENABLED, _C.SHUTDOWN): _S.READY_TO_SWITCH_ON,  # 8
    (_S.OPERATION_ENABLED, _C.DISABLE_VOLTAGE): _S.SWITCH_ON_DISABLED,  # 9
    (_S.OPERATION_ENABLED, _C.QUICK_STOP): _S.QUICK_STOP_ACTIVE,  # 11
    (_S.QUICK_STOP_ACTIVE, _C.DISABLE_VOLTAGE): _S.SWITCH_ON_DISABLED,  # 12
}


def step(machine: Machine, controlword: int) -> Machine:
    """The machine after a controlword. A fault reset does nothing but leave FAULT, whatever else the word says."""
    if machine.state is State.FAULT:
        rising = controlword & FAULT_RESET and not machine.controlword & FAULT_RESET
        return Machine(State.SWITCH_ON_DISABLED if rising else State.FAULT, controlword)  # 15
    state = _TRANSITIONS.get((machine.state, command_of(controlword)), machine.state)
    return Machine(state, controlword)


def step_without_power(machine: Machine, controlword: int) -> Machine:
    """As `step`, with the torque safely off (STO): a fault can be reset, but nothing leaves SWITCH ON DISABLED."""
    after = step(machine, controlword)
    return after if after.state is State.FAULT else Machine(State.SWITCH_ON_DISABLED, controlword)


def without_power(machine: Machine) -> Machine:
    """The machine once the torque has been taken off from outside: STO, a stopped node."""
    return machine if machine.state is State.FAULT else Machine(State.SWITCH_ON_DISABLED, machine.controlword)


def quick_stop_done(machine: Machine) -> Machine:
    """The end of the quick stop ramp with option 2: SWITCH ON DISABLED (12)."""
    stopping = machine.state is State.QUICK_STOP_ACTIVE
    return Machine(State.SWITCH_ON_DISABLED, machine.controlword) if stopping else machine


def faulted(machine: Machine) -> Machine:
    """The machine after its fault reaction, which takes the torque off at once (13 and 14)."""
    return Machine(State.FAULT, machine.controlword)
