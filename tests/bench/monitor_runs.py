"""Runs of the runtime monitor's benchmark: what is deployed past any judge, on which line, and what came of it."""

from dataclasses import dataclass, replace

import numpy as np

from drivers.memory import MemoryLink, MemorySample
from gateway.cli.rehearse_designs import truth_of
from gateway.cli.stepped import SteppedLoop
from gateway.control.design import design_lqg, design_lqi, design_lqr, design_pid
from gateway.control.design.task import task_on
from gateway.control.deviation import Measured
from gateway.control.engagement import memory
from gateway.core.controller import Controller, config_hash
from gateway.core.controller_fit import misfits
from gateway.core.deployment import Deployment
from gateway.core.line import Line
from gateway.core.messages import Command, Deploy, Keep, SetSpeed, SetTension
from gateway.core.signals import BoolArray, FloatArray
from gateway.core.states import Phase
from gateway.core.telemetry import unpack
from gateway.core.theta import Theta
from safety.recoverability import Recovery
from safety.recovery_prediction import recovery_prediction
from sim_plant.plant import Plant, load_plant
from sim_plant.stepped import SteppedLine
from tests.bench.control_plants import random_plant

TENSION_N = np.array([28.0, 36.0, 20.0, 40.0, 24.0, 32.0])
SPEED_M_PER_S = 0.05
SPEEDS_M_PER_S = [0.01, 0.05, 0.1]
BELIEF = 0.03  #: by which an accepted model may be wrong, each parameter
LATE = 0.05  #: share of commands that come a cycle late under stress
DESIGNS = {"lqi": design_lqi, "lqg": design_lqg, "lqr": design_lqr, "pid": design_pid}
MOVED = 3  #: the span whose set-point moves on the way: no prediction knows that
CLASSES = ("gain", "gain of one quantity", "sign", "entries", "wrong model", "delay", "chatter")
STRESS = {
    "friction": {"coulomb_nm": 2.0},
    "eccentricity": {"share": 0.005},
}


class LateCommands:
    """A line on whose wires some commands come a cycle late: until then the one before acts."""

    def __init__(self, line: SteppedLine, generator: np.random.Generator, share: float) -> None:
        self._line, self._generator, self._share = line, generator, share
        self._before_nm: FloatArray | None = None

    def sample(self, now_s: float) -> MemorySample:
        return self._line.sample(now_s)

    def apply(
        self, torque_nm: FloatArray, enable: BoolArray, speed_request_m_per_s: float, run: bool, now_s: float
    ) -> None:
        late = self._before_nm is not None and self._generator.uniform() < self._share
        acting = self._before_nm if late and self._before_nm is not None else torque_nm
        self._before_nm = torque_nm.copy()
        self._line.apply(acting, enable, speed_request_m_per_s, run, now_s)

    def warn(self, on: bool, now_s: float) -> None:
        """Nobody is near."""


@dataclass(frozen=True)
class Case:
    """A line, what is believed of it, and what it runs with."""

    line: Line
    plant: Plant
    theta: Theta  #: the accepted model
    good: Controller
    stressed: bool
    seed: int


@dataclass(frozen=True)
class Outcome:
    left: bool  #: the true tension left its band
    lowest_n: float
    highest_n: float
    tripped: str  #: why the configuration was rolled back, or the line stopped; empty: neither
    #: Tension that was predicted when the fallback took over, less the true one: the greatest either way, in N
    error_n: tuple[float, float] | None = None


def draw_case(line: Line, seed: int, stressed: bool) -> Case:
    """S_real or a random plant, a model near its truth, and a design on that."""
    generator = np.random.default_rng(seed)
    real = generator.uniform() < 0.3
    plant = load_plant("sim_plant/plants/s_real.toml") if real else random_plant(seed)
    theta = believed(plant, generator, stressed, line.control.latency_s)
    if stressed:
        effects = plant.effects
        plant = plant.model_copy(
            update={
                "effects": effects.model_copy(
                    update={name: getattr(effects, name).model_copy(update=changes) for name, changes in STRESS.items()}
                ),
                "drives": plant.drives.model_copy(update={"torque_lag_s": 0.005}),
            }
        )
    law = ("lqi", "lqg", "lqi", "pid")[seed % 4]
    return Case(line, plant, theta, DESIGNS[law](task_on(line, theta)), stressed, seed)


