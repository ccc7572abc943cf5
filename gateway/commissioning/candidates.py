"""What the commissioning chain proposes: configurations and experiments, and how fast a line can go. Pure."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from gateway.commissioning.architectures import ARCHITECTURES
from gateway.commissioning.belief import believing
from gateway.control.design import DesignRefused, DesignTask, margins, require_margin, task_of, task_on
from gateway.core.controller import Controller
from gateway.core.deployment import Region
from gateway.core.experiment import Experiment, ExperimentRefused
from gateway.core.line import Line
from gateway.core.line_model import LineModel, noise_of, theta_of
from gateway.core.web_model import equilibrium_torque, reference_speeds
from gateway.identification.experiment_design import design_experiment

HELD = 0.9  #: of the torque limit: more leaves no room to move
LEFT_OPEN = 0.05  #: of a value that was found: what data leave open, and what drifts
NEAR = 0.98  #: of the speed that is wanted, which is as good
GRID = 20  #: parts of the greatest speed that are looked at


class NotOffered(Exception):
    """There is no such candidate; the text says why."""


@dataclass(frozen=True)
class Law:
    """An architecture, and factors on the values with which its design begins."""

    name: str
    factors: tuple[tuple[str, float], ...] = ()

    @property
    def text(self) -> str:
        return self.name.upper() + "".join(f", {name} times {factor:g}" for name, factor in self.factors)


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
    architecture = ARCHITECTURES[law.name]
    values = architecture.first(task)
    for knob in architecture.knobs:
        factor = dict(law.factors).get(knob.name, 1.0)
        values[knob.name] = min(max(values[knob.name] * factor, knob.least), knob.most)
    return architecture.design(task, values)


def experiment(
    line: Line,
    model: LineModel | None,
    in_service: Controller,
    region: Region | None,
    tension_n: Sequence[float],
    speed_m_per_s: float,
    speeds_m_per_s: Sequence[float],
    size: float = 1.0,
    seed: int = 0,
) -> Experiment:
    """With legs at `speeds_m_per_s`, from set-points (n,) and a speed, with steps that `region` permits.

    `size`: times the amplitude that it is designed with. Raises NotOffered.
    """
    believed = line if model is None else believing(line, theta_of(model), LEFT_OPEN)
    step_n = line.limits.tension_step_max_n
    if region is not None and region.tension_step_max_n is not None:
        step_n = min(step_n, region.tension_step_max_n)
    narrowed = believed.model_copy(update={"limits": line.limits.model_copy(update={"tension_step_max_n": step_n})})
    try:
        designed = design_experiment(
            narrowed, in_service, tension_n=tension_n, speed_m_per_s=speed_m_per_s, speeds_m_per_s=speeds_m_per_s,
            brief=True, seed=seed,
        )  # fmt: skip
    except ExperimentRefused as refused:
        raise NotOffered(str(refused)) from refused
    return _sized(designed.experiment, size, step_n)


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
        if max(float(np.abs(torque).max()) for torque in torques) + coulomb_nm <= HELD * line.limits.torque_nm:
            return speed
    return most / GRID


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
