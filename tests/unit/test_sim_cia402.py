"""The state machine against the state diagram of CiA 402-2, written here as a table of its own."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from sim_plant.devices.cia402 import (
    Machine,
    State,
    faulted,
    quick_stop_done,
    step,
    step_without_power,
    without_power,
)

SHUTDOWN, SWITCH_ON, ENABLE, DISABLE_VOLTAGE, QUICK_STOP, RESET = 0x06, 0x07, 0x0F, 0x00, 0x02, 0x80

DIAGRAM = [
    (State.SWITCH_ON_DISABLED, SHUTDOWN, State.READY_TO_SWITCH_ON),
    (State.SWITCH_ON_DISABLED, SWITCH_ON, State.SWITCH_ON_DISABLED),
    (State.SWITCH_ON_DISABLED, ENABLE, State.SWITCH_ON_DISABLED),
    (State.SWITCH_ON_DISABLED, DISABLE_VOLTAGE, State.SWITCH_ON_DISABLED),
    (State.SWITCH_ON_DISABLED, QUICK_STOP, State.SWITCH_ON_DISABLED),
    (State.READY_TO_SWITCH_ON, SHUTDOWN, State.READY_TO_SWITCH_ON),
    (State.READY_TO_SWITCH_ON, SWITCH_ON, State.SWITCHED_ON),
    (State.READY_TO_SWITCH_ON, ENABLE, State.OPERATION_ENABLED),
    (State.READY_TO_SWITCH_ON, DISABLE_VOLTAGE, State.SWITCH_ON_DISABLED),
    (State.READY_TO_SWITCH_ON, QUICK_STOP, State.SWITCH_ON_DISABLED),
    (State.SWITCHED_ON, SHUTDOWN, State.READY_TO_SWITCH_ON),
    (State.SWITCHED_ON, SWITCH_ON, State.SWITCHED_ON),
    (State.SWITCHED_ON, ENABLE, State.OPERATION_ENABLED),
    (State.SWITCHED_ON, DISABLE_VOLTAGE, State.SWITCH_ON_DISABLED),
    (State.SWITCHED_ON, QUICK_STOP, State.SWITCH_ON_DISABLED),
    (State.OPERATION_ENABLED, SHUTDOWN, State.READY_TO_SWITCH_ON),
    (State.OPERATION_ENABLED, SWITCH_ON, State.SWITCHED_ON),
    (State.OPERATION_ENABLED, ENABLE, State.OPERATION_ENABLED),
    (State.OPERATION_ENABLED, DISABLE_VOLTAGE, State.SWITCH_ON_DISABLED),
    (State.OPERATION_ENABLED, QUICK_STOP, State.QUICK_STOP_ACTIVE),
    (State.QUICK_STOP_ACTIVE, SHUTDOWN, State.QUICK_STOP_ACTIVE),
    (State.QUICK_STOP_ACTIVE, SWITCH_ON, State.QUICK_STOP_ACTIVE),
    (State.QUICK_STOP_ACTIVE, ENABLE, State.QUICK_STOP_ACTIVE),  # option 2: no way back
    (State.QUICK_STOP_ACTIVE, DISABLE_VOLTAGE, State.SWITCH_ON_DISABLED),
    (State.QUICK_STOP_ACTIVE, QUICK_STOP, State.QUICK_STOP_ACTIVE),
    *((State.FAULT, word, State.FAULT) for word in (SHUTDOWN, SWITCH_ON, ENABLE, DISABLE_VOLTAGE, QUICK_STOP)),
]

WORDS = st.integers(0, 0xFFFF)
MACHINES = st.builds(Machine, st.sampled_from(list(State)), WORDS)


@pytest.mark.parametrize(("before", "word", "after"), DIAGRAM)
def test_the_state_diagram(before: State, word: int, after: State) -> None:
    assert step(Machine(before), word) == Machine(after, word)


@pytest.mark.parametrize(("before", "word", "after"), DIAGRAM)
def test_bits_that_are_no_command_change_nothing(before: State, word: int, after: State) -> None:
    """Bits 4 to 6 and 8 to 15; and whatever bit 3 says where bits 0 to 2 decide alone."""
    assert step(Machine(before), word | 0xFF70).state is after
    if word not in (SWITCH_ON, ENABLE):
        assert step(Machine(before), word | 0x08).state is after


def test_a_fault_is_reset_by_the_rising_edge_alone() -> None:
    fault = Machine(State.FAULT, controlword=0)
    assert step(fault, RESET).state is State.SWITCH_ON_DISABLED
    held = Machine(State.FAULT, controlword=RESET)
    assert step(held, RESET).state is State.FAULT
    assert step(step(held, 0), RESET).state is State.SWITCH_ON_DISABLED


@given(words=st.lists(WORDS.map(lambda word: word | RESET), min_size=1))
def test_a_fault_reset_never_enables(words: list[int]) -> None:
    """However the other bits are set, and however long bit 7 is held."""
    machine = Machine(State.FAULT)
    for word in words:
        machine = step(machine, word)
        assert machine.state is State.SWITCH_ON_DISABLED


@given(machine=MACHINES, word=WORDS)
def test_operation_is_enabled_by_its_command_alone(machine: Machine, word: int) -> None:
    after = step(machine, word).state
    if after is State.OPERATION_ENABLED and machine.state is not State.OPERATION_ENABLED:
        assert word & 0x8F == ENABLE
        assert machine.state in (State.READY_TO_SWITCH_ON, State.SWITCHED_ON)


@given(machine=MACHINES, word=WORDS)
def test_without_power_nothing_is_enabled(machine: Machine, word: int) -> None:
    assert without_power(machine).state in (State.SWITCH_ON_DISABLED, State.FAULT)
    assert step_without_power(without_power(machine), word).state in (State.SWITCH_ON_DISABLED, State.FAULT)


@given(machine=MACHINES)
def test_a_fault_is_entered_from_everywhere_and_left_by_no_ramp(machine: Machine) -> None:
    assert faulted(machine).state is State.FAULT
    assert quick_stop_done(faulted(machine)).state is State.FAULT


def test_the_quick_stop_ends_in_switch_on_disabled() -> None:
    assert quick_stop_done(Machine(State.QUICK_STOP_ACTIVE, 2)) == Machine(State.SWITCH_ON_DISABLED, 2)
    assert quick_stop_done(Machine(State.OPERATION_ENABLED, 2)) == Machine(State.OPERATION_ENABLED, 2)