def believed(plant: Plant, generator: np.random.Generator, stressed: bool, latency_s: float) -> Theta:
    """What was identified: the truth, every parameter wrong by up to `BELIEF`."""

    def near(values: FloatArray | float) -> FloatArray:
        return values * generator.uniform(1.0 - BELIEF, 1.0 + BELIEF, np.shape(values))

    web = truth_of(plant)
    web = replace(
        web,
        stiffness_n=float(near(web.stiffness_n)),
        length_m=near(web.length_m),
        inertia_kg_m2=near(web.inertia_kg_m2),
        friction_nms_per_rad=near(web.friction_nms_per_rad),
    )
    coulomb_nm = near(np.full(plant.spans, 2.0)) if stressed else np.zeros(plant.spans)
    return Theta(web, coulomb_nm, 0.005 if stressed else 0.0, latency_s)


def draw_unsafe(case: Case, generator: np.random.Generator) -> tuple[str, Controller]:
    """One of `CLASSES`, and a configuration of it. Whether it really is unsafe, a run without monitor shows."""
    kind = CLASSES[int(generator.integers(len(CLASSES)))]
    law = ("lqi", "lqg", "lqr", "pid")[int(generator.integers(4))]
    task = task_on(case.line, case.theta)
    if kind == "wrong model":
        web = case.theta.web
        factors = np.exp(generator.uniform(np.log(0.1), np.log(10.0), 3))
        wrong = replace(web, inertia_kg_m2=web.inertia_kg_m2 * factors[0], length_m=web.length_m * factors[1])
        wrong = replace(wrong, friction_nms_per_rad=web.friction_nms_per_rad * factors[2])
        return kind, DESIGNS[law](task_on(case.line, replace(case.theta, web=wrong)))
    config = DESIGNS[law](task)
    if kind == "delay":  # designed as if torque acted at once
        early = DESIGNS[law](replace(task, latency_s=0.0))
        config = early.model_copy(update={"latency_s": config.latency_s}) if law == "pid" else _padded(early, config)
        return kind, _scaled(config, float(generator.uniform(1.0, 4.0)), None, generator)
    if kind == "chatter":
        return kind, _scaled(config, float(generator.uniform(1.5, 4.0)), "speed", generator)
    if kind == "gain":
        return kind, _scaled(config, float(np.exp(generator.uniform(np.log(2.0), np.log(100.0)))), None, generator)
    if kind == "gain of one quantity":
        return kind, _scaled(config, float(np.exp(generator.uniform(np.log(3.0), np.log(300.0)))), "rows", generator)
    if kind == "sign":
        return kind, _scaled(config, -1.0, "rows" if generator.uniform() < 0.7 else None, generator)
    return kind, _scaled(config, 0.0, "entries", generator)


def _scaled(config: Controller, factor: float, part: str | None, generator: np.random.Generator) -> Controller:
    """Every gain of the feedback times `factor`; or those of some rows, of the speeds, or some entries at random."""
    changes: dict[str, list[list[float]]] = {}
    n = config.n
    rows = generator.choice(n, int(generator.integers(1, n + 1)), replace=False)
    for name in ("gain_state", "gain_input", "gain_integral", "gain_proportional", "gain_derivative"):
        if not hasattr(config, name):
            continue
        gain = np.array(getattr(config, name))
        if part == "entries":
            where = generator.uniform(size=gain.shape) < 0.1
            scale = np.abs(gain).max() * np.exp(generator.uniform(np.log(0.3), np.log(30.0)))
            gain = np.where(where, generator.normal(size=gain.shape) * scale, gain)
        elif part == "rows":
            gain[rows] *= factor
        elif part == "speed":
            if gain.shape[1] == 2 * n:
                gain[:, n:] *= factor
        else:
            gain = gain * factor
        changes[name] = gain.tolist()
    return config.model_copy(update=changes)


