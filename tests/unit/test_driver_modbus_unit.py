"""The unit of one drive, without a wire: what may be written to it when."""

from typing import cast

from drivers.device_map import MAPS, load_map
from drivers.modbus.axis import Axis, AxisSettings
from drivers.modbus.maps import DriveMap
from drivers.modbus.unit import RESTS, Unit
from gateway.core.finding import finding

ALTERED = finding("setting-changed", device="drive-1", setting="watchdog", set_counts=100.0, found_counts=0.0)
SETTINGS = AxisSettings(channel=1, rated_torque_nm=80.0, torque_limit_nm=60.0, watchdog_s=0.1, radius_m=0.04)


def unit(name: str) -> Unit:
    device = cast(DriveMap, load_map(MAPS / f"{name}.toml"))
    return Unit(3, 3, [Axis("drive-1", 0, device, SETTINGS)])


def test_a_watchdog_in_reach_takes_no_request_more_and_one_out_of_reach_is_left_to_be_asked_for() -> None:
    single, rack = unit("r2r-drive-modbus"), unit("r2r-rack-drive")
    assert single.plan.reads == [(1, 23)] and not single.unseen_settings.groups
    assert rack.plan.reads == [(8, 5)] and [place for place, _ in rack.unseen_settings.groups] == [(301, 1)]
    assert single.take_settings([[0, 0, 0, 0, 0], [0]], judged=False) == [[0, 0, 0, 0, 0]]


def test_what_a_late_proof_found_while_silent_does_not_outlast_the_next_arming() -> None:
    drive = unit("r2r-drive-modbus")
    drive.silence()
    drive.distrust([ALTERED])
    drive.activate()
    assert drive.may_write() and drive.take_rest() is None


def test_who_has_not_kept_its_settings_is_told_to_rest_a_few_times_and_once_only() -> None:
    drive = unit("r2r-drive-modbus")
    drive.activate()
    for _ in range(3):
        drive.distrust([ALTERED])
    assert [drive.take_rest() for _ in range(RESTS)] == [[[0, 0]]] * RESTS
    drive.distrust([ALTERED])
    assert drive.take_rest() is None and not drive.may_write()
