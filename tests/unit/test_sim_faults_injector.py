"""Faults on a line in stepped time and on its devices: what they do is seen at the devices, and noted."""

from math import isnan

import numpy as np
import pytest

from gateway.core.states import LoopState, Phase
from sim_plant.devices.amplifier import Amplifier
from sim_plant.devices.drive import Drive
from sim_plant.devices.line_plc import LinePlc
from sim_plant.faults.can_frames import CanFrames
from sim_plant.faults.frames import Direction
from sim_plant.faults.injector import Injector, Listed
from sim_plant.faults.mbap_frames import MbapFrames
from sim_plant.faults.parse import FaultRefused, parse_fault
from sim_plant.faults.stepped import injector_of
from sim_plant.faults.targets import FaultyLine, Place
from sim_plant.faults.wire_faults import WireFaults
from sim_plant.faults.wired import WiredFaults, places_of
from sim_plant.plant import load_plant
from sim_plant.recorder import Recorder
from sim_plant.stepped import Sample, SteppedLine
from sim_plant.world import World
from tests.closed_loop.conftest import start, stepped

PLANT = load_plant("sim_plant/plants/s_real.toml")
ENABLE, TENSION_N, SPEED_M_PER_S = 0x0F, 20.0, 0.05


class Rig:
    """A line in production with its faults; torque is held."""

    def __init__(self) -> None:
        self.line = SteppedLine(PLANT, 1, 0.0)
        self.torque_nm = self.line.start_at_equilibrium(np.full(PLANT.spans, TENSION_N), SPEED_M_PER_S)
        self.faults = injector_of(self.line)

    def at(self, now_s: float) -> Sample:
        sample = self.line.sample(now_s)
        self.line.apply(self.torque_nm, np.ones(PLANT.spans, dtype=np.bool_), SPEED_M_PER_S, True, now_s)
        return sample

    def inject(self, text: str) -> int:
        return self.faults.add(parse_fault(text), self.line.world.now_s)

    def clear(self, number: int | None = None) -> list[int]:
        return self.faults.clear(number, self.line.world.now_s)

    def noted(self) -> list[tuple[str, float, str]]:
        return [
            (event["kind"], round(event["time_s"], 6), event["fault"])
            for event in self.line.recorder.events
            if event["kind"].startswith("fault-")
        ]


@pytest.fixture
def rig() -> Rig:
    return Rig()


def test_a_fault_comes_and_goes_at_its_millisecond_and_is_noted(rig):
    text = "load-cell 3 nan at 0.1 for 0.05"
    rig.inject(text)
    assert [isnan(rig.at(ms / 1000).tension_n[2]) for ms in (99, 100, 149, 150)] == [False, True, True, False]
    assert rig.noted() == [("fault-injected", 0.1, text), ("fault-cleared", 0.15, text)]


def test_times_are_kept_between_two_looks_at_the_line(rig):
    rig.inject("drive 2 drive-fault at 0.013")
    rig.inject("load-cell 1 nan at 0.012 for 0.003")
    rig.at(0.02)
    assert [event[1] for event in rig.noted()] == [0.012, 0.013, 0.015]
    (off,) = (e for e in rig.line.recorder.events if e["kind"] == "drive_state" and e["time_s"] > 0.0)
    assert off["time_s"] == pytest.approx(0.013) and off["roller"] == 2


def test_a_fault_without_a_time_is_there_at_once_until_it_is_cleared(rig):
    rig.at(0.05)
    number = rig.inject("load-cell 1 out-of-range tension_n=500")
    assert rig.at(0.05).tension_n[0] == 500.0 and rig.at(0.5).tension_n[0] == 500.0
    assert rig.faults.listed() == [Listed(number, "load-cell 1 out-of-range tension_n=500", True, 0.05, None)]
    assert rig.clear(number) == [number]
    assert rig.at(0.5).tension_n[0] < 100.0 and rig.faults.listed() == []


def test_stuck_stands_still_and_is_true_again(rig):
    number = rig.inject("load-cell 2 stuck")
    shown = {rig.at(ms / 1000).tension_n[1] for ms in range(1, 20)}
    assert len(shown) == 1
    rig.clear(number)
    assert rig.at(0.02).tension_n[1] not in shown


@pytest.mark.parametrize(
    ("text", "error_n"),
    [("offset by_n=3", {100: 3.0, 600: 3.0}), ("drift rate_n_per_s=-10", {100: 0.0, 600: -5.0})],
)
def test_offset_and_drift(rig, text, error_n):
    other = Rig()
    rig.inject(f"load-cell 4 {text} at 0.1")
    for ms, expected in error_n.items():
        error = rig.at(ms / 1000).tension_n - other.at(ms / 1000).tension_n
        assert error[3] == pytest.approx(expected, abs=1e-9)
        assert not np.delete(error, 3).any()


