"""Drives that do not do what they are asked, on the real wires in virtual time; the recorder at the devices judges."""

import numpy as np
import pytest

from gateway.core.signals import DriveRequest
from gateway.core.states import LoopState, Phase
from sim_plant.faults.parse import parse_fault
from tests.bench.faults_lines import virtual_line
from tests.closed_loop.virtual_line import VirtualLine

BOUND_S = 1.0  #: until a drive is named, and the line is being stopped
FEW_S = 0.1  #: until its command is held


@pytest.fixture
def line():
    with VirtualLine() as line:
        line.begin_in_production()
        line.step(100)
        yield line


def inject(line: VirtualLine, text: str) -> None:
    line.truth.faults.injector.add(parse_fault(text), line.truth.faults.now_s())


def codes(line: VirtualLine) -> list[str]:
    return [finding.rule for finding in line.findings]


def found(line: VirtualLine, code: str) -> dict:
    return next(dict(finding.parameters) for finding in line.findings if finding.rule == code)


def stopped_within(line: VirtualLine, seconds: float) -> float:
    """How long it took until the line left production (s)."""
    before_s = line.now_s
    assert line.step_until(Phase.SLOWING, seconds), codes(line)
    return line.now_s - before_s


def assert_stopped_in_order(line: VirtualLine) -> None:
    assert line.step_until(Phase.OFF, line.line.longest_stop_s)
    recording = line.recording()
    asked_nm = np.array([event["target_torque_nm"] for event in recording.of_kind("command")])
    assert np.abs(asked_nm).max() <= line.line.limits.torque_nm
    unsafe = line.truth.recorder.unsafe_events
    assert not unsafe["torque-limit"] and not unsafe["torque-not-enabled"], unsafe
    assert not line.truth.world.torque_nm.any()


@pytest.mark.parametrize("roller", [1, 3, 6])
@pytest.mark.parametrize("fault", ["torque-share share=0", "torque-share share=0.1", "torque-share share=3",
                                   "torque-share share=-1", "mode-lost says=follows"])  # fmt: skip
def test_a_drive_that_gives_another_torque_is_named_and_stops_the_line(line, fault, roller):
    inject(line, f"drive {roller} {fault}")
    stopped_within(line, BOUND_S)
    numbers = found(line, "torque-not-given")
    assert numbers["drive"] == f"drive-{roller}"
    assert_stopped_in_order(line)
    assert f"drive-{roller} gives" in line.cycle.machine.reason


def test_a_mode_that_is_lost_and_regained_is_found_and_does_not_hit_the_web(line):
    """What is asked of it must not wind up meanwhile: all of it would act when the drive comes back."""
    before_nm = max(abs(frame.torque_nm[2]) for frame in line.recorded()[-50:])
    inject(line, "drive 3 mode-lost says=follows for 0.6")
    asked_nm = []
    for _ in range(60):
        line.step()
        asked_nm.append(abs(float(line.cycle.outputs.torque_nm[2])))
    assert codes(line)[0] == "torque-not-given" and line.cycle.machine.state is LoopState.STOP
    held_from = round(FEW_S / line.period_s)
    assert max(asked_nm[held_from:]) <= before_nm, "it is held, and then nothing"
    assert line.cycle.outputs.drive_request[2] == DriveRequest.OFF, "nobody knows what it would make of a command"
    line.step(40)
    assert line.truth.world.torque_nm[2] == 0.0, "the mode is back, and no torque with it"
    assert_stopped_in_order(line)


def test_a_short_loss_of_the_mode_is_ridden_out_with_the_command_held(line):
    inject(line, "drive 3 mode-lost says=follows for 0.15")
    line.step(15)
    held_nm = float(line.cycle.outputs.torque_nm[2])
    line.step()
    assert line.cycle.watch.drives.suspected[2] and line.cycle.outputs.torque_nm[2] == held_nm
    line.step(100)
    assert line.cycle.machine.phase is Phase.RUNNING and not line.findings
    assert not line.cycle.watch.drives.suspected.any()


@pytest.fixture
def at_rest():
    with VirtualLine() as line:
        line.step(50)
        yield line


