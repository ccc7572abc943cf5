"""Processes killed for real, in mid-run; the recorder inside the simulated line and a tap on the wire judge."""

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest

from gateway.core.messages import Arm, SetSpeed, Start, Stop
from tests.closed_loop.wire import WireLine, from_master, heard, settled, silent_periods_until_ramp
from tests.support.recorder import require_safe

pytestmark = pytest.mark.realtime

WATCHDOG_S, PERIOD_S = 0.1, 0.01


@pytest.fixture
def wire(tmp_path):
    with WireLine(tmp_path, gate="first_speed_max_m_per_s = 0.12") as line:  # faster than what nobody has judged may
        yield line


def test_killing_the_loop_the_drives_own_watchdog_takes_torque_off_and_the_restart_is_disarmed(wire):
    wire.run()
    with wire.tap() as bus:
        killed_s = wire.kill("loop")
        wire.children.end("loop")
        heard(bus, 0.5)
        wire.start_loop()
        wire.wait(lambda status: status.loop.running and status.loop.state == "SILENT")
        assert not [frame for frame in heard(bus, 0.5) if from_master(frame)]
    refused = wire.order(Start())
    assert not refused.ok and "arm" in refused.text
    # The drives are in fault now; a person arms again, which acknowledges it, and the line runs.
    assert wire.order(Arm()).ok and wire.order(Start()).ok
    wire.wait(settled)
    assert wire.order(Stop()).ok
    wire.wait(lambda status: status.loop.state == "STOP" and status.spans[0].drive == "OFF")
    recording = wire.recording()
    trips = recording.of_kind("watchdog")
    assert sorted(event["roller"] for event in trips) == [1, 2, 3, 4, 5, 6]
    assert max(event["time_s"] for event in trips) - killed_s <= WATCHDOG_S + 2 * PERIOD_S
    after = (recording.time_s > killed_s + WATCHDOG_S + 3 * PERIOD_S) & (recording.time_s < killed_s + 0.5)
    assert not recording.torque_nm[after].any()
    require_safe(wire.unsafe())


def test_without_its_gateway_the_loop_runs_on_one_that_comes_back_finds_it_and_stop_goes_straight_to_it(wire):
    wire.run()
    wire.kill("gateway")
    wire.children.end("gateway")
    wire.start_gateway()
    wire.wait(settled)
    assert wire.order(SetSpeed(speed_m_per_s=0.01)).ok
    killed_s = wire.kill("gateway")
    wire.children.end("gateway")
    time.sleep(1.0)  # the line runs without its gateway
    assert wire.order(Stop()).ok
    wire.wait_at_rest()
    recording = wire.recording()
    alone = (recording.time_s > killed_s) & (recording.time_s < killed_s + 1.0)
    assert recording.torque_nm[alone].any(axis=1).all()  # some drive pulls in every millisecond
    assert np.abs(recording.tension_n[alone] - np.array([28, 36, 20, 40, 24, 32])).max() < 1.0
    assert not recording.of_kind("watchdog")
    assert not recording.torque_nm[-100:].any() and not recording.unwind_speed_m_per_s[-100:].any()
    require_safe(wire.unsafe())


def test_killing_the_simulated_line_the_loop_ramps_after_three_silent_periods_and_takes_the_drives_off(wire):
    """The recorder dies with the line, so a tap on the wire sees what the loop sends to drives that are gone."""
    wire.run()
    with wire.tap() as bus:
        heard(bus, 0.05)
        wire.kill("sim")
        frames = heard(bus, 0.8)
    # Three periods are held, the command of the next one moves.
    assert silent_periods_until_ramp(frames) <= 4
    status = wire.wait(lambda status: status.loop.state == "STOP")
    left = next(event for event in reversed(status.events) if event.kind == "state" and "RUNNING" in event.text)
    assert "signals-missing" in {one.code for one in left.findings}
    # Every drive is told once to leave operational, and no RPDO follows that would renew a watchdog.
    dropped = [k for k, frame in enumerate(frames) if frame.arbitration_id == 0x000]
    assert sorted(bytes(frames[k].data) for k in dropped) == [bytes((0x80, node)) for node in range(1, 7)]
    assert not [frame for frame in frames[dropped[-1] :] if 0x200 < frame.arbitration_id < 0x280]
    # A person may not arm what is not there.
    refusal = wire.order(Arm())
    assert not refusal.ok and refusal.reasons


def stall(wire, seconds):
    """The loop process does not run for a while, as on a computer that is starved."""
    pid = wire.children.pid("loop")
    os.kill(pid, signal.SIGSTOP)
    time.sleep(seconds)
    os.kill(pid, signal.SIGCONT)


def test_a_hang_is_ended_by_the_drives_own_watchdog_and_the_loop_finds_them_in_fault(wire):
    wire.run()
    stall(wire, 0.4)
    wire.wait(lambda status: status.loop.state == "STOP")
    recording = wire.recording()
    trips = recording.of_kind("watchdog")
    assert sorted(event["roller"] for event in trips) == [1, 2, 3, 4, 5, 6]
    require_safe(wire.unsafe())


def test_an_orderly_end_in_mid_run_stops_the_line_and_leaves_no_drive_in_fault(wire):
    wire.run()
    assert wire.order(SetSpeed(speed_m_per_s=0.05)).ok
    wire.wait(lambda status: status.speed_setpoint_m_per_s == 0.05)
    assert wire.children.end("loop") == 0  # SIGTERM
    time.sleep(0.3)  # longer than a watchdog
    recording = wire.recording()
    assert not recording.of_kind("watchdog") and not recording.of_kind("emcy")
    assert not recording.torque_nm[-100:].any() and not recording.unwind_speed_m_per_s[-100:].any()
    stopped = recording.unwind_speed_m_per_s[recording.torque_nm.any(axis=1)]
    assert stopped[-1] < 0.005  # torque went off at standstill, not before
    require_safe(wire.unsafe())


def test_a_loop_that_is_not_armed_sends_nothing_and_neither_does_a_second_one_that_ends(wire):
    wire.start_gateway()
    wire.start_loop()
    wire.wait(lambda status: status.loop.running)
    with wire.tap() as bus:
        second = subprocess.run(
            [sys.executable, "-m", "gateway.cli", "loop", wire.folder / "line.toml", "--controller",
             wire.folder / "controller.json", *wire.folders],
            capture_output=True, text=True, timeout=120, check=False,
        )  # fmt: skip
        assert second.returncode == 3 and "already" in second.stderr
        frames = heard(bus, 1.0)
        assert [frame for frame in frames if 0x700 < frame.arbitration_id] and not [f for f in frames if from_master(f)]
        assert wire.order(Arm()).ok
        assert [frame for frame in heard(bus, 0.2) if from_master(frame)]
    has_no_database_and_listens_nowhere(wire.children.pid("loop"))


def has_no_database_and_listens_nowhere(pid: int) -> None:
    """No socket of the internet's, that is."""
    links = [link.readlink().as_posix() for link in Path(f"/proc/{pid}/fd").iterdir()]
    assert not [link for link in links if "sqlite" in link or link.endswith(".db")]
    inodes = {link[8:-1] for link in links if link.startswith("socket:[")}
    for table in ("tcp", "tcp6"):
        for row in Path(f"/proc/{pid}/net/{table}").read_text().splitlines()[1:]:
            columns = row.split()
            listening = columns[3] == "0A"
            assert not (listening and columns[9] in inodes)
