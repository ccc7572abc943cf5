"""What a simulated drive falls short of though it says that all is well: at the drive, and by the words of faults."""

from pathlib import Path

import numpy as np
import pytest

import sim_plant
from sim_plant.devices.amplifier import Amplifier
from sim_plant.devices.cia402 import State
from sim_plant.devices.drive import Drive, DriveSample
from sim_plant.devices.line_plc import LinePlc
from sim_plant.faults.injector import Injector
from sim_plant.faults.parse import FaultRefused, parse_fault
from sim_plant.faults.stepped import injector_of
from sim_plant.faults.targets import FaultyLine
from sim_plant.plant import load_plant
from sim_plant.recorder import Recorder
from sim_plant.stepped import SteppedLine
from sim_plant.world import World

PLANT = load_plant(Path(sim_plant.__file__).parent / "plants" / "s_real.toml")
SHUTDOWN, SWITCH_ON, ENABLE, CST = 0x06, 0x07, 0x0F, 10
POWER, WARNING, FOLLOWS = 1 << 4, 1 << 7, 1 << 12


class Rig:
    """Two drives, of which the second is the one of the test, and the faults of their line."""

    def __init__(self) -> None:
        self.world = World(PLANT, seed=1)
        self.recorder = Recorder(self.world)
        drives = [Drive(k, self.world, self.recorder, 60.0, 60.0) for k in range(2)]
        self.drive = drives[1]
        self.drive.operational = True
        self.warnings: list[tuple[int, int]] = []
        self.drive.on_warning = lambda code, register: self.warnings.append((code, register))
        line = FaultyLine(2, drives, Amplifier(self.world), LinePlc(self.world, self.recorder))
        self.faults = Injector(line, self.recorder.note, self.world.timer)
        self.now_s = 0.0

    def inject(self, text: str) -> None:
        self.faults.add(parse_fault(text), self.now_s)

    def command(self, word: int, torque_nm: float = 0.0) -> DriveSample:
        self.drive.receive(word, torque_nm, CST, self.now_s)
        sample = self.drive.sync(self.now_s)
        self.now_s += 0.01
        return sample

    def enable(self, torque_nm: float = 5.0) -> DriveSample:
        self.command(SHUTDOWN)
        self.command(ENABLE, torque_nm)
        return self.command(ENABLE, torque_nm)


@pytest.mark.parametrize(("share", "given_nm"), [(0.0, 0.0), (0.1, 0.5), (3.0, 15.0), (-1.0, -5.0), (10.0, 50.0)])
def test_a_drive_gives_a_share_of_its_torque_and_reports_it(share: float, given_nm: float) -> None:
    rig = Rig()
    rig.inject(f"drive 2 torque-share share={share} for 0.05")
    sample = rig.enable()
    assert sample.torque_nm == pytest.approx(given_nm) and sample.statusword & FOLLOWS
    assert rig.world.torque_nm[1] == pytest.approx(given_nm)
    rig.world.advance(0.06)
    assert rig.command(ENABLE, 5.0).torque_nm == 5.0, "the fault is over"


def test_a_share_stays_within_what_the_drive_can_give() -> None:
    rig = Rig()
    rig.inject("drive 2 torque-share share=10")
    assert rig.enable(20.0).torque_nm == 60.0


@pytest.mark.parametrize(("says", "bit"), [("ignores", 0), ("follows", FOLLOWS)])
def test_a_drive_that_loses_its_mode_stays_enabled_and_gives_nothing(says: str, bit: int) -> None:
    rig = Rig()
    rig.enable()
    rig.inject(f"drive 2 mode-lost mode=8 says={says} for 0.1")
    assert rig.world.torque_nm[1] == 0.0 and rig.drive.mode == 8
    sample = rig.command(ENABLE, 5.0)
    assert sample.torque_nm == 0.0 and rig.drive.state is State.OPERATION_ENABLED
    assert sample.statusword & FOLLOWS == bit
    rig.now_s = 0.2
    assert rig.command(ENABLE, 7.0).torque_nm == 7.0 and rig.drive.mode == CST


def test_a_drive_without_power_goes_no_further_than_ready() -> None:
    rig = Rig()
    rig.inject("drive 2 no-power for 0.1")
    sample = rig.enable()
    assert rig.drive.state is State.READY_TO_SWITCH_ON and not sample.statusword & POWER
    rig.now_s = 0.2
    assert rig.enable().torque_nm == 5.0


def test_power_that_fails_takes_torque_off() -> None:
    rig = Rig()
    rig.enable()
    rig.inject("drive 2 no-power")
    assert rig.world.torque_nm[1] == 0.0 and rig.drive.state is State.SWITCH_ON_DISABLED


def test_a_warning_is_told_and_taken_back_and_takes_nothing_off() -> None:
    rig = Rig()
    rig.enable()
    rig.inject("drive 2 drive-warning code=0x3110 register=4 for 0.1")
    sample = rig.command(ENABLE, 5.0)
    assert sample.statusword & WARNING and sample.torque_nm == 5.0
    assert (rig.drive.shown_code, rig.drive.error_code) == (0x3110, 0)
    rig.world.advance(0.2)
    assert rig.warnings == [(0x3110, 4), (0, 0)] and rig.drive.shown_code == 0


# in stepped time, without drives of its own


def stepped() -> tuple[SteppedLine, Injector, np.ndarray]:
    line = SteppedLine(PLANT, 1, 0.0)
    torque_nm = line.start_at_equilibrium(np.full(PLANT.spans, 20.0), 0.05)
    return line, injector_of(line), torque_nm


@pytest.mark.parametrize(("text", "share"), [("torque-share share=0.5", 0.5), ("mode-lost", 0.0)])
def test_in_stepped_time_a_drive_gives_a_share_too(text: str, share: float) -> None:
    line, faults, torque_nm = stepped()
    faults.add(parse_fault(f"drive 2 {text} for 0.05"), 0.0)
    everyone = np.ones(PLANT.spans, np.bool_)
    for now_s, wanted in ((0.01, share), (0.1, 1.0)):
        line.sample(now_s)
        line.apply(torque_nm, everyone, 0.05, True, now_s)
        sample = line.sample(now_s)
        assert sample.torque_nm[1] == pytest.approx(wanted * torque_nm[1]) and sample.enabled[1]
        assert sample.torque_nm[0] == torque_nm[0]


def test_in_stepped_time_a_drive_without_power_cannot_be_enabled() -> None:
    line, faults, torque_nm = stepped()
    faults.add(parse_fault("drive 2 no-power for 0.05"), 0.0)
    nobody, everyone = np.zeros(PLANT.spans, np.bool_), np.ones(PLANT.spans, np.bool_)
    for now_s, enabled in ((0.01, False), (0.1, True)):
        line.apply(0 * torque_nm, nobody, 0.05, True, now_s)  # told off, then on
        line.apply(torque_nm, everyone, 0.05, True, now_s)
        assert line.sample(now_s).enabled[1] == enabled


def test_in_stepped_time_nobody_can_warn() -> None:
    _, faults, _ = stepped()
    with pytest.raises(FaultRefused, match="no words to warn with"):
        faults.add(parse_fault("drive 2 drive-warning"), 0.0)


def test_a_drive_cannot_fall_short_in_two_ways_of_its_torque_at_once() -> None:
    rig = Rig()
    rig.inject("drive 2 mode-lost")
    with pytest.raises(FaultRefused):
        rig.inject("drive 2 torque-share share=2")
