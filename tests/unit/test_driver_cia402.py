"""The master's state machine against the profile's own drive, written here as its table of transitions."""

from hypothesis import given
from hypothesis import strategies as st

from drivers.cia402 import PowerState, controlword, drive_state, power_state
from gateway.core.signals import DriveRequest, DriveState

S = PowerState

# IEC 61800-7-201, table of the states: mask and value of the statusword.
STATUSWORDS = {
    S.NOT_READY: (0x4F, 0x00),
    S.SWITCH_ON_DISABLED: (0x4F, 0x40),
    S.READY_TO_SWITCH_ON: (0x6F, 0x21),
    S.SWITCHED_ON: (0x6F, 0x23),
    S.OPERATION_ENABLED: (0x6F, 0x27),
    S.QUICK_STOP_ACTIVE: (0x6F, 0x07),
    S.FAULT_REACTION: (0x4F, 0x0F),
    S.FAULT: (0x4F, 0x08),
}


def strictest_drive(state: PowerState, word: int, previous: int) -> PowerState:
    """What a drive does that knows single transitions only: 2, 3, 4, 5, 6, 7, 8, 9, 10, 11, 12, 15."""
    if state is S.FAULT:
        return S.SWITCH_ON_DISABLED if word & 0x80 and not previous & 0x80 else S.FAULT
    if state in (S.NOT_READY, S.FAULT_REACTION):
        return state
    if not word & 0x02:  # disable voltage
        return S.SWITCH_ON_DISABLED
    if not word & 0x04:  # quick stop
        running = state in (S.OPERATION_ENABLED, S.QUICK_STOP_ACTIVE)
        return S.QUICK_STOP_ACTIVE if running else S.SWITCH_ON_DISABLED
    command = {0x06: "shutdown", 0x07: "switch on", 0x0F: "enable"}.get(word & 0x0F, "shutdown")
    table = {
        (S.SWITCH_ON_DISABLED, "shutdown"): S.READY_TO_SWITCH_ON,
        (S.READY_TO_SWITCH_ON, "switch on"): S.SWITCHED_ON,
        (S.SWITCHED_ON, "enable"): S.OPERATION_ENABLED,
        (S.SWITCHED_ON, "shutdown"): S.READY_TO_SWITCH_ON,
        (S.OPERATION_ENABLED, "shutdown"): S.READY_TO_SWITCH_ON,
        (S.OPERATION_ENABLED, "switch on"): S.SWITCHED_ON,
    }
    return table.get((state, command), state)


def word_of(state: PowerState) -> int:
    return STATUSWORDS[state][1]


@given(st.integers(0, 0xFFFF))
def test_every_statusword_has_the_profiles_state(statusword: int) -> None:
    matching = [state for state, (mask, value) in STATUSWORDS.items() if statusword & mask == value]
    assert len(matching) <= 1
    assert power_state(statusword) is (matching[0] if matching else S.FAULT)


def test_states_in_the_gateways_words() -> None:
    assert drive_state(S.OPERATION_ENABLED) == DriveState.ENABLED
    enabled = [state for state in S if drive_state(state) == DriveState.ENABLED]
    assert enabled == [S.OPERATION_ENABLED]
    assert {drive_state(S.FAULT), drive_state(S.FAULT_REACTION)} == {DriveState.FAULT}
    assert drive_state(S.QUICK_STOP_ACTIVE) == DriveState.STOPPING


def run(state: PowerState, request: DriveRequest, periods: int, previous: int = 0) -> list[PowerState]:
    path = [state]
    for _ in range(periods):
        word = controlword(power_state(word_of(path[-1])), request, previous)
        path.append(strictest_drive(path[-1], word, previous))
        previous = word
    return path


def test_enabling_takes_one_transition_at_a_time() -> None:
    path = run(S.SWITCH_ON_DISABLED, DriveRequest.ENABLE, 4)
    assert path == [
        S.SWITCH_ON_DISABLED,
        S.READY_TO_SWITCH_ON,
        S.SWITCHED_ON,
        S.OPERATION_ENABLED,
        S.OPERATION_ENABLED,
    ]


def test_where_each_request_leads() -> None:
    alive = [S.SWITCH_ON_DISABLED, S.READY_TO_SWITCH_ON, S.SWITCHED_ON, S.OPERATION_ENABLED, S.QUICK_STOP_ACTIVE]
    for state in alive:
        assert run(state, DriveRequest.OFF, 3)[-1] is S.SWITCH_ON_DISABLED
        assert run(state, DriveRequest.READY, 4)[-1] is S.READY_TO_SWITCH_ON
        assert run(state, DriveRequest.ENABLE, 5)[-1] is S.OPERATION_ENABLED
        assert run(state, DriveRequest.RESET_FAULT, 3)[-1] is S.SWITCH_ON_DISABLED
    assert run(S.OPERATION_ENABLED, DriveRequest.QUICK_STOP, 3)[-1] is S.QUICK_STOP_ACTIVE
    assert run(S.SWITCHED_ON, DriveRequest.QUICK_STOP, 3)[-1] is S.SWITCH_ON_DISABLED


@given(st.sampled_from(sorted(set(DriveRequest) - {DriveRequest.RESET_FAULT})), st.integers(0, 0xFFFF))
def test_a_fault_is_left_only_on_request(request: DriveRequest, previous: int) -> None:
    assert set(run(S.FAULT, request, 4, previous)) == {S.FAULT}


@given(st.integers(0, 0xFFFF))
def test_a_fault_reset_needs_an_edge_and_never_enables(previous: int) -> None:
    path = run(S.FAULT, DriveRequest.RESET_FAULT, 4, previous)
    assert path[2:] == [S.SWITCH_ON_DISABLED] * 3, "at the latest with the second word bit 7 has risen"
    word = controlword(S.FAULT, DriveRequest.RESET_FAULT, previous)
    assert word == (0 if previous & 0x80 else 0x80)


@given(st.integers(0, 0xFFFF), st.sampled_from(list(DriveRequest)), st.integers(0, 0xFFFF))
def test_only_enable_enables(statusword: int, request: DriveRequest, previous: int) -> None:
    word = controlword(power_state(statusword), request, previous)
    if word & 0x0F == 0x0F:
        assert request == DriveRequest.ENABLE
        assert power_state(statusword) in (S.SWITCHED_ON, S.OPERATION_ENABLED)