def _padded(early: Controller, config: Controller) -> Controller:
    """The gains of a design without dead time in a law that has it."""
    gains = {name: getattr(early, name) for name in ("gain_state", "gain_integral") if hasattr(early, name)}
    return config.model_copy(update=gains | {"gain_input": np.zeros_like(np.array(config.gain_input)).tolist()})


def begun(case: Case, config: Controller) -> SteppedLoop:
    """In production, with `config` from the start."""
    loop = SteppedLoop(case.line, config, case.plant, case.seed)
    if case.stressed:
        generator = np.random.default_rng([case.seed, 1])
        link = MemoryLink(case.line, LateCommands(loop.truth, generator, LATE))
        link._active = True  # noqa: SLF001  as `prepare` would; nothing here waits
        loop.cycle.links[0] = link
    loop.begin_in_production(TENSION_N, SPEED_M_PER_S)
    return loop


def run_deployed(case: Case, config: Controller, duration_s: float = 2.5, watched: bool = True) -> Outcome:
    """`config` takes over from the good one at 0.3 s, whatever a judge would say; a span moves at 0.7 s."""
    loop = begun(case, case.good)
    loop.step(30)
    watch = recovery_prediction(case.theta, case.good, case.line, SPEEDS_M_PER_S) if watched else None
    deployment = Deployment.model_construct(
        controller=config, hash=config_hash(config), epoch=1, lease_s=60.0, shaped_first=True,
        region=Deployment.model_fields["region"].default, watch=watch,
    )  # fmt: skip
    assert not misfits(config, case.line), misfits(config, case.line)
    reply = loop.command(Deploy.model_construct(command="deploy", deployment=deployment))
    assert reply.ok, reply
    return _judged(case, loop, 40, duration_s, [SetTension(span=MOVED, tension_n=26.0)])


def run_alone(case: Case, config: Controller, duration_s: float = 2.2) -> Outcome:
    """The same with nobody who looks after it."""
    loop = begun(case, config)
    return _judged(case, loop, 70, duration_s, [SetTension(span=MOVED, tension_n=26.0)])


def run_kept(case: Case, changes: list[Command], duration_s: float = 2.5) -> Outcome:
    """The good configuration, deployed, kept and watched with itself as fallback: then what an operator may do."""
    loop = begun(case, case.good)
    loop.step(5)
    good = case.good
    deployment = Deployment(controller=good, hash=config_hash(good), epoch=1, lease_s=60.0)
    assert loop.command(Deploy(deployment=deployment)).ok
    watch = recovery_prediction(case.theta, good, case.line, SPEEDS_M_PER_S)
    assert loop.command(Keep(epoch=1, watch=watch)).ok
    return _judged(case, loop, 50, duration_s, changes)


def run_probation(case: Case, config: Controller, changes: list[Command], duration_s: float = 2.5) -> Outcome:
    """A healthy configuration on probation, with the good one as fallback, while an operator changes set-points."""
    loop = begun(case, case.good)
    loop.step(30)
    watch = recovery_prediction(case.theta, case.good, case.line, SPEEDS_M_PER_S)
    deployment = Deployment(controller=config, hash=config_hash(config), epoch=1, lease_s=60.0, watch=watch)
    assert loop.command(Deploy(deployment=deployment)).ok
    return _judged(case, loop, 30, duration_s, changes)


