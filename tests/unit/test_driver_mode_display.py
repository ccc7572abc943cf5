"""What follows of the mode of operation that a drive displays, at rest and enabled."""

from math import isinf

import pytest

from drivers.mode_display import DOUBT_S, READ_S, READINGS, REFUSALS, ModeDisplay
from gateway.core.signals import DriveCondition

NONE, WRONG, UNCONFIRMED = DriveCondition.NONE, DriveCondition.WRONG_MODE, DriveCondition.MODE_UNCONFIRMED


def display(*, at_rest: bool = True, certain: bool = True) -> ModeDisplay:
    return ModeDisplay(10, at_rest=at_rest, certain=certain)


def read(drive: ModeDisplay, mode: int, *, enabled: bool, times: int = READINGS) -> ModeDisplay:
    for _ in range(times):
        drive.on_mode(mode, enabled=enabled)
    return drive


def test_the_mode_that_was_told_is_right_at_rest_and_enabled() -> None:
    drive = read(display(), 10, enabled=False, times=1)
    assert drive.condition(enabled=False) == NONE and drive.read_after_s(enabled=False) == READ_S
    assert drive.condition(enabled=True) == UNCONFIRMED, "what it displayed before it was enabled is over"
    assert drive.read_after_s(enabled=True) == 0.0
    read(drive, 10, enabled=True, times=1)
    assert drive.condition(enabled=True) == NONE and drive.read_after_s(enabled=True) == READ_S


@pytest.mark.parametrize("enabled", [False, True])
def test_another_mode_is_wrong_after_a_second_reading(enabled: bool) -> None:
    drive = read(display(at_rest=False), 8, enabled=enabled, times=READINGS - 1)
    assert drive.condition(enabled=enabled) == UNCONFIRMED and drive.read_after_s(enabled=enabled) == DOUBT_S
    assert read(drive, 8, enabled=enabled, times=1).condition(enabled=enabled) == WRONG
    assert read(drive, 10, enabled=enabled, times=1).condition(enabled=enabled) == NONE


def test_no_mode_at_rest_is_wrong_only_where_the_mode_is_displayed_at_rest() -> None:
    assert read(display(at_rest=True), 0, enabled=False).condition(enabled=False) == WRONG
    lazy = read(display(at_rest=False), 0, enabled=False)
    assert lazy.condition(enabled=False) == NONE and lazy.read_after_s(enabled=False) == READ_S
    assert lazy.condition(enabled=True) == UNCONFIRMED and lazy.read_after_s(enabled=True) == 0.0
    assert read(lazy, 0, enabled=True).condition(enabled=True) == WRONG


def test_until_it_has_displayed_its_mode_an_enabled_drive_is_unconfirmed() -> None:
    assert display(at_rest=False).condition(enabled=False) == NONE
    assert display(at_rest=False).condition(enabled=True) == UNCONFIRMED
    assert display(at_rest=True).condition(enabled=False) == UNCONFIRMED


def test_a_drive_that_has_no_such_object_is_served_unless_its_map_says_that_it_has() -> None:
    for certain, condition in ((False, NONE), (True, UNCONFIRMED)):
        drive = display(at_rest=False, certain=certain)
        for _ in range(REFUSALS):
            assert drive.condition(enabled=True) == UNCONFIRMED
            drive.on_refusal()
        assert drive.condition(enabled=True) == condition
        assert isinf(drive.read_after_s(enabled=True)) != certain
    drive.forget()
    assert drive.condition(enabled=True) == UNCONFIRMED


def test_a_drive_that_has_displayed_its_mode_once_is_asked_on_when_it_does_not_answer() -> None:
    drive = read(display(at_rest=False, certain=False), 10, enabled=True)
    for _ in range(2 * REFUSALS):
        drive.on_refusal()
    assert drive.is_seen and drive.condition(enabled=True) == NONE
    assert read(drive, 0, enabled=True).condition(enabled=True) == WRONG
