"""Stepped time: the whole cycle over an in-memory link against the simulated line, as fast as the machine goes."""

import time
from collections.abc import Awaitable, Sequence
from dataclasses import dataclass, field
from math import ceil, inf
from typing import Any, TypeVar

import numpy as np

from drivers.memory import MemoryLink
from gateway.cli.timed_law import TimedLaw
from gateway.control.laws import make_law, untimed
from gateway.core.controller import Controller, ControllerRefused
from gateway.core.finding import Finding as Coded
from gateway.core.line import Line, Recipe
from gateway.core.messages import Arm, Command, Deploy, Drill, Event, Keep, Reply, WatchGood
from gateway.core.metrics import RunMetrics, run_metrics
from gateway.core.scenario import Scenario
from gateway.core.signals import FloatArray
from gateway.core.states import Phase
from gateway.core.telemetry import Frame, pack, unpack
from gateway.core.wiring_proof import CellProved, DriveProved, WatchdogProved
from gateway.loop.arming import not_armed, prepare_links, refusal_to_arm
from gateway.loop.commands import carry_out
from gateway.loop.cycle import Cycle
from gateway.loop.deploy import NOT_DONE, Prepared, prepare, require
from gateway.loop.drill import NO_WATCHDOG
from gateway.loop.machine import Machine
from gateway.loop.pacer import Tick
from gateway.loop.refused import Refused, coded, said
from gateway.loop.watch import Watch
from gateway.loop.wiring import Wiring
from safety.actions import Finding
from sim_plant.plant import Plant
from sim_plant.stepped import SteppedLine

T = TypeVar("T")


def shown_as_described(line: Line) -> tuple[list[DriveProved], list[CellProved], list[WatchdogProved]]:
    """What drives, load cells and watchdogs of a line that is wired as its file says have shown, at no torque."""
    drives = [
        DriveProved(drive=drive.name, roller=drive.roller, torque_nm=0.0, way_m=0.0, answered=[drive.roller])
        for drive in line.drives
    ]
    cells = [
        CellProved(cell=cell.name, span=cell.span, zero_n=0.0, factor=1.0, answered_to=[cell.span])
        for cell in line.load_cells
    ]
    watchdogs = [
        WatchdogProved(device=name, deadline_s=line.limits.watchdog_s, reacted_s=None, how=NO_WATCHDOG)
        for name in [*(drive.name for drive in line.drives), line.plc.name]
    ]
    return drives, cells, watchdogs


def wired_as_described(line: Line) -> Wiring:
    """The wiring of a simulation in memory: its plant is made of numbers, and no cell can be another's."""
    wiring = Wiring(line, {})
    wiring.write(wiring.proof_of(*shown_as_described(line), []))
    wiring.take_written()
    return wiring


class CommandRefused(Exception):
    """The line has refused a scenario's change; the text says why."""


@dataclass
class SteppedLoop:
    """A loop and a simulated line that share a clock which only `step` moves."""

    line: Line
    config: Controller
    plant: Plant
    seed: int = 0
    frames: list[bytes] = field(default_factory=list[bytes])
    transitions: list[tuple[float, Phase, str]] = field(default_factory=list[tuple[float, Phase, str]])
    stopped_by: list[tuple[float, Finding]] = field(default_factory=list[tuple[float, Finding]])  #: led to a transition
    alarms: list[tuple[float, Finding]] = field(default_factory=list[tuple[float, Finding]])
    told: list[tuple[str, str]] = field(default_factory=list[tuple[str, str]])  #: kind and text
    events: list[Event] = field(default_factory=list[Event])  #: the same with their data

    def __post_init__(self) -> None:
        self.now_s = 0.0
        self.periods = 0
        self.truth = SteppedLine(self.plant, self.seed, self.line.control.latency_s)
        link = MemoryLink(self.line, self.truth)
        watch = Watch(self.line, np.zeros(self.line.n))  # the memory link carries floats
        self.cycle = Cycle(
            self.line, self.config, [link], watch, lambda: self.now_s, self._record, self._announce, self._tell,
            simulated=True, wiring=wired_as_described(self.line),
            law_of=lambda config: TimedLaw(make_law(untimed(config))), budget_period_s=inf,
        )  # fmt: skip
        law = self.cycle.torque_path.law
        assert isinstance(law, TimedLaw)
        self.law: TimedLaw[Any] = law  #: the one that it starts with
        _finish(link.open())

    def begin_in_production(self, tension_n: FloatArray, unwind_speed_m_per_s: float) -> None:
        """Start at the plant's own equilibrium with the law engaged there, as after hours of running."""
        torque = self.truth.start_at_equilibrium(tension_n, unwind_speed_m_per_s)
        cycle = self.cycle
        _finish(cycle.links[0].prepare())
        cycle.machine = Machine(Phase.RUNNING)
        cycle.outputs.torque_nm = torque.copy()
        cycle.guard.begin(torque)
        recipe = Recipe(name="production", tension_n=tension_n.tolist(), speed_m_per_s=unwind_speed_m_per_s)
        cycle.setpoints.aim_at(recipe)
        cycle.setpoints.begin_at_speed(unwind_speed_m_per_s)
        cycle.torque_path.unmeasured_n = tension_n.copy()  # of draw spans: no load cell says it

    def arm(self, command: Arm | Drill | None = None) -> Reply:
        """As the operator's `arm`, or `drill`, without waiting for the drives: step on until READY, or OFF."""
        if (refusal := refusal_to_arm(self.cycle)) is not None:
            return refusal
        self._release_links()
        if reasons := _finish(prepare_links(self.cycle)):
            self._release_links()
            return not_armed(self.cycle, reasons)
        self.cycle.wiring.look(self.cycle.links)
        return self.command(command or Arm())

    def command(self, command: Command) -> Reply:
        """Do it between two periods, with what the loop's process would prepare aside."""
        prepared: Prepared = None
        if isinstance(command, Deploy | Keep | WatchGood):
            try:
                require(self.cycle, command)
                prepared = prepare(self.cycle, command)
            except Refused:
                pass  # and is refused with the same words below
            except ControllerRefused as refused:
                return self._not_done(NOT_DONE[type(command)], refused.findings or [str(refused)])
        return carry_out(self.cycle, command, self.now_s, prepared)

    def _not_done(self, text: str, reasons: Sequence[str | Coded]) -> Reply:
        in_service = self.cycle.configurations.in_service(self.now_s)
        return Reply(
            ok=False, state=self.cycle.machine.state.name, text=text, reasons=said(reasons), findings=coded(reasons),
            in_service=in_service,
        )  # fmt: skip

    def _release_links(self) -> None:
        for link in self.cycle.links:
            _finish(link.release())

    def step(self, periods: int = 1) -> None:
        """Run control periods; each cycle runs at its due time."""
        period_s = self.line.control.period_s
        for _ in range(periods):
            self.now_s = self.periods * period_s
            _finish(self.cycle.period(Tick(self.now_s, self.now_s, 0)))
            self.periods += 1

    def step_until(self, phase: Phase, within_s: float) -> bool:
        """Step until the machine is in `phase`; False when it is not within that time."""
        for _ in range(ceil(within_s / self.line.control.period_s)):
            if self.cycle.machine.phase is phase:
                return True
            self.step()
        return self.cycle.machine.phase is phase

    def recorded(self) -> list[Frame]:
        return [unpack(frame) for frame in self.frames]

    def _record(self, frame: Frame) -> None:
        self.frames.append(pack(frame))

    def _tell(self, kind: str, text: str, **data: object) -> None:
        self.told.append((kind, text))
        self.events.append(Event(time_s=self.now_s, kind=kind, text=text, data=data))

    def _announce(self, before: Machine, after: Machine, findings: list[Finding]) -> None:
        if after.phase is before.phase:
            self.alarms += [(self.now_s, finding) for finding in findings]
        else:
            self.transitions.append((self.now_s, after.phase, after.reason))
            self.stopped_by += [(self.now_s, finding) for finding in findings]


