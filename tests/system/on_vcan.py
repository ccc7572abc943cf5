"""A line on a CAN bus of the kernel (vcan0): everything on one bus, seen by `candump` of can-utils from outside.

Runs where there is such a kernel: on the host, or in the guest that `test_vcan` boots. Named so that it is not
collected by itself.
"""

import subprocess
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest

from gateway.core.states import LoopState
from gateway.core.status import GatewayStatus
from tests.bench.lines import WIRINGS, CanWire, Ports, line_text
from tests.bench.live import LiveLine, at_rest

CHANNEL = "vcan0"
CAN = CanWire("socketcan", CHANNEL)
SPANS = 2  #: these and the period are what a guest with one processor and slow system calls can carry
PERIOD_S = 0.05
WATCHDOG_S = 0.2  #: four periods; the most that the drives can do
ROLLERS = list(range(1, SPANS + 1))
RUN_S = 5.0
STOP_CYCLES = 4  #: behind the last command that reached a drive: one may still have had its answers, three are held
TRIES = 3  #: a computer that stalls stops the line, as it must; then once more

pytestmark = pytest.mark.timeout(240)


@pytest.fixture(scope="module", autouse=True)
def vcan() -> Iterator[None]:
    ip("link", "add", CHANNEL, "type", "vcan")
    ip("link", "set", CHANNEL, "up")
    yield
    ip("link", "delete", CHANNEL)


@pytest.fixture
def line(tmp_path: Path) -> Iterator[LiveLine]:
    """SILENT, everything on vcan0."""
    with LiveLine(tmp_path, PERIOD_S, settle_s=60.0) as live:
        live.start_sim(WIRINGS["canopen"], CAN, spans=SPANS)
        text = line_text(WIRINGS["canopen"], PERIOD_S, Ports(), CAN, SPANS)
        live.describe(text.replace("watchdog_s = 0.1 ", f"watchdog_s = {WATCHDOG_S} "))
        assert live.line.limits.watchdog_s == WATCHDOG_S
        live.start_gateway()
        live.start_loop()
        yield live


def ip(*words: str) -> None:
    subprocess.run(["ip", *words], check=True)


@dataclass(frozen=True, slots=True)
class Seen:
    """A frame on the bus."""

    monotonic_s: float
    cob_id: int
    data: bytes

    @property
    def for_drives(self) -> bool:
        """NMT, SYNC, and what is addressed to a drive: RPDO and SDO requests."""
        return self.cob_id in (0x000, 0x080, *(base + node for base in (0x200, 0x600) for node in ROLLERS))

    @property
    def changes_something(self) -> bool:
        """Any RPDO, and an SDO request that is no upload (CiA 301, 7.2.4.3: client command specifiers 2 and 3)."""
        sdo = 0x600 < self.cob_id < 0x680
        return 0x200 < self.cob_id < 0x280 or (sdo and self.data[0] >> 5 not in (2, 3))


class Candump:
    """What `candump` has seen so far."""

    def __init__(self, log: Path) -> None:
        self._log = log
        self._ahead_s = time.time() - time.monotonic()  # its stamps are the kernel's, of the wall clock

    def frames(self, since_s: float = 0.0) -> list[Seen]:
        """Those since a monotonic time. A line reads `(1700000000.123456) vcan0 185#2106...`."""
        frames: list[Seen] = []
        for row in self._log.read_text().splitlines(keepends=True):
            if row.endswith("\n"):
                stamp, _, frame = row.split()[:3]
                cob_id, _, data = frame.partition("#")
                at_s = float(stamp.strip("()")) - self._ahead_s
                if at_s >= since_s and len(cob_id) == 3:
                    frames.append(Seen(at_s, int(cob_id, 16), bytes.fromhex(data)))
        return frames


@contextmanager
def candump(folder: Path) -> Iterator[Candump]:
    """Watches the bus. It sees it once it has said so: a frame of ours is the sign."""
    path = folder / "candump.log"
    with path.open("wb") as log:
        process = subprocess.Popen(["stdbuf", "-oL", "candump", "-L", CHANNEL], stdout=log)
        try:
            witness = Candump(path)
            while not any(frame.cob_id == 0x7FF for frame in witness.frames()):
                subprocess.run(["cansend", CHANNEL, "7FF#"], check=True)
                time.sleep(0.05)  # between two signs
            yield witness
        finally:
            process.terminate()
            process.wait()


def watch(for_s: float) -> float:
    """Let the line run on; returns when this began."""
    begin_s = time.monotonic()
    time.sleep(for_s)
    return begin_s


def run_through(line: LiveLine, for_s: float) -> float:
    """Run for so long without a stop; returns when this began."""
    for _ in range(TRIES):
        line.run()
        since_s = watch(for_s)
        status = line.status()
        if status is not None and status.loop.state == "RUN":
            return since_s
        line.wait(at_rest)
    raise AssertionError(f"this machine stalls too often for a line in real time: {line.stops}")