def test_a_drive_of_which_nothing_is_asked_is_found_by_the_mode_that_it_displays(at_rest):
    assert at_rest.arm().ok and at_rest.cycle.machine.state is LoopState.READY
    inject(at_rest, "drive 2 mode-lost mode=8 says=follows")
    assert at_rest.step_until(Phase.OFF, BOUND_S), codes(at_rest)
    assert found(at_rest, "drive-mode") == {"drive": "drive-2", "mode": 8, "wanted": 10}


def test_a_drive_that_stays_in_no_mode_is_not_armed(at_rest):
    inject(at_rest, "drive 2 mode-lost mode=0 says=follows")
    reply = at_rest.arm()
    assert not reply.ok and [finding.code for finding in reply.findings] == ["drive-mode"]
    assert reply.findings[0].parameters == {"drive": "drive-2", "mode": 0, "wanted": 10}
    assert "drive-2 is in mode 0, wanted 10" in reply.text


def test_a_drive_that_loses_its_mode_before_it_is_enabled_gets_no_torque(at_rest):
    assert at_rest.arm().ok
    inject(at_rest, "drive 2 mode-lost mode=0 says=follows")
    at_rest.start()
    assert at_rest.step_until(Phase.OFF, 5.0)
    assert "drive-mode" in codes(at_rest)
    assert not np.abs(at_rest.recording().torque_nm).any(), "no drive has given any"


def test_a_drive_without_power_is_not_armed(at_rest):
    inject(at_rest, "drive 2 no-power")
    reply = at_rest.arm()
    assert not reply.ok and [finding.code for finding in reply.findings] == ["drive-no-power"]
    assert "drive-2 has no power (6041h bit 4 = 0)" in reply.text


def test_power_that_fails_in_production_stops_the_line(line):
    inject(line, "drive 4 no-power")
    stopped_within(line, BOUND_S)
    assert_stopped_in_order(line)


def test_a_warning_is_told_and_the_line_runs_on(line):
    inject(line, "drive 2 drive-warning code=0x4210 register=0x08")
    line.step(200)
    assert line.cycle.machine.phase is Phase.RUNNING and line.truth.recorder.unsafe_total == 0
    assert codes(line) == ["drive-warns"]
    assert found(line, "drive-warns") == {"drive": "drive-2", "error_code": 0x4210, "register": 0x08}


def test_a_fault_takes_torque_away_and_is_no_warning(line):
    inject(line, "drive 2 drive-fault code=0x4210")
    stopped_within(line, 0.1)
    assert "drive-warns" not in codes(line)
    assert_stopped_in_order(line)


def test_arming_gives_a_drive_another_chance(line):
    inject(line, "drive 3 torque-share share=0 for 1")
    stopped_within(line, BOUND_S)
    assert_stopped_in_order(line)
    line.pass_time(1.0)
    line.step(20)
    assert line.arm().ok and not line.cycle.torque_path.any_lost()
    assert line.start().ok
    line.step(300)
    assert line.cycle.machine.phase in (Phase.TENSIONING, Phase.RUNNING), line.cycle.machine.reason


# the other wires


@pytest.mark.parametrize(
    ("wiring", "warning"),
    [("modbus", "drive-warns-without-code"), ("opcua", "drive-warns")],  # a rack has no error codes
)
def test_every_wire_tells_what_its_drives_give_and_say(wiring, warning):
    with virtual_line(wiring, 1) as line:
        line.begin_in_production()
        line.step(100)
        assert not line.findings
        inject(line, "drive 2 drive-warning code=0x4210")
        line.step(100)
        assert codes(line) == [warning] and found(line, warning).get("error_code", 0x4210) == 0x4210
        inject(line, "drive 3 torque-share share=0.1")
        stopped_within(line, BOUND_S)
        assert found(line, "torque-not-given")["drive"] == "drive-3"
        assert_stopped_in_order(line)


@pytest.mark.parametrize("wiring", ["modbus", "opcua"])
def test_on_every_wire_a_drive_without_power_is_not_armed(wiring):
    with virtual_line(wiring, 1) as line:
        line.step(50)
        inject(line, "drive 2 no-power")
        reply = line.arm()
        assert not reply.ok and [finding.code for finding in reply.findings] == ["drive-no-power"]
