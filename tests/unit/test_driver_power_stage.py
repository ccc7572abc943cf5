"""What a CiA 402 power stage counts as when safe torque off is told, asked for, or wrong."""

import pytest

from drivers.power_stage import ORDERS_IGNORED, PowerStage
from gateway.core.signals import DriveRequest, DriveState

SWITCH_ON_DISABLED, READY, SWITCHED_ON, ENABLED, QUICK_STOP, FAULT = 0x0250, 0x0231, 0x0233, 0x1237, 0x0217, 0x0218


@pytest.mark.parametrize(
    ("statusword", "state"),
    [
        (READY, DriveState.READY),
        (SWITCHED_ON, DriveState.READY),
        (ENABLED, DriveState.ENABLED),
        (QUICK_STOP, DriveState.STOPPING),
        (FAULT, DriveState.FAULT),
    ],
)
def test_an_answer_that_was_asked_for_counts_only_while_it_may_not_switch_on(
    statusword: int, state: DriveState
) -> None:
    stage = PowerStage(None)
    stage.on_statusword(statusword, None)
    stage.on_safe_torque_off(True)
    assert stage.state == state
    stage.on_statusword(SWITCH_ON_DISABLED, None)
    assert stage.state == DriveState.OFF, "nor does the old answer count later"
    stage.on_safe_torque_off(True)
    assert stage.state == DriveState.STO
    stage.on_statusword(statusword, None)
    assert stage.state == state


def test_an_answer_from_before_the_first_statusword_counts_with_it() -> None:
    for statusword, state in ((SWITCH_ON_DISABLED, DriveState.STO), (ENABLED, DriveState.ENABLED)):
        stage = PowerStage(None)
        stage.on_safe_torque_off(True)
        assert stage.state == DriveState.OFF
        stage.on_statusword(statusword, None)
        assert stage.state == state


@pytest.mark.parametrize("statusword", [SWITCH_ON_DISABLED, READY, SWITCHED_ON, ENABLED, QUICK_STOP])
def test_told_with_the_statusword_it_is_no_torque_unless_in_fault(statusword: int) -> None:
    stage = PowerStage(None)
    stage.on_statusword(statusword, True)
    assert stage.state == DriveState.STO
    stage.on_statusword(FAULT, True)
    assert stage.state == DriveState.FAULT


def test_a_wrong_flag_does_not_hide_a_drive_that_stays_enabled_though_told_off() -> None:
    stage = PowerStage(None)
    for _ in range(ORDERS_IGNORED + 1):
        stage.on_statusword(ENABLED, True)
        assert stage.state == DriveState.STO and not stage.disobeys
        stage.command(DriveRequest.OFF, 0.0, stage.state, trusted=True)
    assert stage.disobeys
