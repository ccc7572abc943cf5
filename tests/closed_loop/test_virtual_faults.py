"""Faults on the real wires in virtual time. Bounds are counted in periods; the recorder at the devices judges.

A fault begins between two periods; period 1 is the first that meets it. Periods are told apart by their SYNC.
"""

from collections.abc import Callable

import can
import numpy as np
import pytest

from gateway.core.signals import DriveRequest, DriveState
from gateway.core.states import LoopState, Phase
from sim_plant.devices.amplifier import ChannelStatus
from sim_plant.faces.modbus_codec import Frame
from sim_plant.recording import Recording
from tests.closed_loop.virtual_line import VirtualLine

NMT, TPDO, RPDO, HEARTBEAT = 0x000, 0x180, 0x200, 0x700
HEARTBEAT_S = 0.1  #: producer time of these drives
ROLLER = 3
TORQUE_KINDS = ("torque-limit", "torque-rate", "torque-not-enabled")


@pytest.fixture
def line():
    with VirtualLine() as line:
        line.begin_in_production()
        line.step(50)
        yield line


class Fault:
    """Begins now."""

    def __init__(self, line: VirtualLine) -> None:
        self._line = line
        self._first_s = line.world_s(line.now_s) + line.period_s  # of period 1
        self._torque_before_nm = line.truth.world.torque_nm.copy()

    def period(self, time_s: float) -> float:
        """In which period `time_s` (world) lies: the integer when it is due, a fraction of it later."""
        return round(1.0 + (time_s - self._first_s) / self._line.period_s, 6)

    def events(self, kind: str, **what: object) -> list[dict]:
        """What the recorder has of this kind since then."""
        return [
            event
            for event in self._line.recording().of_kind(kind)
            if self.period(event["time_s"]) > 0.5 and what.items() <= event.items()
        ]

    def commanded_nm(self, roller: int) -> list[float]:
        """The torques that the drive was told: of the period before the fault, then one a period."""
        commands = [event for event in self._line.recording().of_kind("command") if event["roller"] == roller]
        periods = [self.period(event["time_s"]) for event in commands]
        first = next(k for k, period in enumerate(periods) if period > 0.5)
        return [event["target_torque_nm"] for event in commands[first - 1 :]]

    def slowed_in(self) -> float:
        """The period in which the line PLC was first told another speed."""
        return self.period(self.events("plc_command")[0]["time_s"])

    def finish(self) -> Recording:
        """The line comes to rest, and nothing unsafe was done to it. Returns all that was recorded."""
        line = self._line
        assert line.step_until(Phase.OFF, line.line.longest_stop_s)
        line.step(12)
        unsafe = line.truth.recorder.unsafe_events
        assert not any(unsafe[kind] for kind in TORQUE_KINDS), unsafe
        assert not line.truth.world.torque_nm.any()
        return line.recording()


def drop_frames(line: VirtualLine, dropped: Callable[[int], bool]) -> None:
    """What the simulated drives send is lost where `dropped` says so of its identifier."""
    face = line.truth.canopen
    assert face is not None
    send = face.send
    face.send = lambda can_id, data: None if dropped(can_id) else send(can_id, data)


def deafen(line: VirtualLine, deaf: Callable[[can.Message], bool]) -> None:
    """Frames to the simulated drives are lost where `deaf` says so."""
    face = line.truth.canopen
    assert face is not None
    take = face.take
    face.take = lambda message: None if deaf(message) else take(message)


def mute_modbus(line: VirtualLine) -> None:
    """Requests are taken and never answered."""
    face = line.truth.modbus
    assert face is not None

    def swallow(frame: Frame, now_s: float) -> bytes:
        return b""

    face.answer = swallow


def assert_held_for_two_then_unloaded(told_nm: list[float]) -> None:
    """`told_nm` begins with the period before the fault."""
    before, first, second, *then = np.abs(told_nm)
    assert first == second == before > then[0]
    assert np.all(np.diff(then) <= 0.0) and then[-1] == 0.0


