"""One axis on Modbus: registers worked out by hand, units, and what a map of a drive may not say."""

import struct
from collections.abc import Callable
from math import pi
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from drivers.device_map import MAPS, MapRefused, load_map
from drivers.modbus.axis import Axis, AxisSettings
from drivers.modbus.device import Standing
from drivers.modbus.maps import DriveMap
from gateway.core.finding import finding
from gateway.core.signals import DriveRequest, DriveState, Inputs, Outputs, Quality

SINGLE, RACK = (load_map(MAPS / f"{name}.toml") for name in ("r2r-drive-modbus", "r2r-rack-drive"))
SETTINGS = AxisSettings(channel=1, rated_torque_nm=80.0, torque_limit_nm=60.0, watchdog_s=0.1, radius_m=0.04)


def axis(device: object = SINGLE, **settings: Any) -> Axis:
    assert isinstance(device, DriveMap)
    values = {name: getattr(SETTINGS, name) for name in SETTINGS.__slots__} | settings
    return Axis("drive-1", 0, device, AxisSettings(**values))


def heard(of: Axis, *numbers: float, standing: Standing | None = None) -> Inputs:
    inputs = Inputs(1)
    of.fill(inputs, numbers, standing or Standing(active=True), 1.0)
    return inputs


def wanted(request: DriveRequest, torque_nm: float) -> Outputs:
    outputs = Outputs(1)
    outputs.drive_request[:], outputs.torque_nm[:] = request, torque_nm
    return outputs


@pytest.mark.parametrize(
    ("channel", "reads", "write"),
    [
        (1, [(8, "u16"), (9, "i32"), (11, "i16"), (12, "u16")], (204, 2)),
        (3, [(24, "u16"), (25, "i32"), (27, "i16"), (28, "u16")], (208, 2)),
        (14, [(112, "u16"), (113, "i32"), (115, "i16"), (116, "u16")], (230, 2)),
    ],
)
def test_each_channel_has_its_registers(channel: int, reads: list[tuple[int, str]], write: tuple[int, int]) -> None:
    of = axis(RACK, channel=channel)
    assert list(of.wish.reads) == reads and of.wish.write == write
    shared = [setting.register.address for setting in of.proofs.settings]
    assert shared == [301], "what is of every axis is not shifted"


@given(st.integers(-(2**31), 2**31 - 1), st.integers(-32_000, 32_000))
def test_si_round_trip(speed: int, torque: int) -> None:
    of = axis()
    inputs = heard(of, 0x1237, speed, torque, 0, 0)
    assert round(inputs.speed.value[0] * 1e6) == speed
    registers = of.command(wanted(DriveRequest.ENABLE, float(inputs.torque.value[0])))
    assert registers == [0x0F, *struct.unpack(">H", struct.pack(">h", torque))]


def test_an_angular_speed_becomes_web_speed() -> None:
    assert isinstance(SINGLE, DriveMap)
    speed = SINGLE.read.speed.model_copy(update={"unit": "rpm", "scale": 0.1})
    rpm = SINGLE.model_copy(update={"read": SINGLE.read.model_copy(update={"speed": speed})})
    assert heard(axis(rpm), 0, 600, 0, 0, 0).speed.value[0] == pytest.approx(2 * pi * 0.04)


def test_states() -> None:
    of = axis()
    assert heard(of, 0x0250, 0, 0, 1, 0).drive_state[0] == DriveState.STO
    assert heard(of, 0x0250, 0, 0, 0, 0).drive_state[0] == DriveState.OFF
    assert heard(of, 0x1237, 0, 0, 0, 0).drive_state[0] == DriveState.ENABLED
    inputs = Inputs(1)
    for missed in (1, 2, 3):
        of.fill(inputs, None, Standing(active=True, missed=missed), 1.0)
        expected = DriveState.ENABLED if missed < 3 else DriveState.ABSENT
        assert inputs.drive_state[0] == expected and inputs.speed.quality[0] == Quality.MISSING
    distrusted = Standing(active=True, distrust=[finding("device-unanswered", device="drive-1", cycles=3)])
    assert heard(of, 0x1237, 0, 0, 0, 0, standing=distrusted).drive_state[0] == DriveState.FAULT


