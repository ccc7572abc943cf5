"""A loop on a simulated line in which nothing has a dimension of its own: time, noise and faults are those of its file.

The simulator of `sim_plant` steps by milliseconds, as the true world does. This one steps by parts of the period.
"""

import asyncio
from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np

from drivers.memory import MemoryLink
from gateway.core.controller_laws import LqiConfig
from gateway.core.line import Line, Recipe
from gateway.core.signals import Inputs
from gateway.core.states import Phase
from gateway.core.telemetry import Frame
from gateway.core.web_model import WebModel, equilibrium_torque, nominal_model, reference_speeds
from gateway.loop.cycle import Cycle
from gateway.loop.machine import Machine
from gateway.loop.pacer import Tick
from gateway.loop.watch import Watch
from safety.actions import Finding
from tests.support.proved import proved_wiring
from tests.support.similar import Similar

STEPS = 4  #: of the integration, a period
NOISE_N, NOISE_M_PER_S, SHAKEN_M_PER_S = 0.1, 1e-4, 3e-4  #: of the line that is scaled: samples, and a period's shake
TRUE = {"stiffness_n": 0.9, "length_m": 1.1, "radius_m": 0.95, "inertia_kg_m2": 1.1, "friction_nms_per_rad": 1.2}


@dataclass
class SimilarPlant:
    """The truth, which is not what the line's file says; `drivers.memory.MemoryPlant`. Torque acts a period later."""

    line: Line
    size: Similar
    seed: int = 1
    broken: int | None = None  #: a span (from 0) whose web has torn
    lost: int | None = None  #: a drive (from 0) that has gone off

    def __post_init__(self) -> None:
        nominal = nominal_model(self.line)
        self.model = WebModel(**{name: getattr(nominal, name) * share for name, share in TRUE.items()})
        n, self.rng = self.line.n, np.random.default_rng(self.seed)
        self.tension_n, self.speed, self.v0 = np.zeros(n), np.zeros(n), 0.0
        self.torque_nm = self.coming_nm = np.zeros(n)
        self.asked_m_per_s, self.last_s = 0.0, 0.0
        self.enabled = np.zeros(n, np.bool_)
        self.permissive, self.emergency_stop, self.running = True, False, False

    def stand(self, tension_n: np.ndarray, v0: float) -> np.ndarray:
        self.tension_n, self.speed = tension_n.copy(), reference_speeds(self.model, tension_n, v0)
        self.torque_nm = self.coming_nm = equilibrium_torque(self.model, tension_n, self.speed)
        self.v0 = self.asked_m_per_s = v0
        self.enabled[:], self.running = True, True
        return self.torque_nm.copy()

    def sample(self, now_s: float) -> "SimilarPlant":
        if now_s > self.last_s:
            self._advance(now_s - self.last_s)
            self.last_s = now_s
        n, size = self.line.n, self.size
        self.tension_shown = self.tension_n + NOISE_N * size.of("_n") * self.rng.standard_normal(n)
        self.speed_m_per_s = self.speed + NOISE_M_PER_S * size.of("_m_per_s") * self.rng.standard_normal(n)
        self.unwind_speed_m_per_s = self.v0 + 0.3 * NOISE_M_PER_S * size.of("_m_per_s") * self.rng.standard_normal()
        return Shown(self)  # type: ignore[return-value]

    def apply(self, torque_nm: np.ndarray, enable: np.ndarray, speed: float, run: bool, now_s: float) -> None:
        self.coming_nm, self.enabled = np.where(enable, torque_nm, 0.0), enable.copy()
        if self.lost is not None:
            self.coming_nm[self.lost], self.enabled[self.lost] = 0.0, False
        self.asked_m_per_s, self.running = speed, run

    def warn(self, on: bool, now_s: float) -> None: ...

    def _advance(self, duration_s: float) -> None:
        m, step_s = self.model, duration_s / STEPS
        self.v0 = self.asked_m_per_s if self.running else 0.0
        for _ in range(STEPS):
            before = np.concatenate(([self.v0], self.speed[:-1]))
            upstream = np.concatenate(([0.0], self.tension_n[:-1]))
            downstream = np.concatenate((self.tension_n[1:], [0.0]))
            pull = m.radius_m / m.inertia_kg_m2 * (self.torque_nm + m.radius_m * (downstream - self.tension_n))
            self.speed = self.speed + step_s * (pull - m.friction_nms_per_rad / m.inertia_kg_m2 * self.speed)
            rate = m.stiffness_n * (self.speed - before) + upstream * before - self.tension_n * self.speed
            self.tension_n = np.maximum(self.tension_n + step_s * rate / m.length_m, 0.0)
            if self.broken is not None:
                self.tension_n[self.broken] = 0.0
        shake = SHAKEN_M_PER_S * self.size.of("_m_per_s")
        self.speed = self.speed + shake * self.rng.standard_normal(self.line.n)
        self.torque_nm = self.coming_nm