def open_the_bus_anew(line: LiveLine) -> None:
    """The kernel's error frame of a bus that is off, and the bus goes on at once: a controller that restarts by itself.

    What was lost meanwhile decides whether the line runs on or stops; a bus that stays away is the case below.
    """
    subprocess.run(["cansend", CHANNEL, "20000040#0000000000000000"], check=True)
    line.wait(reconnected)
    watch(1.0)
    status = line.status()
    assert status is not None and status.loop.state in ("RUN", "STOP")
    if status.loop.state == "RUN":
        line.stop()
    line.wait(at_rest)


def test_silent_until_armed_then_in_time_on_target_and_safe_and_a_bus_off_is_got_over(
    line: LiveLine, tmp_path: Path
) -> None:
    with candump(tmp_path) as witness:
        since_s = watch(1.0)
        frames = witness.frames(since_s)
        assert [frame for frame in frames if frame.cob_id > 0x700]  # heartbeats: the bus is alive
        assert not [frame for frame in frames if frame.for_drives or frame.changes_something]
        since_s = run_through(line, RUN_S)
        syncs = [
            frame.monotonic_s
            for frame in witness.frames(since_s)
            if frame.cob_id == 0x080 and frame.monotonic_s < since_s + RUN_S
        ]
        open_the_bus_anew(line)
    spacing_s = np.diff(syncs)
    assert abs(np.median(spacing_s) - PERIOD_S) < 0.02 * PERIOD_S, np.median(spacing_s)
    assert abs(len(syncs) * PERIOD_S / RUN_S - 1.0) < 0.1, len(syncs)
    recording = line.recording()
    truth_s = recording.time_s + line.world_start_s
    during = (truth_s > since_s) & (truth_s < since_s + RUN_S)
    target_n = np.array(line.line.recipes[0].tension_n)
    assert np.abs(recording.tension_n[during].mean(axis=0) - target_n).max() < 0.5
    assert np.abs(recording.tension_n[during] - target_n).max() < 3.0
    assert not recording.torque_nm[-1].any()
    assert line.unsafe() == []


def test_a_killed_loop_is_ended_by_the_drives_own_watchdogs(line: LiveLine, tmp_path: Path) -> None:
    line.run()
    with candump(tmp_path) as witness:
        killed_s = line.kill("loop")
        line.children.end("loop")
        quiet_s = watch(1.0)
        assert not [frame for frame in witness.frames(quiet_s + 0.1) if frame.for_drives]
        emergencies = {frame.cob_id for frame in witness.frames() if frame.data[:2] == b"\x50\x82"}
    assert emergencies == {0x80 + node for node in ROLLERS}
    recording = line.recording()
    trips = [event for event in recording.of_kind("watchdog") if event["time_s"] > killed_s]
    assert sorted(event["roller"] for event in trips) == ROLLERS
    assert max(event["time_s"] for event in trips) - killed_s <= WATCHDOG_S + 2 * PERIOD_S
    assert not recording.torque_nm[recording.time_s > killed_s + WATCHDOG_S + 3 * PERIOD_S].any()
    assert line.unsafe() == []


def go_down_and_up(line: LiveLine) -> float:
    """The interface is down until the line has stopped. Returns a time at which it was down already."""
    ip("link", "set", CHANNEL, "down")
    down_s = time.monotonic()
    line.wait(lambda status: status.loop.state == "STOP")
    ip("link", "set", CHANNEL, "up")
    line.wait(reconnected)
    return down_s


def test_an_interface_that_goes_down_stops_the_line_and_comes_back_without_torque_until_a_person_starts(
    line: LiveLine,
) -> None:
    """Nobody reaches the drives any more: their own watchdogs end it."""
    line.run()
    down_s = go_down_and_up(line)
    end_s = watch(1.0) + 1.0
    line.run()
    again_s = time.monotonic()
    line.stop()
    for name in ("loop", "gateway"):
        line.children.end(name)
    recording = line.recording()
    commands_s = [event["monotonic_s"] for event in recording.of_kind("command")]
    last_s = max(at_s for at_s in commands_s if at_s <= down_s)
    states = line.history(last_s, end_s, "state")["state"]
    stopped = states == LoopState.STOP
    assert int(np.argmax(stopped)) <= STOP_CYCLES, states[:20]
    assert stopped[np.argmax(stopped) :].all()  # latched: nothing comes back by itself
    truth_s = recording.time_s + line.world_start_s
    assert not recording.torque_nm[(truth_s > last_s + WATCHDOG_S + PERIOD_S) & (truth_s < end_s)].any()
    assert recording.torque_nm[(truth_s > end_s) & (truth_s < again_s)].any()
    assert line.unsafe() == []


def reconnected(status: GatewayStatus) -> bool:
    """The bus was opened again. Drives that were lost stay so until a person arms."""
    return any(bus.reconnects > 0 for bus in status.buses)
