"""The simulated line on its wires: every device of a plant, and the one clock that drives them in real time."""

import asyncio
import time
from dataclasses import dataclass
from math import inf
from pathlib import Path
from typing import Any

import can

from sim_plant.devices.amplifier import Amplifier
from sim_plant.devices.drive import Drive
from sim_plant.devices.line_plc import LinePlc
from sim_plant.faces.canopen import CanopenFace
from sim_plant.faces.canopen_bus import FaceUnavailable, OpenBus, explain, open_bus
from sim_plant.faces.modbus import ModbusFace
from sim_plant.faces.modbus_units import AmplifierRegisters, PlcRegisters
from sim_plant.plant import Plant
from sim_plant.recorder import Recorder
from sim_plant.recording import EVENTS_FILE, TRACE_FILE
from sim_plant.world import World

#: Every wire event advances the line; this does when there are none. Timers of the devices act at their own
#: millisecond whenever the line is advanced past it.
_TICK_S = 0.005
#: A frame that seems to have waited longer on its way from the kernel tells of a wall clock that was set.
_LONGEST_WAIT_S = 0.25


class WorldClock:
    """World time: 0 when this is made, then `scale` times as fast as CLOCK_MONOTONIC."""

    def __init__(self, scale: float) -> None:
        self.scale = scale
        self.monotonic_start_s = time.monotonic()

    def now_s(self) -> float:
        return self.scale * (time.monotonic() - self.monotonic_start_s)

    def arrival_s(self, message: can.Message) -> float:
        """When the kernel took the frame, by its stamp (wall clock).

        A SYNC acts when it comes, not when this process gets to run: on a busy machine that differs by
        milliseconds, and a real drive does not have them.
        """
        waited_s = time.time() - message.timestamp
        believed_s = waited_s if 0.0 <= waited_s <= _LONGEST_WAIT_S else 0.0
        return max(0.0, self.now_s() - self.scale * believed_s)


@dataclass(frozen=True, slots=True)
class Settings:
    """What the process is told beside the plant. A port overrides that of the plant; Modbus port 0 takes a free one.

    The recording is not optional: it grows, so that it belongs into a folder, and it is what the line is judged by.
    """

    record_folder: Path
    seed: int = 0
    scale: float = 1.0
    can_port: int | None = None
    modbus_port: int | None = None


