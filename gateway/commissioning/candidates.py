"""What the commissioning chain proposes: configurations and experiments, and how fast a line can go. Pure."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from gateway.commissioning.architectures import ARCHITECTURES
from gateway.commissioning.belief import believing
from gateway.commissioning.simulated_loop import QUIET, loop_of
from gateway.control.design import DesignRefused, DesignTask, margins, require_margin, task_of, task_on
from gateway.control.mpc_linear import unconstrained
from gateway.control.rollout import Course, plants_of_thetas, simulate
from gateway.core.controller import Controller
from gateway.core.controller_laws import MpcConfig
from gateway.core.experiment import Experiment, ExperimentRefused, course
from gateway.core.line import Line
from gateway.core.line_model import LineModel, noise_of, theta_of
from gateway.core.signals import FloatArray
from gateway.core.theta import nominal_theta
from gateway.core.web_model import equilibrium_torque, reference_speeds
from gateway.identification.experiment_design import design_experiment
from safety.limits import envelope_limits

HELD = 0.9  #: of the torque limit: more leaves no room to move
LEFT_OPEN = 0.05  #: of a value that was found: what data leave open, and what drifts
ENDS = 1e-6  #: relative: a knob that is turned no further
NEAR = 0.98  #: of the speed that is wanted, which is as good
GRID = 20  #: parts of the greatest speed that are looked at
#: Of what rollers may run ahead of the web in an experiment: the gate looks at more than the mean, under stress.
AHEAD_BY_MODEL, AHEAD_BY_FILE = 0.6, 0.5
SLOWER = 8  #: times that an experiment's ramps are made slower, until it keeps that
BELOW = 0.9  #: times the rate that the one before lets expect
LEVEL = 1.25  #: times the way from level to level: a dwell
LONGEST_DWELL_S = 60.0


class NotOffered(Exception):
    """There is no such candidate; the text says why."""


class Exhausted(NotOffered):
    """Nor is there any after it."""


@dataclass(frozen=True)
class Law:
    """An architecture, and factors on the values with which its design begins."""

    name: str
    factors: tuple[tuple[str, float], ...] = ()

    @property
    def text(self) -> str:
        return self.name.upper() + "".join(f", {name} times {factor:g}" for name, factor in self.factors)

    def turned(self, factors: Mapping[str, float]) -> "Law":
        """With `factors` on top."""
        own = dict(self.factors)
        return Law(self.name, tuple({**own, **{k: own.get(k, 1.0) * v for k, v in factors.items()}}.items()))


#: The most ambitious first.
FIRST_LAWS = (
    Law("lqi"),
    Law("lqi", (("torque_per_nm2", 4.0),)),
    Law("pid"),
    Law("lqg", (("torque_per_nm2", 4.0),)),
    Law("lqi", (("torque_per_nm2", 16.0), ("integral_per_n2s2", 0.1))),
)


def configuration(line: Line, model: LineModel | None, speed_m_per_s: float, law: Law) -> Controller:
    """On the line's file or on `model`, for speeds up to `speed_m_per_s`. Raises NotOffered."""
    task = _task(_no_faster(line, speed_m_per_s), model)
    try:
        config = designed(task, law)
        require_margin(margins(config, task))
    except DesignRefused as refused:
        raise NotOffered(f"{law.text}: {refused}") from refused
    return config


def designed(task: DesignTask, law: Law) -> Controller:
    """Raises DesignRefused."""
    return ARCHITECTURES[law.name].design(task, values_of(task, law))


def values_of(task: DesignTask, law: Law) -> dict[str, float]:
    """Of the knobs: what the architecture begins with, times the law's factors, within the knobs' ends."""
    architecture, factors = ARCHITECTURES[law.name], dict(law.factors)
    first = architecture.first(task)
    return {
        knob.name: min(max(first[knob.name] * factors.get(knob.name, 1.0), knob.least), knob.most)
        for knob in architecture.knobs
    }


def at_end(line: Line, model: LineModel | None, speed_m_per_s: float, law: Law) -> list[str]:
    """Knobs of `law` that end before its factors do; see `configuration`."""
    task, factors = _task(_no_faster(line, speed_m_per_s), model), dict(law.factors)
    first, values = ARCHITECTURES[law.name].first(task), values_of(task, law)
    return [
        f"{name} ends at {values[name]:g}, times {values[name] / first[name]:.3g}"
        for name, factor in factors.items()
        if abs(values[name] - first[name] * factor) > ENDS * values[name]
    ]


def experiment(
    line: Line,
    model: LineModel | None,
    in_service: Controller,
    tension_n: Sequence[float],
    speed_m_per_s: float,
    speeds_m_per_s: Sequence[float],
    size: float = 1.0,
    seed: int = 0,
) -> Experiment:
    """With legs at `speeds_m_per_s`, from set-points (n,) and a speed.

    Before there is a model with moves as a first configuration is judged for. `size`: times the amplitude that it is
    designed with. Raises NotOffered.
    """
    believed = line if model is None else believing(line, theta_of(model), LEFT_OPEN)
    step_n = line.limits.tension_step_max_n
    if model is None:
        step_n = min(step_n, line.gate.first_step_max_n)
    narrowed = believed.model_copy(update={"limits": line.limits.model_copy(update={"tension_step_max_n": step_n})})
    try:
        designed = design_experiment(
            narrowed, in_service, tension_n=tension_n, speed_m_per_s=speed_m_per_s, speeds_m_per_s=speeds_m_per_s,
            brief=True, seed=seed,
        )  # fmt: skip
    except ExperimentRefused as refused:
        raise NotOffered(str(refused)) from refused
    asked = _sized(designed.experiment, size, step_n)
    fastest = partial(_fastest_roller, line, model, in_service, np.array(tension_n), speed_m_per_s)
    return _slow_rollers(line, model, asked, fastest)


