"""Gateway loop and simulated line over their real wires, in one process and in virtual time.

Drivers, codecs, sockets and simulated devices are the real ones; the clock is not. A period runs at its due time and
takes none itself, and what is sent has arrived in the same instant. Between two calls from outside nothing happens.
"""

import asyncio
from collections.abc import Callable, Coroutine
from contextlib import AsyncExitStack
from dataclasses import dataclass
from math import ceil
from pathlib import Path
from tempfile import TemporaryDirectory
from types import TracebackType
from typing import Any, Self, TypeVar

import numpy as np

from drivers.port import Link
from drivers.registry import build_links, drive_tells, speed_steps_m_per_s
from gateway.control.design import design_lqi, task_of
from gateway.core.controller import Controller
from gateway.core.line import Bus, Line, OpcUaBus, Recipe
from gateway.core.messages import Arm, Command, Reply, Start
from gateway.core.signals import DriveRequest, FloatArray
from gateway.core.states import Phase
from gateway.core.telemetry import Frame, pack, unpack
from gateway.loop.cycle import Cycle
from gateway.loop.machine import Machine
from gateway.loop.pacer import Tick
from gateway.loop.runner import Runner
from gateway.loop.watch import Watch
from safety.actions import Finding
from sim_plant.faces.canopen_bus import FaceUnavailable
from sim_plant.plant import Plant
from sim_plant.recorder import read_recording
from sim_plant.recording import Recording
from sim_plant.wired import Settings, WiredLine, WorldClock
from tests.closed_loop.conftest import demo_line, real_plant
from tests.support.ports import free_port
from tests.support.proved import proved_wiring
from tests.support.virtual_time import VirtualTimeLoop

T = TypeVar("T")

ENABLED_WITHIN_S = 1.0
MOST_ATTEMPTS = 5  #: to find a free CAN port


@dataclass(frozen=True)
class Transition:
    time_s: float  #: the loop's clock
    phase: Phase
    reason: str


class VirtualClock(WorldClock):
    """World time on the event loop's clock."""

    def __init__(self, loop: asyncio.AbstractEventLoop) -> None:
        self._loop = loop
        self.scale = 1.0
        self.monotonic_start_s = loop.time()

    def now_s(self) -> float:
        return self._loop.time() - self.monotonic_start_s

    def arrival_s(self, stamped: object) -> float:
        """What comes in was sent in this very instant; its stamp is of the wall clock."""
        return self.now_s()


class VirtualPacer:
    """Ticks every `period_s`; periods that went by during a stall are skipped, as `TimerPacer` does."""

    def __init__(self, period_s: float) -> None:
        self._period_s = period_s
        self._start_s = asyncio.get_running_loop().time()
        self._ticks = 0  #: that went by, used or not
        self._stall_s = 0.0

    def stall(self, for_s: float) -> None:
        """The next tick is noticed this much later than it is due."""
        self._stall_s = for_s

    async def wait(self) -> Tick:
        loop = asyncio.get_running_loop()
        stall_s, self._stall_s = self._stall_s, 0.0
        await _until(max(self._due_s(1), loop.time()) + stall_s)
        skipped = 0
        while self._due_s(2 + skipped) <= loop.time():
            skipped += 1
        due_s = self._due_s(1 + skipped)
        self._ticks += 1 + skipped
        return Tick(due_s, max(due_s, loop.time()), skipped)

    def _due_s(self, ahead: int) -> float:
        return round(self._start_s + (self._ticks + ahead) * self._period_s, 9)  # the loop counts nanoseconds