@pytest.mark.parametrize("lost", [1, 2])
def test_a_drive_that_misses_two_answers_is_waited_for(line, lost):
    fault = Fault(line)
    silent = True
    drop_frames(line, lambda can_id: silent and can_id == TPDO + ROLLER)
    line.step(lost)
    silent = False
    line.step(50)
    assert line.cycle.machine.phase is Phase.RUNNING
    told_nm = fault.commanded_nm(ROLLER)
    assert told_nm[1 : lost + 1] == [told_nm[0]] * lost and told_nm[lost + 1] != told_nm[0]
    assert not fault.events("drive_state") and line.truth.recorder.unsafe_total == 0


def test_a_drive_that_stops_answering_stops_the_line_in_the_third_period(line):
    fault = Fault(line)
    drop_frames(line, lambda can_id: can_id == TPDO + ROLLER)
    line.step(3)
    left = fault.events("drive_state")
    assert [(event["roller"], event["cause"]) for event in left] == [(ROLLER, "nmt")]
    assert 3.0 <= fault.period(left[0]["time_s"]) < 4.0
    line.step(1)
    assert fault.slowed_in() == 4.0  # what period 3 decided reaches the PLC with the next transaction
    recording = fault.finish()
    assert not recording.torque_nm[recording.time_s > left[0]["time_s"] + 1e-3, ROLLER - 1].any()
    assert f"{ROLLER} ABSENT" in {one.parameters.get("drives") for one in line.findings}


def test_a_lost_drive_that_does_not_hear_the_nmt_command_either_is_left_to_its_watchdog(line):
    fault = Fault(line)
    drop_frames(line, lambda can_id: can_id == TPDO + ROLLER)
    deafen(line, lambda message: message.arbitration_id == NMT and message.data[1] == ROLLER)
    line.step(15)
    assert len(fault.commanded_nm(ROLLER)) == 1 + 2  # none from period 3 on
    tripped = fault.events("drive_state", roller=ROLLER)[0]
    assert tripped["cause"] == "watchdog"
    assert fault.period(tripped["time_s"]) <= 3.0 + line.line.limits.watchdog_s / line.period_s
    fault.finish()


def test_a_drive_that_no_longer_hears_takes_its_torque_off_and_the_line_stops(line):
    """Its answers still come: its own watchdog must act, within its time and a period, and say so."""
    fault = Fault(line)
    last_s = line.world_s(line.now_s)
    deafen(line, lambda message: message.arbitration_id == RPDO + ROLLER)
    line.step(12)
    tripped = fault.events("watchdog")
    assert [event["roller"] for event in tripped] == [ROLLER]
    assert tripped[0]["time_s"] - last_s <= line.line.limits.watchdog_s + line.period_s
    assert fault.slowed_in() <= fault.period(tripped[0]["time_s"]) + 2.0
    fault.finish()


def test_a_lost_heartbeat_stops_the_line_though_its_samples_go_on(line):
    """Bound: one and a half producer times after the last heartbeat, and two periods."""
    sent_s = []
    fault = Fault(line)

    def dropped(can_id: int) -> bool:
        if can_id == HEARTBEAT + ROLLER:
            sent_s.append(line.world_s(line.now_s))
        return can_id == HEARTBEAT + ROLLER

    drop_frames(line, dropped)
    line.step(30)
    assert len(sent_s) > 1  # it went on sending, and only they were lost
    last_heard_s = sent_s[0] - HEARTBEAT_S
    left = fault.events("drive_state", roller=ROLLER)
    assert left and left[0]["cause"] == "nmt"
    lost_for_s = left[0]["time_s"] - last_heard_s
    assert 1.5 * HEARTBEAT_S < lost_for_s <= 1.5 * HEARTBEAT_S + 2.0 * line.period_s
    assert line.cycle.machine.state is LoopState.STOP
    fault.finish()


