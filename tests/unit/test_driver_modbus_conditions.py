"""What a Modbus drive says beside its state: mode, power, warnings; and what its map may say of that."""

from pathlib import Path

import pytest

from drivers.device_map import MAPS, MapRefused, load_map
from drivers.modbus.axis import Axis, AxisSettings
from drivers.modbus.device import Standing
from drivers.modbus.maps import DriveMap
from gateway.core.signals import DriveCondition, DriveState, Inputs

READY, ENABLED = 0x0231, 0x1237
SETTINGS = AxisSettings(channel=1, rated_torque_nm=80.0, torque_limit_nm=60.0, watchdog_s=0.1, radius_m=0.04)
MODE = ("[write]", 'mode_displayed = { address = 7, type = "i16" }\n\n[write]')


def text_with(*changes: tuple[str, str]) -> str:
    text = (MAPS / "r2r-drive-modbus.toml").read_text(encoding="utf-8")
    for old, new in changes:
        assert old in text, "the change did not apply"
        text = text.replace(old, new, 1)
    return text


def loaded(folder: Path, text: str) -> DriveMap:
    (folder / "drive.toml").write_text(text, encoding="utf-8")
    device = load_map(folder / "drive.toml")
    assert isinstance(device, DriveMap)
    return device


def axis_with_mode(folder: Path) -> Axis:
    changes = (MODE, ("follows_command", "torque_mode = 4\nfollows_command"))
    return Axis("drive-1", 0, loaded(folder, text_with(*changes)), SETTINGS)


def fill(axis: Axis, statusword: int, error: int = 0, mode: int = 4) -> Inputs:
    """Its answer: statusword, speed, torque, flags, error code, mode."""
    inputs = Inputs(1)
    standing = Standing(active=True, wrote=True)
    axis.fill(inputs, [statusword, 0, 0, 0, error, mode], standing, 1.0)
    return inputs


def test_another_mode_is_told_after_a_second_answer(tmp_path: Path) -> None:
    axis = axis_with_mode(tmp_path)
    assert fill(axis, ENABLED).drive_condition[0] == 0
    assert fill(axis, ENABLED, mode=3).drive_condition[0] == DriveCondition.MODE_UNCONFIRMED
    inputs = fill(axis, ENABLED, mode=3)
    assert inputs.drive_condition[0] == DriveCondition.WRONG_MODE and inputs.drive_mode[0] == 3
    axis.forget()
    assert fill(axis, ENABLED).drive_condition[0] == 0


def test_power_and_warnings_are_bits_and_the_code_is_that_of_the_warning(tmp_path: Path) -> None:
    axis = axis_with_mode(tmp_path)
    assert fill(axis, READY & ~0x10).drive_condition[0] == DriveCondition.NO_POWER
    inputs = fill(axis, READY | 0x80, error=0x4210)
    assert inputs.drive_condition[0] == DriveCondition.WARNS and inputs.drive_warning[0] == 0x4210
    assert fill(axis, READY, error=0x4210).drive_warning[0] == 0, "it does not warn"
    inputs = fill(axis, 0x0298, error=0x4210)
    assert inputs.drive_state[0] == DriveState.FAULT and inputs.drive_warning[0] == 0, "it is a fault"


@pytest.mark.parametrize("changes", [(MODE,), (("follows_command", "torque_mode = 4\nfollows_command"),)])
def test_the_mode_and_where_it_is_displayed_go_together(tmp_path: Path, changes: tuple[tuple[str, str], ...]) -> None:
    with pytest.raises(MapRefused, match=r"torque_mode: goes with read\.mode_displayed"):
        loaded(tmp_path, text_with(*changes))