def test_a_spike_is_in_the_one_measurement_that_is_read_next(rig):
    other = Rig()
    rig.inject("load-cell 4 spike height_n=30 at 0.0955")
    errors = [rig.at(ms / 1000).tension_n[3] - other.at(ms / 1000).tension_n[3] for ms in (90, 100, 110, 120)]
    assert errors == pytest.approx([0.0, 30.0, 0.0, 0.0])


def test_encoders_jump_and_freeze(rig):
    other = Rig()
    rig.inject("drive 2 encoder-jump delta_m_per_s=0.05 at 0.1 for 0.01")
    rig.inject("drive 3 encoder-frozen at 0.1 for 0.05")
    off = [rig.at(ms / 1000).speed_m_per_s[1] - other.at(ms / 1000).speed_m_per_s[1] for ms in (99, 100, 109, 110)]
    assert off == pytest.approx([0.0, 0.05, 0.05, 0.0])
    frozen = {rig.at(ms / 1000).speed_m_per_s[2] for ms in range(110, 150)}
    assert len(frozen) == 1 and rig.at(0.151).speed_m_per_s[2] not in frozen


@pytest.mark.parametrize("text", ["drive 2 drive-fault", "drive 2 sto for 0.1", "drive 2 restart"])
def test_what_takes_torque_off(rig, text):
    rig.at(0.1)
    rig.inject(text)
    sample = rig.at(0.1)
    assert list(sample.enabled) == [True, False, True, True, True, True]
    assert sample.torque_nm[1] == 0.0
    assert not rig.at(0.3).enabled[1]  # it was not told off since


def test_the_plc_is_stopped_and_lets_go_again(rig):
    rig.at(0.1)
    rig.inject("plc emergency-stop for 0.2")
    rig.inject("plc permissive-lost for 0.1")
    seen = [rig.at(ms / 1000) for ms in (150, 250, 350)]
    assert [sample.emergency_stop for sample in seen] == [True, True, False]
    assert [sample.permissive for sample in seen] == [False, True, True]
    assert not seen[2].running  # nothing restarts because a button was released


def test_a_web_break_and_its_repair(rig):
    rig.at(0.1)
    number = rig.inject("web 3 web-break")
    rig.at(0.102)
    assert rig.line.world.tension_n[2] == 0.0
    rig.clear(number)
    rig.at(0.2)
    assert rig.line.world.tension_n[2] > 0.0


def test_slack_takes_the_tension_of_its_span(rig):
    healthy = Rig()
    rig.inject("web 5 slack length_m=0.01 at 0.1")
    for each in (rig, healthy):
        each.at(0.1)
    assert rig.line.world.tension_n[4] == 0.0 and healthy.line.world.tension_n[4] > 0.9 * TENSION_N


def test_a_bearing_grows_stiff_and_is_as_before(rig):
    healthy = Rig()
    rig.inject("web 4 friction-rise factor=100 at 0.1 for 0.1")
    lag_m_per_s = {}
    for ms in (100, 110, 200, 2200):
        for each in (rig, healthy):
            each.at(ms / 1000)
        lag_m_per_s[ms] = healthy.line.world.speed_m_per_s[3] - rig.line.world.speed_m_per_s[3]
    assert abs(lag_m_per_s[100]) < 1e-9 < 1e-4 < lag_m_per_s[110]
    assert abs(lag_m_per_s[2200]) < 0.1 * lag_m_per_s[110]


def test_the_web_slips_on_a_roller_that_does_not_hold_it(rig):
    rig.inject("web 2 slip factor=0")
    rig.at(0.3)
    world = rig.line.world
    assert abs(world.speed_m_per_s[1] - world.surface_speed_m_per_s[1]) > 1e-5
    assert world.tension_n[1] == pytest.approx(world.tension_n[2], abs=0.5)  # nothing holds the web there


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("drive 7 sto", "allowed: 1 to 6"),
        ("web 6 slip factor=0.1", "the last roller is a nip or a reel"),
        ("drive 1 mute", "is on no wire of this line"),
        ("canopen mute", "this line has no wire canopen; allowed: none"),
        ("drive 1 watchdog-dead", "has no communication watchdog here"),
        ("load-cell 1 restart", "what can: drive 1, drive 2"),
    ],
)
def test_what_a_line_does_not_have_is_refused_and_not_noted(rig, text, said):
    with pytest.raises(FaultRefused, match=said):
        rig.inject(text)
    assert rig.noted() == [] and rig.faults.listed() == []


