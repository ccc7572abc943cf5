"""The simulated line on its wires: every device of a plant, and the one clock that drives them in real time."""

import asyncio
import time
from contextlib import AsyncExitStack
from dataclasses import dataclass, replace
from math import inf
from pathlib import Path
from typing import TYPE_CHECKING, Any

import can

from sim_plant.devices.amplifier import Amplifier
from sim_plant.devices.drive import Drive
from sim_plant.devices.line_plc import LinePlc
from sim_plant.faces.build import canopen_face, modbus_units
from sim_plant.faces.canopen import CanopenFace
from sim_plant.faces.canopen_bus import FaceUnavailable, OpenBus, explain, open_bus
from sim_plant.faces.kernel_stamp import Stamp
from sim_plant.faces.modbus import ModbusFace
from sim_plant.faults.control import ControlServer, ControlUnavailable
from sim_plant.faults.parse import Injection
from sim_plant.faults.proxy import OPC_UA, TcpProxy
from sim_plant.faults.table import Kind
from sim_plant.faults.wired import WiredFaults
from sim_plant.plant import Plant
from sim_plant.recorder import Recorder
from sim_plant.recording import EVENTS_FILE, TRACE_FILE
from sim_plant.world import World

if TYPE_CHECKING:
    from sim_plant.faces.opcua import OpcUaFace

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

    def arrival_s(self, stamped: can.Message | Stamp) -> float:
        """When the kernel took what came in, by its stamp (wall clock).

        A SYNC acts when it comes, not when this process gets to run: on a busy machine that differs by
        milliseconds, and a real drive does not have them.
        """
        waited_s = time.time() - stamped.timestamp
        believed_s = waited_s if 0.0 <= waited_s <= _LONGEST_WAIT_S else 0.0
        return max(0.0, self.now_s() - self.scale * believed_s)


@dataclass(frozen=True, slots=True)
class Settings:
    """What the process is told beside the plant. A port overrides that of the plant; port 0 takes a free one (TCP).

    A port of a wire that the plant does not use is not used either.

    The recording is not optional: it grows, so that it belongs into a folder, and it is what the line is judged by.
    """

    record_folder: Path
    seed: int = 0
    scale: float = 1.0
    can_port: int | None = None
    modbus_port: int | None = None
    opcua_port: int | None = None
    faults: tuple[Injection, ...] = ()
    control: Path | None = None
    control_is_optional: bool = False  #: a line whose control socket cannot be opened goes on without