class Shown:
    """`drivers.memory.MemorySample` of a plant now."""

    def __init__(self, plant: SimilarPlant) -> None:
        self.tension_n, self.speed_m_per_s = plant.tension_shown, plant.speed_m_per_s
        self.torque_nm, self.enabled = plant.torque_nm.copy(), plant.enabled.copy()
        self.unwind_speed_m_per_s = plant.unwind_speed_m_per_s
        self.permissive, self.emergency_stop, self.running = plant.permissive, plant.emergency_stop, plant.running
        self.local = False


Change = Callable[[int, "SimilarLoop"], None]  #: period, before its samples are looked at


@dataclass
class SimilarLoop:
    """A loop of `line` in production, and what `change` does to its samples and its plant in each period."""

    line: Line
    config: LqiConfig
    size: Similar
    change: Change
    told: list[tuple[int, str, str]] = field(default_factory=list)  #: period, code, and the phase that it led to
    torques: list[np.ndarray] = field(default_factory=list)  #: Nm
    tensions: list[np.ndarray] = field(default_factory=list)  #: N, true

    def __post_init__(self) -> None:
        self.now_s, self.period = 0.0, 0
        self.plant = SimilarPlant(self.line, self.size)
        self.link = MemoryLink(self.line, self.plant)
        self._collect, self.link.collect = self.link.collect, self._spoilt  # type: ignore[method-assign]
        asyncio.run(self.link.prepare())
        watch = Watch(self.line, np.zeros(self.line.n))
        self.cycle = Cycle(
            self.line, self.config, [self.link], watch, lambda: self.now_s, self._record, self._announce,
            simulated=True, budget_period_s=np.inf, wiring=proved_wiring(self.line, serials=False),
        )  # fmt: skip

    def in_production(self) -> "SimilarLoop":
        cycle, recipe = self.cycle, self.line.recipes[0]
        tension_n = np.array(recipe.tension_n)
        torque_nm = self.plant.stand(tension_n, recipe.speed_m_per_s)
        cycle.machine, cycle.outputs.torque_nm = Machine(Phase.RUNNING), torque_nm
        cycle.guard.begin(torque_nm)
        cycle.setpoints.aim_at(Recipe(name="p", tension_n=recipe.tension_n, speed_m_per_s=recipe.speed_m_per_s))
        cycle.setpoints.begin_at_speed(recipe.speed_m_per_s)
        return self

    def run(self, periods: int) -> "SimilarLoop":
        asyncio.run(self._run(periods))
        return self

    @property
    def inputs(self) -> Inputs:
        return self.cycle.inputs

    async def _run(self, periods: int) -> None:
        for self.period in range(periods):
            self.now_s = self.period * self.line.control.period_s
            await self.cycle.period(Tick(self.now_s, self.now_s, 0))
            self.torques.append(self.cycle.outputs.torque_nm.copy())
            self.tensions.append(self.plant.tension_n.copy())

    async def _spoilt(self, inputs: Inputs, deadline_s: float) -> None:
        await self._collect(inputs, deadline_s)
        self.change(self.period, self)

    def _record(self, frame: Frame) -> None: ...

    def _announce(self, before: Machine, after: Machine, findings: list[Finding]) -> None:
        codes = ",".join(sorted({finding.rule for finding in findings}))
        self.told.append((self.period, codes, after.phase.name))