def test_a_modbus_server_that_goes_mute_holds_the_torques_and_unloads_in_the_third_period(line):
    fault = Fault(line)
    mute_modbus(line)
    line.step(8)
    for roller in range(1, line.line.n + 1):
        assert_held_for_two_then_unloaded(fault.commanded_nm(roller))
    fault.finish()
    # Nobody tells the PLC to stop: its own watchdog does, in the time that was set when the line was armed.
    tripped = fault.events("plc_watchdog")
    assert len(tripped) == 1 and line.truth.world.unwind_speed_m_per_s == 0.0
    assert fault.period(tripped[0]["time_s"]) <= 1.0 + line.line.limits.watchdog_s / line.period_s


def test_a_load_cell_without_a_number_holds_in_the_same_cycle_and_stops_in_the_third(line):
    fault = Fault(line)
    line.truth.amplifier.set_status(ROLLER, ChannelStatus.WIRE_BREAK)
    line.step(2)
    assert line.cycle.machine.phase is Phase.RUNNING
    line.step(1)
    assert line.cycle.machine.state is LoopState.STOP and line.findings[0].parameters["signals"] == f"T{ROLLER}"
    line.step(5)
    for roller in range(1, line.line.n + 1):
        assert_held_for_two_then_unloaded(fault.commanded_nm(roller))
    assert fault.slowed_in() == 4.0
    recording = fault.finish()
    assert np.isfinite(recording.torque_nm).all()


@pytest.mark.parametrize(("skipped", "stops"), [(5, False), (6, True)])
def test_a_stall_of_six_periods_stops_the_line_and_one_of_five_does_not(line, skipped, stops):
    fault = Fault(line)
    line.stall(skipped)
    line.step(2)
    commanded = [fault.period(event["time_s"]) for event in fault.events("command", roller=1)]
    assert commanded == [skipped + 1.0, skipped + 2.0]  # nothing is caught up
    assert not fault.events("watchdog") and not fault.events("plc_watchdog")
    if not stops:
        line.step(50)
        assert line.cycle.machine.phase is Phase.RUNNING and not fault.events("plc_command")
        assert line.truth.recorder.unsafe_total == 0
        return
    assert fault.slowed_in() == skipped + 2.0
    assert [(one.rule, one.parameters["skipped"]) for one in line.findings] == [("overrun", skipped)]
    fault.finish()
    assert {event["cause"] for event in fault.events("drive_state")} == {"command"}


def test_without_the_loop_every_drive_takes_its_torque_off(line):
    """Bound: the watchdog's time and one period, from the last command on."""
    fault = Fault(line)
    last_s = line.world_s(line.now_s)
    line.pass_time(0.3)
    assert not fault.events("command")
    tripped = fault.events("watchdog")
    assert sorted(event["roller"] for event in tripped) == [drive.roller for drive in line.line.drives]
    bound_s = line.line.limits.watchdog_s + line.period_s
    assert all(event["time_s"] - last_s <= bound_s for event in tripped)
    recording = line.recording()
    after = recording.time_s > last_s + bound_s
    assert after.any() and not recording.torque_nm[after].any()
    assert recording.torque_nm[recording.time_s <= last_s + 0.5 * line.line.limits.watchdog_s][-1].all()
    assert len(fault.events("plc_watchdog")) == 1 and recording.unwind_speed_m_per_s[-1] == 0.0
    assert line.truth.recorder.unsafe_total == 0


def test_a_loop_that_comes_back_after_the_watchdogs_enables_no_drive(line):
    fault = Fault(line)
    line.stall(30)
    line.step(1)
    assert line.cycle.machine.state is LoopState.STOP
    fault.finish()
    assert (line.cycle.outputs.drive_request != DriveRequest.ENABLE).all()
    assert (line.cycle.inputs.drive_state == DriveState.FAULT).all()
    assert not [event for event in fault.events("drive_state") if event["state"] == "OPERATION_ENABLED"]
