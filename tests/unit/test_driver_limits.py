"""Limits of the line's file as numbers of a device: a float as it is, whole ones never more, and none is no limit."""

import struct

import pytest
from hypothesis import given
from hypothesis import strategies as st

from drivers.canopen.configure import DriveSettings, drive_steps, heartbeat_step, watchdog_step
from drivers.canopen.map_parts import HeartbeatObject, Watchdog
from drivers.canopen.maps import DriveMap as CanDriveMap
from drivers.device_map import MAPS, load_map
from drivers.modbus.axis import Axis, AxisSettings
from drivers.modbus.maps import DriveMap, MaxTorque, TimeRegister
from drivers.scaling import watchdog_counts
from drivers.torque_rules import allows_torque, scaling_rated_nm

MODBUS, CAN = (load_map(MAPS / f"{name}.toml") for name in ("r2r-drive-modbus", "cia402-torque"))


def modbus_axis(kind: str, limit_nm: float, watchdog_s: float, *, writable: bool = True) -> Axis:
    """Of a drive with its greatest torque in Nm and its watchdog in seconds."""
    assert isinstance(MODBUS, DriveMap)
    torque = MaxTorque(address=22, type=kind, unit="Nm", writable=writable)
    watchdog = TimeRegister(address=30, type="f32", unit="s", range=[0.02, 0.5])
    device = MODBUS.model_copy(update={"max_torque": torque, "watchdog": watchdog})
    return Axis("drive-1", 0, device, AxisSettings(1, 80.0, limit_nm, watchdog_s, 0.04))


@given(st.floats(0.01, 500.0), st.floats(0.02, 0.5))
def test_floats_on_modbus_are_written_as_they_are_and_found_so_when_they_are_read_back(nm: float, s: float) -> None:
    settings = modbus_axis("f32", nm, s).proofs.settings
    assert [setting.counts for setting in settings] == pytest.approx([nm, s], rel=1e-6)
    for setting in settings:
        assert setting.against(setting.register.decode(setting.register.encode([setting.counts]))[0]) == []


@given(st.floats(0.01, 500.0))
def test_a_float_on_canopen_is_written_as_it_is(limit_nm: float) -> None:
    assert isinstance(CAN, CanDriveMap) and CAN.objects.max_torque is not None
    change = {"type": "f32", "unit": "Nm", "scale": 1.0, "writable": True}
    objects = CAN.objects.model_copy(update={"max_torque": CAN.objects.max_torque.model_copy(update=change)})
    device = CAN.model_copy(update={"objects": objects})
    (step,) = (one for one in drive_steps(device, DriveSettings(1, 80.0, limit_nm, 0.1)) if one.index == 0x6072)
    assert step.bytes_after(b"") == struct.pack("<f", limit_nm)


def test_times_on_canopen_are_written_as_they_are() -> None:
    watchdog = Watchdog(index=0x2000, type="f32", unit="s", range=[0.02, 0.1])
    assert watchdog_step(watchdog, 0.1).bytes_after(b"") == struct.pack("<f", 0.1), "the end of its range is in it"
    heartbeat = HeartbeatObject(index=0x2001, type="f32", unit="s", range=[0.01, 1.0], value=0.1)
    assert heartbeat_step(heartbeat).bytes_after(b"") == struct.pack("<f", 0.1)


@pytest.mark.parametrize(("kind", "limit_nm"), [("u16", 0.8), ("i32", 0.99)])
def test_a_limit_that_whole_numbers_could_only_call_none_is_refused(kind: str, limit_nm: float) -> None:
    with pytest.raises(ValueError, match="less than one count of max_torque"):
        modbus_axis(kind, limit_nm, 0.1)
    assert modbus_axis(kind, 12.5, 0.1).proofs.settings[0].counts == 12


@pytest.mark.parametrize(
    ("scale", "bounds", "asked_s", "counts"),
    [
        (0.1, [0.1, 0.3], 0.3, 3),
        (0.1, [0.1, 0.3], 0.29, 2),
        (0.1, [0.2, 0.3], 0.15, None),
        (1.0, [0.0, 5.0], 0.5, None),
    ],
)
def test_whole_times_are_never_longer_and_a_watchdog_is_never_off(
    scale: float, bounds: list[float], asked_s: float, counts: int | None
) -> None:
    entry = TimeRegister(address=30, unit="s", scale=scale, range=bounds)
    if counts is not None:
        assert watchdog_counts(entry, asked_s) == counts
        return
    with pytest.raises(ValueError, match=f"in steps of {scale:g}" if bounds[0] <= asked_s else "outside"):
        watchdog_counts(entry, asked_s)


@pytest.mark.parametrize(
    ("found_nm", "limit_nm", "step_nm", "allowed"),
    [
        (0.8, 0.8, 0.0, True),
        (struct.unpack("f", struct.pack("f", 0.7))[0], 0.7, 0.0, True),  # which is a little less
        (0.79, 0.8, 0.0, False),
        (59.98, 60.0, 0.02, False),  # 60 can be set there
        (59.98, 59.99, 0.02, True),
        (0.0, 0.8, 1.0, False),  # what gives nothing passes for nothing
        (1.0, 0.8, 1.0, True),
        (float("nan"), 0.8, 0.0, False),
    ],
)
def test_a_drives_own_limit_is_enough_where_arming_would_have_set_the_same(
    found_nm: float, limit_nm: float, step_nm: float, allowed: bool
) -> None:
    assert allows_torque(found_nm, limit_nm, step_nm) == allowed
    if step_nm in (0.0, 1.0):  # and arming says the same
        axis = modbus_axis("u16" if step_nm else "f32", limit_nm, 0.1, writable=False)
        found = [one for check in axis.proofs.identity if check.register.address == 22 for one in check.judge(found_nm)]
        assert [one.code for one in found] == ([] if allowed else ["max-torque-too-low"])


def test_torques_are_scaled_by_the_files_rated_torque_unless_the_drive_has_another() -> None:
    assert [scaling_rated_nm(found, 80.0) for found in (None, 80.05, 60.0)] == [80.0, 80.0, 60.0]