class VirtualLine:
    """Context. The loop is SILENT, all devices are on; what its methods do takes virtual time only.

    Times are those of the event loop; `world_s` makes times of the recorder of them. `folder` is where the recorder
    writes, a temporary one unless given. The ports of `line` and `plant` are replaced by free ones. `build` makes the
    links; none of them may have a process of its own, which would not know the time.

    A plant whose CAN frames take their time on the wire (`wire_time`) cannot be armed here: the thread that waits for
    the answer to an SDO request keeps time from going on.
    """

    def __init__(
        self,
        line: Line | None = None,
        plant: Plant | None = None,
        config: Controller | None = None,
        seed: int = 1,
        folder: Path | None = None,
        build: Callable[[Line], list[Link]] = build_links,
        *,
        proved: bool = True,
    ) -> None:
        """`proved`: its wiring has been, before."""
        self._proved = proved
        self.frames: list[bytes] = []
        self.transitions: list[Transition] = []
        self.findings: list[Finding] = []  #: that came with a transition or an alarm
        self._asked_line = line or demo_line()
        self._plant = plant or real_plant(self._asked_line.n)
        self._config = config or design_lqi(task_of(self._asked_line))
        self._seed = seed
        self._build = build
        self._temporary = TemporaryDirectory() if folder is None else None
        self._folder = folder or Path(self._temporary.name if self._temporary else "") / "recording"
        self._opened = AsyncExitStack()
        self._asyncio = asyncio.Runner(loop_factory=VirtualTimeLoop)

    def __enter__(self) -> Self:
        try:
            self._run(self._open())
        except BaseException:
            self.__exit__(None, None, None)
            raise
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        try:
            self._run(self._opened.aclose())
        finally:
            self._asyncio.close()
            if self._temporary is not None:
                self._temporary.cleanup()

    # time

    @property
    def now_s(self) -> float:
        return self._asyncio.get_loop().time()

    @property
    def period_s(self) -> float:
        return self.line.control.period_s

    def world_s(self, time_s: float) -> float:
        return time_s - self.truth.clock.monotonic_start_s

    def step(self, periods: int = 1) -> None:
        """Run control periods."""
        self._run(self._periods(periods))

    def step_until(self, phase: Phase, within_s: float) -> bool:
        """Run periods until the machine is in `phase`; False when it is not within that time."""
        for _ in range(ceil(within_s / self.period_s)):
            if self.cycle.machine.phase is phase:
                return True
            self.step()
        return self.cycle.machine.phase is phase

    def stall(self, periods: float) -> None:
        """The next tick is noticed this many periods late; the devices live on meanwhile.

        Milder than a process that is stopped: what the drives say is heard in time.
        """
        self.pacer.stall(periods * self.period_s)

    def run(self, story: Coroutine[Any, Any, T]) -> T:
        """Run `story` among the devices; no period runs meanwhile."""
        return self._run(story)

    def pass_time(self, for_s: float) -> None:
        """The loop's process is gone: no period runs. The devices live on."""
        self._run(asyncio.sleep(for_s))

    # the operator

    def command(self, command: Command) -> Reply:
        """Give a command and run periods until it is answered; at least one."""
        return self._run(self._command(command))

    def arm(self) -> Reply:
        return self.command(Arm())

    def start(self) -> Reply:
        return self.command(Start())

    def begin_in_production(self, tension_n: FloatArray | None = None, speed_m_per_s: float | None = None) -> None:
        """Be where the line is after hours of running: at the plant's equilibrium, the law engaged there.

        Arming and enabling are gone through on the wires; only the tensioning is left out. The tensions (n,) and v0
        are those of the line's first recipe unless given.
        """
        recipe = self.line.recipes[0]
        tension_n = np.array(recipe.tension_n) if tension_n is None else tension_n
        speed_m_per_s = recipe.speed_m_per_s if speed_m_per_s is None else speed_m_per_s
        self.step(3)
        for reply in (self.arm(), self.start()):
            assert reply.ok, f"{reply.text}: {reply.reasons}"
        assert self.step_until(Phase.TENSIONING, ENABLED_WITHIN_S), self.cycle.machine.reason
        self._run(self._jump(tension_n, speed_m_per_s))

    # what came of it

    def recorded(self) -> list[Frame]:
        """The telemetry, a frame a period."""
        return [unpack(frame) for frame in self.frames]

    def recording(self) -> Recording:
        """What the recorder at the devices has so far; times are world times."""
        self.truth.recorder.flush()
        return read_recording(self._folder)

    # composition, as the loop's process does it

    async def _open(self) -> None:
        self.truth = await self._open_devices()
        self._opened.push_async_callback(self.truth.close)
        stop = asyncio.Event()
        living = asyncio.create_task(self.truth.run(stop), name="simulated line")
        self._opened.push_async_callback(asyncio.wait_for, living, None)
        self._opened.callback(stop.set)
        self.line = _with_ports(self._asked_line, self._plant, self.truth)
        self.links = self._build(self.line)
        self._new_cycle()
        for link in self.links:
            self._opened.push_async_callback(link.close)
            await link.open()
        self.pacer = VirtualPacer(self.period_s)

    async def _open_devices(self) -> WiredLine:
        clock = VirtualClock(asyncio.get_running_loop())
        attempts = 0
        while True:
            settings = Settings(self._folder, self._seed, can_port=free_port(), modbus_port=0, opcua_port=0)
            truth = WiredLine(self._plant, settings, clock)
            try:
                await truth.open()
                return truth
            except FaceUnavailable:  # another line on this machine was quicker to take the port
                attempts += 1
                if attempts == MOST_ATTEMPTS:
                    raise

    def _new_cycle(self) -> None:
        clock = asyncio.get_running_loop().time
        watch = Watch(self.line, speed_steps_m_per_s(self.line), drive_tells(self.line))
        self.cycle = Cycle(
            self.line, self._config, self.links, watch, clock, self._record, self._announce,
            wiring=proved_wiring(self.line) if self._proved else None,
        )  # fmt: skip
        self.runner = Runner(self.cycle)

    async def _periods(self, count: int) -> None:
        for _ in range(count):
            await self.runner.period(await self.pacer.wait())

    async def _command(self, command: Command) -> Reply:
        answer = asyncio.create_task(self.runner.submit(command))
        while not answer.done():
            await self._periods(1)
            await asyncio.sleep(0)
        return answer.result()

    async def _jump(self, tension_n: FloatArray, speed_m_per_s: float) -> None:
        world = self.truth.world
        torque_nm = world.start_at_equilibrium(tension_n, speed_m_per_s)
        self.truth.recorder.started(torque_nm, world.now_s)
        self._new_cycle()  # it must not remember the tensions before
        cycle, outputs = self.cycle, self.cycle.outputs
        cycle.machine = Machine(Phase.RUNNING, self.now_s)
        cycle.setpoints.aim_at(Recipe(name="production", tension_n=tension_n.tolist(), speed_m_per_s=speed_m_per_s))
        cycle.setpoints.begin_at_speed(speed_m_per_s)
        outputs.speed_request_m_per_s = speed_m_per_s
        outputs.torque_nm = torque_nm.copy()
        outputs.drive_request[:] = DriveRequest.ENABLE
        outputs.run = True
        for link in self.links:  # in place of what the period before has handed over
            link.write(outputs)

    def _run(self, story: Coroutine[Any, Any, T]) -> T:
        return self._asyncio.run(story)

    def _record(self, frame: Frame) -> None:
        self.frames.append(pack(frame))

    def _announce(self, before: Machine, after: Machine, findings: list[Finding]) -> None:
        self.findings += findings
        if after.phase is not before.phase:
            self.transitions.append(Transition(self.now_s, after.phase, after.reason))


async def _until(time_s: float) -> None:
    """As `asyncio.sleep`, without the rounding of a difference."""
    loop = asyncio.get_running_loop()
    woken = loop.create_future()
    timer = loop.call_at(time_s, woken.set_result, None)
    try:
        await woken
    finally:
        timer.cancel()


def _with_ports(line: Line, plant: Plant, truth: WiredLine) -> Line:
    """`line` with the ports that its devices really listen on, in place of those of the plant's file."""
    wires = plant.wires
    ports = {wires.canopen.port: truth.can_port, wires.modbus.port: truth.modbus_port}
    buses: list[Bus] = []
    for bus in line.buses:
        if isinstance(bus, OpcUaBus):
            endpoint = bus.endpoint.replace(f":{wires.opcua.port}", f":{truth.opcua_port}")
            buses.append(bus.model_copy(update={"endpoint": endpoint}))
        else:
            buses.append(bus.model_copy(update={"port": ports.get(bus.port or 0, bus.port)}))
    return line.model_copy(update={"buses": buses})