class WiredLine:
    """All devices of a plant on their wires, in the running event loop. The devices are there to be reached.

    `clock` is the real one unless told otherwise. Raises FileExistsError when the folder already holds a recording, ValueError for a port that cannot be.
    """

    def __init__(self, plant: Plant, settings: Settings, clock: WorldClock | None = None) -> None:
        self.plant = plant
        self.settings = settings
        self.can_port = plant.wires.canopen.port if settings.can_port is None else settings.can_port
        self.modbus_port = plant.wires.modbus.port if settings.modbus_port is None else settings.modbus_port
        _check_port("the CAN port (--can-port)", self.can_port, 1)
        _check_port("the Modbus port (--modbus-port)", self.modbus_port, 0)
        _compile(plant)
        self.clock = clock or WorldClock(settings.scale)
        self.world = World(plant, settings.seed)
        self._folder_was_there = settings.record_folder.exists()
        self.recorder = Recorder.to_folder(
            settings.record_folder, self.world, self.clock.monotonic_start_s, settings.scale
        )
        self.drives = [self._drive(k) for k in range(plant.spans)]
        self.amplifier = Amplifier(self.world)
        ramp = plant.plc.speed_ramp_m_per_s2
        self.plc = LinePlc(self.world, self.recorder, inf if ramp == "step" else ramp, self.drives)
        wires = plant.wires.modbus
        units = {wires.amplifier_unit: AmplifierRegisters(self.amplifier), wires.plc_unit: PlcRegisters(self.plc)}
        self.modbus = ModbusFace(units, self._modbus_now_s)
        self.canopen: CanopenFace | None = None
        self._bus: OpenBus | None = None

    async def open(self) -> None:
        """Open every wire and power the drives on. Raises FaceUnavailable; nothing is open or recorded then."""
        try:
            self._open_canopen()
            await self._open_modbus()
        except BaseException:
            await self.close()
            self._discard_recording()
            raise

    async def run(self, stop: asyncio.Event) -> None:
        """Let the line live, also while nothing comes in, until `stop` is set."""
        tick_s = _TICK_S / max(1.0, self.settings.scale)
        while not stop.is_set():
            self._pump()
            self.world.advance(self.clock.now_s())
            if self.canopen is not None:
                self.canopen.poll()
            await asyncio.sleep(tick_s)

    async def close(self) -> None:
        """Close every wire and end the recording. Idempotent."""
        await self.modbus.close()
        if self.canopen is not None:
            self.canopen.detach()
        if self._bus is not None:
            self._bus.close()
            self._bus = None
        self.recorder.close()

    def summary(self) -> dict[str, Any]:
        """What came of the run, as JSON."""
        faces: dict[str, Any] = {
            "modbus": {
                "requests": self.modbus.requests,
                "malformed": self.modbus.malformed,
                "refused": self.modbus.refused,
            }
        }
        if self.canopen is not None:
            faces["canopen"] = {
                "malformed": self.canopen.malformed,
                "foreign": self.canopen.foreign,
                "send_errors": self.canopen.send_errors,
            }
        return {
            "plant": self.plant.name,
            "spans": self.plant.spans,
            "seed": self.settings.seed,
            "time_scale": self.settings.scale,
            "world_time_s": self.world.now_s,
            "cpu_s": time.process_time(),
            "unsafe_total": self.recorder.unsafe_total,
            "unsafe_events": self.recorder.unsafe_events,
            "counts": self.recorder.counts,
            "faces": faces,
        }

    def ready(self) -> dict[str, Any]:
        """What others need to know to talk to the line, as JSON."""
        return {
            "ready": True,
            "plant": self.plant.name,
            "spans": self.plant.spans,
            "can_port": self.can_port,
            "modbus_port": self.modbus_port,
            "monotonic_start_s": self.clock.monotonic_start_s,
        }

    def _open_canopen(self) -> None:
        wire = self.plant.wires.canopen
        self._bus = open_bus(wire.interface, wire.channel, self.can_port)
        face = CanopenFace(self._bus.bus, self.drives, wire.first_node, self.clock.now_s, self.clock.arrival_s)
        self.canopen = face
        try:
            face.boot()
        except can.CanError as error:
            raise FaceUnavailable(explain(wire.channel, self.can_port, error)) from error
        face.attach(asyncio.get_running_loop())

    async def _open_modbus(self) -> None:
        host = self.plant.wires.modbus.host
        try:
            self.modbus_port = await self.modbus.open(host, self.modbus_port)
        except OSError as error:
            raise FaceUnavailable(
                f"the Modbus port {self.modbus_port} on {host} cannot be opened: {error.strerror or error}. "
                "Stop what has it, or choose another (0 takes a free one)"
            ) from error

    def _discard_recording(self) -> None:
        """Of a line that never lived: the next attempt may have the folder."""
        for name in (EVENTS_FILE, TRACE_FILE):
            (self.settings.record_folder / name).unlink()
        if not self._folder_was_there:
            self.settings.record_folder.rmdir()

    def _drive(self, index: int) -> Drive:
        drives = self.plant.drives
        rate = inf if drives.torque_rate_nm_per_s is None else drives.torque_rate_nm_per_s
        return Drive(index, self.world, self.recorder, drives.rated_torque_nm, drives.max_torque_nm, rate)

    def _modbus_now_s(self) -> float:
        # Frames that came before this request act before it, whichever socket the event loop looks at first.
        self._pump()
        return self.clock.now_s()

    def _pump(self) -> None:
        if self.canopen is not None:
            self.canopen.pump()


def _check_port(name: str, port: int, lowest: int) -> None:
    if not lowest <= port <= 65535:
        raise ValueError(f"{name} is {port}; allowed: {lowest} to 65535")


def _compile(plant: Plant) -> None:
    """Have the physics compiled before the clock starts: the first step would take a second."""
    world = World(plant, 0)
    Recorder(world)
    world.advance(0.002)
