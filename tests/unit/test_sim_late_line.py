"""A simulated line that gets to run late: what waited for it acts at its own time."""

import struct
from collections import deque
from collections.abc import Iterator
from math import inf

import can
import pytest

from sim_plant.devices.amplifier import Amplifier
from sim_plant.devices.drive import Drive
from sim_plant.devices.line_plc import LinePlc
from sim_plant.faces.build import canopen_face
from sim_plant.faults.parse import parse_fault
from sim_plant.faults.wired import WiredFaults
from sim_plant.plant import load_plant
from sim_plant.recorder import Recorder
from sim_plant.world import World

PLANT = load_plant("sim_plant/plants/s_real.toml")
PERIOD_S, WATCHDOG_MS = 0.01, 100


class WaitingBus(can.BusABC):
    """Frames that the kernel has taken and stamped, and nobody has read."""

    def __init__(self) -> None:
        super().__init__(channel="test")
        self.frames: deque[can.Message] = deque()

    def recv(self, timeout: float | None = None) -> can.Message | None:
        return self.frames.popleft() if self.frames else None

    def send(self, msg: can.Message, timeout: float | None = None) -> None: ...

    def came(self, at_s: float, can_id: int, data: bytes) -> None:
        self.frames.append(can.Message(timestamp=at_s, arbitration_id=can_id, is_extended_id=False, data=data))


class LateClock:
    """World time as the line would read it, and as the kernel has stamped the frames."""

    def __init__(self) -> None:
        self.late_s = 0.0

    def now_s(self) -> float:
        return self.late_s

    def arrival_s(self, stamped: can.Message) -> float:
        return stamped.timestamp


@pytest.fixture
def bus() -> Iterator[WaitingBus]:
    bus = WaitingBus()
    yield bus
    bus.shutdown()


@pytest.mark.parametrize(("planned", "trips"), [("", False), ("drive 1 drop at 0.3 for 0.2", True)])
def test_no_watchdog_barks_at_commands_that_waited(bus: WaitingBus, planned: str, trips: bool) -> None:
    clock, world = LateClock(), World(PLANT, 0)
    recorder = Recorder(world)
    drives = [Drive(k, world, recorder, 60.0, 60.0) for k in range(6)]
    amplifier, plc = Amplifier(world), LinePlc(world, recorder, inf, drives)
    faults = WiredFaults(PLANT, world, recorder, (drives, amplifier, plc), clock.now_s, lambda node, now_s: None)
    face = canopen_face(PLANT, bus, drives, amplifier, plc, clock, faults.canopen)
    face.boot()
    if planned:
        faults.injector.add(parse_fault(planned), 0.0)
    bus.came(0.001, 0x000, b"\1\0")
    bus.came(0.002, 0x601, struct.pack("<BHBI", 0x2B, 0x1400, 5, WATCHDOG_MS))
    for k in range(1, 81):
        bus.came(PERIOD_S * k, 0x201, struct.pack("<Hhb", 0x06 if k < 5 else 0x0F, 0, 10))
        bus.came(PERIOD_S * k, 0x080, b"")
    clock.late_s = 0.8  # the process was stalled all the while, eight times as long as the watchdog waits
    face.pump()
    assert not bus.frames
    assert drives[0].state.name == ("FAULT" if trips else "OPERATION_ENABLED")
    watchdogs = recorder.recording().of_kind("watchdog")
    assert [event["time_s"] for event in watchdogs] == pytest.approx([0.39] if trips else [])
