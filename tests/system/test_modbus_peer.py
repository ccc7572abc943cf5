"""The gateway against devices on modbus-stream (npm), written from docs/devices in JavaScript."""

from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.bench.lines import Wiring
from tests.system.peer_line import HELD_PERIODS, PeerLine, assert_arms_and_holds_tension, line_on

pytestmark = pytest.mark.timeout(180)

AMPLIFIER, PLC, FIRST_DRIVE = 1, 2, 11


@pytest.fixture
def line(tmp_path: Path) -> Iterator[PeerLine]:
    wiring = Wiring("modbus-tcp", "modbus-tcp", "modbus-tcp")
    with line_on("modbus_peer.js", wiring, "modbus", tmp_path, period_s=0.02, watchdog_s=0.1) as found:
        yield found


def test_arms_proves_the_watchdogs_and_holds_tension(line: PeerLine) -> None:
    assert_arms_and_holds_tension(line)


@pytest.mark.parametrize("kind", ["exception", "freeze"])
def test_an_amplifier_that_fails_stops_the_line_by_command(line: PeerLine, kind: str) -> None:
    """Drives and PLC still obey: no watchdog has to end it."""
    line.live.run()
    line.peer("fault", AMPLIFIER, kind)
    line.wait_stopped()
    line.assert_let_go_by("plc run off", HELD_PERIODS)
    assert not line.tripped_since("fault")
    line.peer("heal")
    line.live.run()
    line.live.stop()


def test_measurements_that_stand_still_stop_the_line(line: PeerLine) -> None:
    """The sample counter tells: the tensions alone could be true."""
    line.live.run()
    line.peer("freeze_measurement")
    line.wait_stopped()
    line.assert_let_go_by("plc run off", HELD_PERIODS)
    assert not line.tripped_since("fault")


def test_a_broken_wire_stops_the_line(line: PeerLine) -> None:
    line.live.run()
    line.peer("break_wire", 2)
    line.wait_stopped()
    line.assert_let_go_by("plc run off", HELD_PERIODS)
    assert not line.tripped_since("fault")


def test_a_permissive_that_is_taken_stops_the_line(line: PeerLine) -> None:
    line.live.run()
    line.peer("take_permissive")
    line.wait_stopped()
    assert "permissive" in line.told()
    assert not line.tripped_since("fault")


def test_a_drive_that_answers_with_exceptions_is_ended_by_its_own_watchdog(line: PeerLine) -> None:
    """It takes no command any more: not even the one to take torque off."""
    line.live.run()
    line.peer("fault", FIRST_DRIVE, "exception")
    line.wait_stopped()
    line.assert_watchdogs_ended_it("axis 1 FAULT")


def test_connections_that_are_closed_end_in_the_watchdogs_and_come_back_without_torque(line: PeerLine) -> None:
    line.live.run()
    line.peer("close")
    line.wait_stopped()
    line.assert_watchdogs_ended_it("axis 1 FAULT", "axis 2 FAULT", "axis 3 FAULT", "plc watchdog")
    line.peer("open")
    status = line.live.wait(lambda status: any(bus.reconnects > 0 for bus in status.buses))
    assert status.loop.state == "STOP"  # latched: nothing comes back by itself
    assert not any(line.peer("state")["torque_nm"])
    line.live.run()  # a person arms and starts again
    line.live.stop()