@pytest.mark.parametrize("statusword", [0x1237, 0x0231, 0x0233, 0x0217, 0x0250])
def test_safe_torque_off_is_no_torque_whatever_the_statusword_says(statusword: int) -> None:
    of = axis()
    assert heard(of, statusword, 0, 0, 1, 0).drive_state[0] == DriveState.STO
    assert of.command(wanted(DriveRequest.ENABLE, 8.0))[1] == 0
    assert heard(of, 0x0218, 0, 0, 1, 0).drive_state[0] == DriveState.FAULT


def test_a_fault_is_told_once_with_its_code() -> None:
    of, standing = axis(), Standing(active=True)
    inputs = Inputs(1)
    assert of.fill(inputs, (0x0218, 0, 0, 0, 0x8250), standing, 1.0) == [
        "drive-1: fault, statusword 0218h, error code 0x8250 (communication watchdog)"
    ]
    assert of.fill(inputs, (0x0218, 0, 0, 0, 0x8250), standing, 1.0) == []
    assert of.fill(inputs, (0x0218, 0, 0, 0, 0x2310), standing, 1.0) == [
        "drive-1: fault, statusword 0218h, error code 0x2310"
    ]


def test_what_the_drive_cannot_do_is_refused() -> None:
    with pytest.raises(ValueError, match=r"10 to 1000 ms"):
        axis(watchdog_s=0.005)
    assert isinstance(SINGLE, DriveMap)
    writable = SINGLE.max_torque.model_copy(update={"writable": True})
    device = SINGLE.model_copy(update={"max_torque": writable})
    (maximum, watchdog) = axis(device).proofs.settings
    assert (maximum.counts, watchdog.counts) == (750, 100), "60 of 80 Nm; 100 ms"
    with pytest.raises(ValueError, match=r"limits.torque_nm = 6000"):
        axis(device, torque_limit_nm=6000.0)


# maps


def refused(tmp_path: Path, name: str, change: Callable[[str], str]) -> str:
    text = (MAPS / f"{name}.toml").read_text()
    assert change(text) != text, "the change did not apply"
    (tmp_path / f"{name}.toml").write_text(change(text))
    with pytest.raises(MapRefused) as refusal:
        load_map(tmp_path / f"{name}.toml")
    return " / ".join(refusal.value.reasons)


@pytest.mark.parametrize(
    ("name", "old", "new", "said"),
    [
        ("r2r-drive-modbus", "address = 11,", "address = 12,", "write: the registers must lie side by side"),
        ("r2r-drive-modbus", "address = 11,", "address = 10,", "write.target_torque: register 10 is already write.con"),
        ("r2r-drive-modbus", "statusword = { address = 1 }", "statusword = { address = 4 }", "read.torque: register 4"),
        ("r2r-drive-modbus", "range = [10, 1000]", "range = [10, 70000]", "watchdog.range: [10.0, 70000.0] does not"),
        ("r2r-drive-modbus", "address = 5, bit = 0", "address = 5, bit = 16", "read.safe_torque_off.bit: 16 is not"),
        ("r2r-drive-modbus", '"u32", unit = "mNm"', '"u32", unit = "rated torque"', "rated_torque.unit"),
        ("r2r-drive-modbus", ", writable = false", "", "max_torque.writable: is missing"),
        ("r2r-drive-modbus", "0x8250 =", "watchdog =", "read.error_code.texts: 'watchdog' is no number"),
        (
            "r2r-drive-modbus",
            "address = 10 }",
            'address = 10, type = "u32" }',
            "write.controlword.type: u32; allowed: u16",
        ),
        ("r2r-rack-drive", "read_stride = 8", "read_stride = 4", "axes.read_stride: 4; `read` takes 5 registers"),
        ("r2r-rack-drive", "write_stride = 2", "write_stride = 1", "axes.write_stride: 1; `write` takes 2 registers"),
        ("r2r-rack-drive", 'family = "r2r-rack"', 'family = "R2R rack"', "family: 'R2R rack'"),
        ("r2r-rack-drive", "family =", "familly =", "familly: unknown key"),
    ],
)
def test_what_is_wrong_in_a_map_is_named(tmp_path: Path, name: str, old: str, new: str, said: str) -> None:
    assert said in refused(tmp_path, name, lambda text: text.replace(old, new, 1))