def fastest_m_per_s(line: Line, model: LineModel | None) -> float:
    """The highest speed that the drives hold with `HELD` of their torque, at the tensions of every recipe.

    On the line's file or on `model`, each with `LEFT_OPEN` of friction and radius to the bad side.
    """
    most = line.limits.speed_max_m_per_s
    task = _task(line, model)
    coulomb_nm = 0.0 if model is None else float(np.max(theta_of(model).coulomb_nm))
    web = replace(
        task.model,
        friction_nms_per_rad=task.model.friction_nms_per_rad * (1.0 + LEFT_OPEN),
        radius_m=task.model.radius_m * (1.0 - LEFT_OPEN),
    )
    for part in range(GRID, 0, -1):
        speed = most * part / GRID
        torques = [
            equilibrium_torque(web, tension, reference_speeds(web, tension, speed))
            for tension in (np.array(recipe.tension_n) for recipe in line.recipes)
        ]
        # Each by itself: Python's maximum passes over what is no number, where it does not come first.
        if all(np.abs(torque).max() + coulomb_nm <= HELD * line.limits.torque_nm for torque in torques):
            return speed
    return most / GRID


def _slow_rollers(
    line: Line, model: LineModel | None, asked: Experiment, fastest: Callable[[Experiment], float]
) -> Experiment:
    """Set-points go to their levels so slowly that rollers run no farther ahead of the web than the gate lets them.

    Ramps, where steps are too quick: smaller steps would tell less. `fastest`: the speed that a roller comes to, m/s.
    Raises NotOffered.
    """
    still = fastest(asked.model_copy(update={"amplitude_n": [0.0] * asked.n}))
    ahead = envelope_limits(line).roller_speed_watched_m_per_s - still
    ahead *= AHEAD_BY_FILE if model is None else AHEAD_BY_MODEL
    theta = nominal_theta(line) if model is None else theta_of(model)
    # All spans together, and the last roller has to follow them all: dv = sum of L / EA dT/dt.
    stretch_s = float(theta.web.length_m[np.array(asked.amplitude_n) > 0.0].sum()) / theta.web.stiffness_n
    rate = min(ahead / stretch_s, line.moves.tension_rate_n_per_s)
    for _ in range(SLOWER):
        found = fastest(asked) - still
        if found <= ahead:
            return asked
        if asked.rate_n_per_s is not None:
            rate *= BELOW * ahead / found
        if rate <= 0.0:
            break
        dwell_s = max(asked.dwell_s, LEVEL * 2.0 * max(asked.amplitude_n) / rate)
        asked = asked.model_copy(update={"rate_n_per_s": rate, "dwell_s": min(dwell_s, LONGEST_DWELL_S)})
    raise NotOffered(f"rollers run at {still:.3g} m/s by themselves: too fast for tensions to move, however slowly")


def _fastest_roller(
    line: Line,
    model: LineModel | None,
    in_service: Controller,
    tension_n: FloatArray,
    speed_m_per_s: float,
    asked: Experiment,
) -> float:
    """On the mean of what is believed, without noise."""
    period_s = line.control.period_s
    rows = list(course(asked, tension_n, speed_m_per_s, period_s))
    speeds, now, reach = np.empty(len(rows)), speed_m_per_s, line.moves.speed_rate_m_per_s2 * period_s
    for k, (_, goal) in enumerate(rows):
        now += min(max(goal - now, -reach), reach)
        speeds[k] = now
    theta = nominal_theta(line) if model is None else theta_of(model)
    law = unconstrained(in_service) if isinstance(in_service, MpcConfig) else in_service
    moves = Course(np.array([tension for tension, _ in rows]), speeds)
    return float(simulate(law, plants_of_thetas([theta]), moves, loop_of(line, QUIET)).roller_speed_max_m_per_s.max())


def _task(line: Line, model: LineModel | None) -> DesignTask:
    return task_of(line) if model is None else task_on(line, theta_of(model), noise_of(model))


def _no_faster(line: Line, speed_m_per_s: float) -> Line:
    most = min(line.limits.speed_max_m_per_s, speed_m_per_s)
    return line.model_copy(update={"limits": line.limits.model_copy(update={"speed_max_m_per_s": most})})


def _sized(designed: Experiment, size: float, step_n: float) -> Experiment:
    """Every amplitude times `size`, within the permitted step."""
    most_n = 0.5 * step_n if designed.rate_n_per_s is None else np.inf
    amplitude = [min(size * one, max(most_n, one)) for one in designed.amplitude_n]
    deviation_n = max(designed.abort.deviation_n, 2.0 * max(amplitude))
    abort = designed.abort.model_copy(update={"deviation_n": deviation_n})
    return designed.model_copy(update={"amplitude_n": amplitude, "abort": abort})