class WiredLine:
    """All devices of a plant on their wires, in the running event loop. The devices are there to be reached.

    A face is None while its wire is not open; a wire without a device is never opened.

    `clock` is the real one unless told otherwise. Raises FileExistsError when the folder already holds a recording,
    ValueError for a port that cannot be.
    """

    def __init__(self, plant: Plant, settings: Settings, clock: WorldClock | None = None) -> None:
        self.plant = plant
        self.settings = settings
        wires = plant.wires
        self.can_port = _port("the CAN port (--can-port)", settings.can_port, wires.canopen.port, 1)
        self.modbus_port = _port("the Modbus port (--modbus-port)", settings.modbus_port, wires.modbus.port, 0)
        self.opcua_port = _port("the OPC UA port (--opcua-port)", settings.opcua_port, wires.opcua.port, 0)
        may_leave_plain = settings.control is not None or any(f.target.kind is Kind.WEB for f in settings.faults)
        _compile(plant, may_leave_plain)
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
        self.plc.interpolation_s = plant.plc.speed_interpolation_s
        self.faults = WiredFaults(
            plant,
            self.world,
            self.recorder,
            (self.drives, self.amplifier, self.plc),
            self._tcp_now_s,
            self._restart_node,
            settings.seed,
        )
        self.control = ControlServer(self.faults.injector, self.faults.now_s)
        self.canopen: CanopenFace | None = None
        self.modbus: ModbusFace | None = None
        self.opcua: OpcUaFace | None = None
        self.control_path: Path | None = None  #: None while the control socket is not open
        self.control_refused = ""  #: why an optional one is not
        self._bus: OpenBus | None = None
        self._proxy: TcpProxy | None = None

    async def open(self) -> None:
        """Open every wire and power the drives on. Raises FaceUnavailable; nothing is open or recorded then.

        Faults without a time, or at 0, come as soon as there is a device to which they can happen.
        """
        self.recorder.defer(asyncio.get_running_loop().call_soon)
        try:
            later = [fault for fault in self.settings.faults if fault.at_s]
            for fault in later:
                self.faults.injector.add(fault, 0.0)
            self._open_canopen()
            await self._open_modbus()
            await self._open_opcua()
            for fault in self.settings.faults:
                if fault not in later:
                    self.faults.injector.add(replace(fault, at_s=None), self.faults.now_s())
            await self._open_control()
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
            self.world.draw_ahead()
            if self.canopen is not None:
                self.canopen.poll()
            await asyncio.sleep(tick_s)

    async def close(self) -> None:
        """Close every wire and end the recording, each also where another fails or is cancelled. Idempotent."""
        async with AsyncExitStack() as last_first:
            last_first.callback(self.recorder.close)
            last_first.callback(self._close_canopen)
            for closed in (self.opcua, self.modbus, self._proxy, self.control):
                if closed is not None:
                    last_first.push_async_callback(closed.close)

    def _close_canopen(self) -> None:
        if self.canopen is not None:
            self.canopen.detach()
        if self._bus is not None:
            self._bus.close()
            self._bus = None

    def summary(self) -> dict[str, Any]:
        """What came of the run, as JSON."""
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
            "faces": self._face_counts(),
        }

    def ready(self) -> dict[str, Any]:
        """What others need to know to talk to the line, as JSON. The port of a wire that is not open is null.

        `control` is the path of the control socket, null without one.
        """
        return {
            "ready": True,
            "plant": self.plant.name,
            "spans": self.plant.spans,
            "can_port": self.can_port if self.canopen else None,
            "modbus_port": self.modbus_port if self.modbus else None,
            "opcua_port": self.opcua_port if self.opcua else None,
            "control": None if self.control_path is None else str(self.control_path),
            "monotonic_start_s": self.clock.monotonic_start_s,
        }

    def _face_counts(self) -> dict[str, Any]:
        faces: dict[str, Any] = {}
        if can_face := self.canopen:
            faces["canopen"] = {
                "malformed": can_face.malformed,
                "foreign": can_face.foreign,
                "send_errors": can_face.send_errors,
            }
            if wire := can_face.wire:
                faces["canopen"] |= {"wire_busy_s": wire.busy_s, "wire_overflows": wire.overflows}
        if modbus := self.modbus:
            faces["modbus"] = {
                "requests": modbus.requests,
                "malformed": modbus.malformed,
                "refused": modbus.refused,
            }
        if opcua := self.opcua:
            faces["opcua"] = {"requests": opcua.requests, "malformed": opcua.malformed}
        return faces

    def _open_canopen(self) -> None:
        wire = self.plant.wires.canopen
        if not self.plant.wires.on("canopen", self.plant.spans):
            return
        self._bus = open_bus(wire.interface, wire.channel, self.can_port)
        face = canopen_face(
            self.plant, self._bus.bus, self.drives, self.amplifier, self.plc, self.clock, self.faults.canopen
        )
        self.canopen = face
        try:
            face.boot()
        except can.CanError as error:
            raise FaceUnavailable(explain(wire.channel, self.can_port, error)) from error
        face.attach(asyncio.get_running_loop(), self.settings.scale)

    async def _open_modbus(self) -> None:
        host = self.plant.wires.modbus.host
        units = modbus_units(self.plant, self.world, self.drives, self.amplifier, self.plc)
        if not units:
            return
        face = ModbusFace(units, self._tcp_now_s, self._tcp_arrival_s, self.faults.modbus, self.settings.scale)
        try:
            self.modbus_port = await face.open(host, self.modbus_port)
        except OSError as error:
            raise _port_unavailable("Modbus", host, self.modbus_port, error) from error
        self.modbus = face

    async def _open_opcua(self) -> None:
        there = self.plant.wires.on("opcua", self.plant.spans)
        if not there:
            return
        from sim_plant.faces.opcua import OpcUaFace  # it loads hundreds of modules, which most lines do not need

        host = self.plant.wires.opcua.host
        axes = {roller: self.drives[roller - 1] for roller in there.rollers}
        amplifier, plc = self.amplifier if there.cells else None, self.plc if there.plc else None
        face = OpcUaFace(axes, amplifier, there.cells, plc, self._tcp_now_s)
        try:
            if self.settings.faults or self.settings.control:
                self._proxy = TcpProxy(self.faults.opcua, OPC_UA, host, await face.open(host, 0), self.settings.scale)
                self.opcua_port = await self._proxy.open(host, self.opcua_port)
            else:
                self.opcua_port = await face.open(host, self.opcua_port)
        except OSError as error:
            raise _port_unavailable("OPC UA", host, self.opcua_port, error) from error
        self.opcua = face

    async def _open_control(self) -> None:
        path = self.settings.control
        if path is None:
            return
        try:
            await self.control.open(path)
        except ControlUnavailable as error:
            if not self.settings.control_is_optional:
                raise FaceUnavailable(str(error)) from error
            self.control_refused = str(error)
        else:
            self.control_path = path

    def _discard_recording(self) -> None:
        """Of a line that never lived: the next attempt may have the folder."""
        for name in (EVENTS_FILE, TRACE_FILE):
            (self.settings.record_folder / name).unlink()
        if not self._folder_was_there:
            self.settings.record_folder.rmdir()

    def _restart_node(self, node_id: int, now_s: float) -> None:
        assert self.canopen is not None
        self.canopen.restart(node_id, now_s)

    def _drive(self, index: int) -> Drive:
        drives = self.plant.drives
        rate = inf if drives.torque_rate_nm_per_s is None else drives.torque_rate_nm_per_s
        return Drive(index, self.world, self.recorder, drives.rated_torque_nm, drives.max_torque_nm, rate)

    def _tcp_now_s(self) -> float:
        # Frames that came before this request act before it, whichever socket the event loop looks at first.
        self._pump()
        return self.clock.now_s()

    def _tcp_arrival_s(self, stamp: Stamp) -> float:
        self._pump()
        return self.clock.arrival_s(stamp)

    def _pump(self) -> None:
        if self.canopen is not None:
            self.canopen.pump()


def _port(name: str, told: int | None, plants: int, lowest: int) -> int:
    if told is None:
        return plants
    if not lowest <= told <= 65535:
        raise ValueError(f"{name} is {told}; allowed: {lowest} to 65535")
    return told


def _port_unavailable(wire: str, host: str, port: int, error: OSError) -> FaceUnavailable:
    return FaceUnavailable(
        f"the {wire} port {port} on {host} cannot be opened: {error.strerror or error}. "
        "Stop what has it, or choose another (0 takes a free one)"
    )


def _compile(plant: Plant, full: bool) -> None:
    """Have the physics compiled before the clock starts: the first step would take a second, or some if `full`."""
    world = World(plant, 0)
    if full:
        world.compile_full_line()
    Recorder(world)
    world.advance(0.002)