def test_clearing_all_ends_what_acts_and_forgets_what_waits(rig):
    rig.inject("load-cell 1 nan")
    rig.inject("load-cell 2 nan at 5")
    assert rig.clear() == [1, 2] and rig.clear() == []
    assert not np.isnan(rig.at(6.0).tension_n).any()
    with pytest.raises(FaultRefused, match="there is no fault 1"):
        rig.clear(1)


def test_the_loop_stops_the_line_when_a_load_cell_shows_no_number_and_nothing_unsafe_happens():
    loop = start(stepped())
    faults = injector_of(loop.truth)
    now_s = loop.now_s
    faults.add(parse_fault("load-cell 3 nan for 0.5"), now_s)
    loop.step(5)
    assert loop.cycle.machine.state is LoopState.STOP and "3" in loop.cycle.machine.reason
    assert loop.step_until(Phase.OFF, 12.0)
    loop.step(60)
    assert loop.truth.recorder.unsafe_total == 0
    assert [event["time_s"] for event in loop.truth.recorder.events if event["kind"] == "fault-cleared"] == [
        pytest.approx(now_s + 0.5)
    ]


# A line with drives and wires.


class WiredRig:
    """Two drives on CANopen as nodes 1 and 2, load cells behind Modbus unit 1."""

    def __init__(self) -> None:
        self.world = World(PLANT, 1)
        self.recorder = Recorder(self.world)
        self.drives = [Drive(index, self.world, self.recorder, 10.0, 20.0) for index in range(PLANT.spans)]
        self.canopen, self.modbus = WireFaults(CanFrames()), WireFaults(MbapFrames())
        self.booted: list[float] = []
        line = FaultyLine(
            spans=PLANT.spans,
            drives=self.drives,
            wires={"canopen": self.canopen, "modbus-tcp": self.modbus},
            places={("drive", 2): Place("canopen", 2), ("load-cell", 3): Place("modbus-tcp", 1)},
            restarts={("drive", 2): self.booted.append},
        )
        self.faults = Injector(line, self.recorder.note, self.world.timer)

    def inject(self, text: str) -> int:
        return self.faults.add(parse_fault(text), self.world.now_s)

    def passes(self, address: int, direction: Direction = Direction.FROM_DEVICE) -> bool:
        return bool(self.canopen.pass_(direction, address, (0x180 + address, b"x")))


def test_a_device_by_its_name_is_an_address_on_its_wire():
    rig = WiredRig()
    number = rig.inject("drive 2 mute")
    assert rig.passes(1) and not rig.passes(2) and not rig.passes(2, Direction.TO_DEVICE)
    rig.faults.clear(number, 0.0)
    assert rig.passes(2)
    cleared = rig.recorder.recording().of_kind("fault-cleared")
    assert [(event["number"], event["frames"]) for event in cleared] == [(number, 2)]


def test_an_address_that_nobody_has_is_refused_with_those_that_are_there():
    with pytest.raises(FaultRefused, match=r"canopen 77: nobody has this address; there are 2 \(drive 2\)"):
        WiredRig().inject("canopen 77 mute")


def test_a_wire_by_its_name_is_every_address_or_one():
    rig = WiredRig()
    rig.inject("canopen drop for 1")
    rig.inject("canopen 2 duplicate at 2")
    assert not rig.passes(1) and not rig.passes(2)
    rig.world.advance(2.0)
    frame = (0x181, b"x")
    assert rig.canopen.pass_(Direction.FROM_DEVICE, 2, frame) == [(0.0, frame)] * 2
    assert rig.canopen.pass_(Direction.FROM_DEVICE, 1, (0x181, b"x")) == [(0.0, (0x181, b"x"))]


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("opcua mute", "allowed: canopen, modbus-tcp"),
        ("load-cell 3 heartbeat-lost", "the frames of this wire have no such fault"),
        ("load-cell 3 sdo-abort", "the frames of this wire have no such fault"),
        ("load-cell 3 nan", "this line has no load cells"),
        ("plc emergency-stop", "this line has no line PLC"),
        ("plc mute", "plc is on no wire of this line"),
        ("web 1 web-break", "this line has no web"),
    ],
)
def test_what_a_wire_does_not_have_is_refused_before_its_time(text, said):
    with pytest.raises(FaultRefused, match=said):
        WiredRig().inject(f"{text} at 5")