@dataclass(frozen=True)
class SteppedResult:
    """A scenario in stepped time, judged by the recorder at the simulated devices."""

    metrics: RunMetrics
    unsafe_events: int
    stopped: str | None  #: when and why the gateway left RUN, if it did: the line may still be slowing at the end
    wall_s: float  #: what it took
    step_s: FloatArray  #: (periods,), what the law itself took in each, on this computer
    time_s: FloatArray  #: (k,), every millisecond
    setpoint_n: FloatArray  #: (k, n)
    tension_n: FloatArray  #: (k, n), true
    torque_nm: FloatArray  #: (k, n), at the drives

    @property
    def rmse_n(self) -> float:
        return self.metrics.rmse_n


def periods_before(scenario: Scenario, period_s: float) -> int:
    """Control periods before the change. At least one must be: it is then that the law takes over."""
    return round(scenario.change_at_s / period_s)


def run_scenario(line: Line, config: Controller, plant: Plant, scenario: Scenario, seed: int) -> SteppedResult:
    """The scenario from the plant's own equilibrium on, over its whole duration.

    Raises CommandRefused where the line refuses the change: it has been stopped, or it is not allowed.
    """
    loop = SteppedLoop(line, config, plant, seed)
    loop.begin_in_production(np.array(scenario.tension_n), scenario.speed_m_per_s)
    period_s = line.control.period_s
    before = periods_before(scenario, period_s)
    started_s = time.perf_counter()
    loop.step(before)
    loop.now_s = loop.periods * period_s
    for command in scenario.commands():
        reply = loop.command(command)
        if not reply.ok:
            raise CommandRefused(_left_production(loop) or reply.text)
    loop.step(round(scenario.duration_s / period_s) - before)
    loop.truth.sample(scenario.duration_s)
    wall_s = time.perf_counter() - started_s
    found = loop.truth.recorder.recording()
    setpoint = scenario.setpoints_n(found.time_s)
    return SteppedResult(
        metrics=run_metrics(found.time_s, found.tension_n, setpoint, found.torque_nm, scenario.change_at_s),
        unsafe_events=loop.truth.recorder.unsafe_total,
        stopped=_left_production(loop),
        wall_s=wall_s,
        step_s=np.array(loop.law.step_s),
        time_s=found.time_s,
        setpoint_n=setpoint,
        tension_n=found.tension_n,
        torque_nm=found.torque_nm,
    )


def _left_production(loop: SteppedLoop) -> str | None:
    """When and why the gateway has stopped a line that began in production; None: it has not."""
    if not loop.transitions:
        return None
    time_s, _, reason = loop.transitions[0]
    return f"stopped at {time_s:g} s: {reason}"


def _finish(awaitable: Awaitable[T]) -> T:
    """The result of something that never waits: no event loop is needed, and none is paid for."""
    coroutine = awaitable.__await__()
    try:
        next(coroutine)
    except StopIteration as end:
        return end.value
    raise RuntimeError("an in-memory link has waited for something")
