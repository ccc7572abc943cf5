"""The gateway against devices behind a node-opcua server (npm), written from docs/devices in JavaScript."""

from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.bench.lines import WIRINGS
from tests.system.peer_line import HELD_PERIODS, PeerLine, assert_arms_and_holds_tension, line_on

pytestmark = pytest.mark.timeout(180)


@pytest.fixture
def line(tmp_path: Path) -> Iterator[PeerLine]:
    wiring = WIRINGS["opcua"]
    with line_on("opcua_peer.js", wiring, "opcua", tmp_path, period_s=0.05, watchdog_s=0.2) as found:
        yield found


def test_arms_proves_the_watchdogs_and_holds_tension(line: PeerLine) -> None:
    assert_arms_and_holds_tension(line)


def test_a_load_cell_with_a_bad_status_code_stops_the_line(line: PeerLine) -> None:
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


@pytest.mark.parametrize("kind", ["refuse", "freeze"])
def test_a_server_that_takes_no_commands_is_ended_by_the_watchdogs(line: PeerLine, kind: str) -> None:
    """It refuses every write, or takes them and does nothing: either way it answers all reads as if all were well."""
    line.live.run()
    line.peer(kind)
    line.wait_stopped()
    line.assert_watchdogs_ended_it("axis 1 FAULT", "axis 2 FAULT", "axis 3 FAULT", "plc watchdog")
    line.peer("heal")
    line.live.run()
    line.live.stop()


def test_a_server_that_closes_ends_in_the_watchdogs_and_comes_back_without_torque(line: PeerLine) -> None:
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
