"""One drive's state from frames and times, without a bus."""

import struct

import pytest

from drivers.canopen.configure import DriveSettings
from drivers.canopen.drive import DriveNode
from drivers.canopen.maps import DriveMap
from drivers.device_map import MAPS, load_map
from drivers.map_fields import Bit
from drivers.power_stage import ORDERS_IGNORED
from gateway.core.finding import finding
from gateway.core.signals import DriveRequest, DriveState

CIA402 = load_map(MAPS / "cia402-torque.toml")
assert isinstance(CIA402, DriveMap)
ENABLED, SWITCH_ON_DISABLED = 0x1237, 0x0250


def node(device: DriveMap = CIA402) -> DriveNode:
    drive = DriveNode("drive-1", 0, device, DriveSettings(1, 80.0, 60.0, 0.1), radius_m=0.04)
    drive.station.on_heartbeat(b"\x05", 0.0)
    return drive


def answer(drive: DriveNode, statusword: int) -> DriveState:
    drive.begin_sync()
    drive.on_answer(0x181, struct.pack("<Hih", statusword, 0, 0))
    drive.station.end_sync()
    return drive.state(0.0)


def test_a_drive_that_ignores_its_target_is_not_enabled() -> None:
    drive = node()
    assert answer(drive, ENABLED) == DriveState.ENABLED
    assert answer(drive, ENABLED & ~(1 << 12)) == DriveState.READY
    assert drive.payload(DriveRequest.ENABLE, 8.0, drive.state(0.0))[:4] == struct.pack("<Hh", 0x0F, 0)
    without = CIA402.model_copy(update={"follows_command": None})
    assert answer(node(without), ENABLED & ~(1 << 12)) == DriveState.ENABLED
    inverted = CIA402.model_copy(update={"follows_command": Bit(bit=12, inverted=True)})
    assert answer(node(inverted), ENABLED) == DriveState.READY


def test_safe_torque_off_in_the_pdo() -> None:
    transmit = CIA402.transmit_pdo.model_copy(update={"objects": ["statusword", "safe_torque_off", "torque", "speed"]})
    objects = CIA402.objects.model_copy(
        update={"speed": CIA402.objects.speed.model_copy(update={"type": "i16", "unit": "mm/s"})}
    )
    # 2 + 4 + 2 + 2 bytes do not fit a frame; the codec does not mind.
    drive = node(CIA402.model_copy(update={"transmit_pdo": transmit, "objects": objects}))
    for inputs, state in ((1 << 16, DriveState.STO), (0, DriveState.OFF)):
        drive.begin_sync()
        drive.on_answer(0x181, struct.pack("<HIhh", SWITCH_ON_DISABLED, inputs, 0, 0))
        assert drive.state(0.0) == state


def test_heartbeats_end_at_one_and_a_half_producer_times() -> None:
    drive = node()
    answer(drive, ENABLED)
    assert drive.state(0.15) == DriveState.ENABLED
    assert drive.state(0.1501) == DriveState.ABSENT
    drive.station.on_heartbeat(b"\x85", 0.2)  # bit 7 is no part of the state
    assert drive.state(0.3) == DriveState.ENABLED


def test_a_drive_without_torque_may_be_late_with_its_heartbeat() -> None:
    drive = node()
    answer(drive, SWITCH_ON_DISABLED)
    assert drive.state(0.3) == DriveState.OFF
    assert drive.state(0.3001) == DriveState.ABSENT
    drive.payload(DriveRequest.ENABLE, 0.0, DriveState.OFF)
    assert drive.state(0.1501) == DriveState.ABSENT


def test_never_heard_is_absent() -> None:
    drive = DriveNode("drive-1", 0, CIA402, DriveSettings(1, 80.0, 60.0, 0.1), radius_m=0.04)
    assert drive.state(0.0) == DriveState.ABSENT


def test_an_emergency_ends_with_its_reset() -> None:
    drive = node()
    answer(drive, ENABLED)
    drive.station.on_emergency(bytes.fromhex("5082 11 0000000000"))
    trouble = drive.trouble(0.0)
    assert drive.state(0.0) == DriveState.FAULT and trouble is not None and trouble.parameters["error_code"] == 0x8250
    assert drive.payload(DriveRequest.ENABLE, 8.0, DriveState.FAULT)[:4] == bytes(4)
    drive.station.on_emergency(bytes(8))
    assert drive.state(0.0) == DriveState.ENABLED


@pytest.mark.parametrize("size", [0, 2, 7, 9])
def test_wrong_lengths_are_refused(size: int) -> None:
    drive = node()
    with pytest.raises(ValueError, match="EMCY"):
        drive.station.on_emergency(bytes(size))
    with pytest.raises(ValueError, match="heartbeat"):
        drive.station.on_heartbeat(bytes(size), 0.0)
    assert drive.station.emergency is drive.station.distrust is None


def test_before_the_first_answer_no_word_enables() -> None:
    drive = node()
    for request in DriveRequest:
        assert drive.payload(request, 8.0, DriveState.ENABLED)[:2] == bytes(2)


def test_a_drive_that_ignores_its_orders_defies() -> None:
    drive = node()
    for _ in range(ORDERS_IGNORED + 1):
        answer(drive, ENABLED)
        assert drive.shows_torque and not drive.defies
        drive.payload(DriveRequest.OFF, 0.0, drive.state(0.0))
    assert drive.defies == finding("orders-ignored", drive="drive-1", orders=ORDERS_IGNORED)
    drive.forget()
    assert not drive.defies and not drive.shows_torque


def test_no_answer_shows_no_torque() -> None:
    drive = node()
    answer(drive, ENABLED)
    drive.begin_sync()
    assert not drive.shows_torque, "what it said before may be over"
