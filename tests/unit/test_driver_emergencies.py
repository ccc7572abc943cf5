"""Which emergency messages are faults, which are warnings: by the map, the statusword, the error register."""

import struct
from pathlib import Path

import pytest

from drivers.canopen.emergencies import Emergency, EmergencyClass, class_of
from drivers.canopen.map_parts import EmergencyClasses, HeartbeatObject
from drivers.canopen.station import STATUSWORDS_AWAITED, Station
from drivers.device_map import MAPS, MapRefused, load_map

FAULT, WARNING, AS_STATUSWORD = EmergencyClass.FAULT, EmergencyClass.WARNING, EmergencyClass.AS_STATUSWORD
HEARTBEAT = HeartbeatObject(index=0x1017, type="u16", unit="ms", range=[10, 10000], value=100)
WARM = struct.pack("<HB5s", 0x4210, 0x08, b"")
OVER = bytes(8)


@pytest.mark.parametrize(
    ("faults", "warnings", "code", "register", "drive", "other"),
    [
        ([], [], 0x4210, 0x08, AS_STATUSWORD, WARNING),
        ([], [], 0x4210, 0x09, AS_STATUSWORD, FAULT),
        ([0x4210], [], 0x4210, 0x08, FAULT, FAULT),
        ([0x4200], [], 0x4210, 0x08, FAULT, FAULT),
        ([0x4000], [0x4210], 0x4210, 0x09, WARNING, WARNING),
        ([0x4210], [0x4000], 0x4210, 0x08, FAULT, FAULT),
        ([0x4200], [0x4200 | 0x20], 0x4220, 0x09, WARNING, WARNING),
        ([0x4300, 0x5000], [0x4211], 0x4210, 0x09, AS_STATUSWORD, FAULT),
    ],
)
def test_the_map_goes_before_what_the_device_says(
    faults: list[int], warnings: list[int], code: int, register: int, drive: EmergencyClass, other: EmergencyClass
) -> None:
    classes = EmergencyClasses(faults=faults, warnings=warnings)
    assert class_of(Emergency(code, register), classes, has_statusword=True) is drive
    assert class_of(Emergency(code, register), classes, has_statusword=False) is other


def drive(**classes: list[int]) -> Station:
    return Station("drive-2", 2, HEARTBEAT, classes=EmergencyClasses(**classes), has_statusword=True)


def test_an_emergency_of_a_drive_that_goes_on_is_a_warning() -> None:
    node = drive()
    node.on_emergency(WARM)
    told = node.emergency_told
    assert told is not None and told.code == "emergency-message"
    assert (told.parameters["error_code"], told.parameters["register"]) == (0x4210, 0x08)
    for _ in range(STATUSWORDS_AWAITED):
        assert node.warning is None, "the statusword may be of before"
        node.on_statusword(in_fault=False)
    assert node.warning is not None and node.warning.number == 0x084210
    trouble = node.trouble(0.0, relied_on=False)
    assert not node.emergency and trouble is not None and trouble.code == "heartbeat-lost"
    node.on_emergency(OVER)
    assert node.warning is None and not node.emergency_told


@pytest.mark.parametrize("late", range(STATUSWORDS_AWAITED))
def test_one_of_a_drive_that_goes_to_fault_is_its_cause(late: int) -> None:
    node = drive()
    node.on_emergency(WARM)
    for _ in range(late):
        node.on_statusword(in_fault=False)
    node.on_statusword(in_fault=True)
    assert node.emergency is not None and node.emergency.parameters["error_code"] == 0x4210 and node.warning is None
    node.recover()
    assert not node.emergency and not node.emergency_told


def test_a_code_that_the_map_calls_a_fault_is_one_at_once() -> None:
    node = drive(faults=[0x4210])
    node.on_emergency(WARM)
    assert node.emergency is not None and node.emergency.parameters["error_code"] == 0x4210


def test_a_device_without_statusword_goes_by_its_error_register() -> None:
    amplifier = Station("cell-1", 5, HEARTBEAT)
    amplifier.on_emergency(WARM)
    assert amplifier.warning is not None and not amplifier.emergency
    amplifier.on_emergency(struct.pack("<HB5s", 0x4210, 0x09, b""))
    assert amplifier.emergency


def test_a_code_in_two_classes_is_refused(tmp_path: Path) -> None:
    text = (MAPS / "cia402-torque.toml").read_text(encoding="utf-8")
    (tmp_path / "drive.toml").write_text(text.replace("faults = [0x8250]", "faults = [0x8250]\nwarnings = [0x8250]"))
    with pytest.raises(MapRefused) as refusal:
        load_map(tmp_path / "drive.toml")
    assert "8250h is among faults and warnings" in refusal.value.reasons[0]