def _judged(case: Case, loop: SteppedLoop, before: int, duration_s: float, changes: list[Command]) -> Outcome:
    loop.step(before)
    loop.now_s = loop.periods * case.line.control.period_s
    for change in changes:
        loop.command(change)
    limits, period_s = case.line.limits, case.line.control.period_s
    forecast = Forecast(loop, case)
    while loop.periods * period_s < duration_s:
        for _ in range(25):
            loop.step()
            forecast.look()
        tension_n = loop.truth.recorder.recording().tension_n
        lowest, highest = float(tension_n.min()), float(tension_n.max())
        left = lowest < limits.tension_min_n or highest > limits.tension_max_n
        if left or _off(loop):
            break
    why = loop.cycle.configurations.why
    said = [why] if why.startswith("rolled") else []
    said += [f"{time_s:g} s: {reason}" for time_s, _, reason in loop.transitions[:1]]
    return Outcome(left, lowest, highest, "; ".join(said), forecast.error_n())


class Forecast:
    """What the prediction says in the period in which a fallback takes over, held against what comes of it."""

    def __init__(self, loop: SteppedLoop, case: Case) -> None:
        self._loop, self._case = loop, case
        self._said: tuple[FloatArray, FloatArray] | None = None  #: tensions (k, n), and when (k,) in s

    def look(self) -> None:
        cycle, inputs = self._loop.cycle, self._loop.cycle.inputs
        if self._said is not None or self._loop.transitions or not cycle.configurations.why.startswith("rolled"):
            return  # where the line is stopped in the same period, no fallback takes over
        case = self._case
        watch = recovery_prediction(case.theta, case.good, case.line, SPEEDS_M_PER_S)
        recovery = Recovery(watch, case.good, case.line)
        sent_nm = np.array([frame.torque_nm for frame in map(unpack, self._loop.frames[-8:])])[::-1]
        measured = Measured(inputs.tension.value, inputs.speed.value, float(inputs.unwind_speed.value[0]))
        found, looks = recovery.ahead(
            measured, cycle.setpoints.tension_n, sent_nm[1 : 1 + recovery.depth], sent_nm[0],
            memory(cycle.torque_path.state),
        )  # fmt: skip
        self._said = found[: self._loop.line.n].T, self._loop.now_s + (looks + 1) * self._loop.line.control.period_s

    def error_n(self) -> tuple[float, float] | None:
        """None: no fallback took over, or the line was stopped, and control's part is over."""
        if self._said is None or self._loop.transitions:
            return None
        predicted_n, time_s = self._said
        recording = self._loop.truth.recorder.recording()
        known = time_s <= recording.time_s[-1]
        if not known.any():
            return None
        at = np.searchsorted(recording.time_s, time_s[known] - 1e-6)
        error_n = np.delete(predicted_n[known] - recording.tension_n[at], MOVED - 1, axis=1)
        return float(error_n.min()), float(error_n.max())


def _off(loop: SteppedLoop) -> bool:
    """Torque is off: what tensions do from then on is no question of control."""
    return loop.cycle.machine.phase is Phase.OFF


def steps_of(line: Line, generator: np.random.Generator, shaped: bool) -> list[Command]:
    """The largest steps that are permitted, or moves of any size."""
    limits = line.limits
    i = int(generator.integers(len(TENSION_N)))
    low, high = limits.tension_min_n + 8.0, limits.tension_max_n - 12.0
    reach = limits.tension_step_max_n
    target = TENSION_N[i] + (reach if generator.uniform() < 0.5 else -reach)
    tension = SetTension(span=i + 1, tension_n=float(np.clip(target, low, high)), step=not shaped)
    if generator.uniform() < 0.5:
        return [tension]
    if shaped:
        return [SetSpeed(speed_m_per_s=float(generator.choice([0.01, 0.1])))]
    size = min(limits.speed_step_max_m_per_s, SPEED_M_PER_S - 0.01)
    sign = 1.0 if generator.uniform() < 0.5 else -1.0
    return [SetSpeed(speed_m_per_s=SPEED_M_PER_S + sign * size, step=True)]