def enabled_drive(rig: WiredRig) -> Drive:
    drive = rig.drives[1]
    drive.operational = True
    drive.watchdog_s = 0.05
    for controlword in (0x06, 0x07, ENABLE):
        drive.receive(controlword, 1.0, 10, rig.world.now_s)
        drive.sync(rig.world.now_s)
    assert drive.state.name == "OPERATION_ENABLED"
    return drive


def test_a_dead_watchdog_never_fires_and_a_living_one_does():
    alive, dead = WiredRig(), WiredRig()
    dead.inject("drive 2 watchdog-dead")
    for rig, torque_nm in ((alive, 0.0), (dead, 1.0)):
        drive = enabled_drive(rig)
        rig.world.advance(1.0)
        assert drive.watchdog_s == 0.05 and rig.world.torque_nm[1] == torque_nm


def test_sto_is_held_as_long_as_it_lasts():
    rig = WiredRig()
    drive = enabled_drive(rig)
    rig.inject("drive 2 sto for 0.02")
    assert drive.sto and rig.world.torque_nm[1] == 0.0
    rig.world.advance(0.02)
    assert not drive.sto and drive.state.name == "SWITCH_ON_DISABLED"


def test_a_drive_faults_with_its_code_and_restarts_at_its_time():
    rig = WiredRig()
    drive = enabled_drive(rig)
    rig.inject("drive 2 drive-fault code=0x3210 at 0.01")
    rig.inject("drive 2 restart at 0.02")
    rig.world.advance(0.03)
    assert drive.error_code == 0x3210 and rig.booted == [pytest.approx(0.02)]


def test_every_device_of_a_plant_is_met_at_the_address_of_its_wires():
    wires = PLANT.wires.model_copy(
        update={
            "drives": ["canopen", "canopen", "modbus-tcp", "rack", "opcua", "opcua"],
            "load_cells": ["canopen", "modbus-tcp", "rack", "opcua", "canopen", "canopen"],
            "plc": "rack",
        }
    )
    places = places_of(PLANT.model_copy(update={"wires": wires}))
    can, modbus, opcua = "canopen", "modbus-tcp", Place("opcua", None)
    assert [places["drive", k] for k in range(1, 7)] == [
        Place(can, 1), Place(can, 2), Place(modbus, 13), Place(modbus, 3), opcua, opcua,
    ]  # fmt: skip
    assert [places["load-cell", k] for k in range(1, 7)] == [
        Place(can, 101), Place(modbus, 1), Place(modbus, 3), opcua, Place(can, 101), Place(can, 101),
    ]  # fmt: skip
    assert places["plc", 0] == Place(modbus, 3) and len(places) == 13


def test_the_ninth_load_cell_is_on_the_second_amplifier():
    wires = PLANT.wires.model_copy(update={"load_cells": "canopen"})
    places = places_of(PLANT.model_copy(update={"spans": 9, "wires": wires}))
    assert [places["load-cell", k].address for k in (8, 9)] == [101, 102]


def test_faults_of_a_whole_line_come_before_the_request_that_they_meet():
    world = World(PLANT, 1)
    recorder = Recorder(world)
    drives = [Drive(index, world, recorder, 10.0, 20.0) for index in range(PLANT.spans)]
    devices = (drives, Amplifier(world), LinePlc(world, recorder))
    now_s, booted = [0.0], []
    faults = WiredFaults(PLANT, world, recorder, devices, lambda: now_s[0], lambda node, at: booted.append((node, at)))
    for text in ("drive 3 mute at 0.1", "plc mute at 0.1", "drive 2 restart at 0.1", "load-cell 1 nan at 0.1"):
        faults.injector.add(parse_fault(text), 0.0)
    with pytest.raises(FaultRefused, match="allowed: canopen, modbus-tcp"):
        faults.injector.add(parse_fault("opcua mute"), 0.0)
    with pytest.raises(FaultRefused, match="what can: drive 1, drive 2"):
        faults.injector.add(parse_fault("plc restart"), 0.0)
    frame, request = (0x203, b"x"), b"\0\1\0\0\0\2\2\3"
    assert faults.canopen.pass_(Direction.TO_DEVICE, 3, frame) == [(0.0, frame)]
    assert faults.modbus.pass_(Direction.TO_DEVICE, 2, request) == [(0.0, request)]
    now_s[0] = 0.1
    assert faults.canopen.pass_(Direction.TO_DEVICE, 3, frame) == []
    assert faults.modbus.pass_(Direction.TO_DEVICE, 2, request) == []
    assert booted == [(2, pytest.approx(0.1))] and isnan(devices[1].tension_n(1, 0.1))
