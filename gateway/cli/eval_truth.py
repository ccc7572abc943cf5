"""What a configuration is worth on the true plant of a task, and what the rules would design if they knew the truth."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from gateway.cli.eval_tasks import TOP_M_PER_S, Task
from gateway.cli.rehearse_designs import truth_of
from gateway.cli.stepped import CommandRefused, run_scenario
from gateway.commissioning.redesign import redesigns
from gateway.control.design import design_lqi, task_on
from gateway.core.controller import Controller
from gateway.core.deployment import Region
from gateway.core.line import Line
from gateway.core.line_model import LineModel, model_of, noise_of, parameters_of, theta_of
from gateway.core.theta import Theta
from sim_plant.physics import STEP_S
from sim_plant.plant import Plant

NOISES = (1, 2)  #: in which each case is run: seeds, the same for whatever is measured


@dataclass(frozen=True)
class Worth:
    """By case: RMSE over all spans, mean over the seeds. A case that the line was stopped in has none."""

    rmse_n: dict[str, float]
    stopped: list[str]  #: cases, with the reason
    unsafe_events: int


def worth(task: Task, config: Controller, noises: Sequence[int] = NOISES) -> Worth:
    """Of `config` on the plant of `task`, in each of `noises`."""
    found: dict[str, float] = {}
    stopped: list[str] = []
    unsafe = 0
    for case in task.cases:
        line, plant, scenario = (
            case.tier.line(task.line, case.scenario),
            case.tier.plant(task.plant),
            case.tier.scenario,
        )
        errors: list[float] = []
        for seed in noises:
            try:
                run = run_scenario(line, config, plant, scenario(case.scenario), task.seed + seed)
            except CommandRefused as refused:
                stopped.append(f"{case.name}: {refused}")
                continue
            unsafe += run.unsafe_events
            if run.stopped is None:
                errors.append(run.rmse_n)
            else:
                stopped.append(f"{case.name}: {run.stopped}")
        if len(errors) == len(noises):
            found[case.name] = float(np.mean(errors))
    return Worth(found, stopped, unsafe)


def designed_on_truth(task: Task) -> tuple[str, Controller]:
    """The redesign that the rules would propose first, were the truth the accepted model; and its law in words."""
    line, model = task.line, true_model(task.plant, task.line)
    region = Region(speed_max_m_per_s=TOP_M_PER_S, tension_step_max_n=line.gate.first_step_max_n)
    tension_n = line.recipes[0].tension_n
    found = redesigns(line, model, task.begin, tension_n, region, TOP_M_PER_S)
    if found:
        return found[0].law.text, found[0].controller
    return "LQI", design_lqi(task_on(line, theta_of(model), noise_of(model)))


def true_model(plant: Plant, line: Line) -> LineModel:
    """The truth, as far as a model has a term for it, with nothing left open."""
    effects, n = plant.effects, plant.spans
    coulomb = np.resize(effects.friction.coulomb_nm, n).astype(float)
    share = np.resize(effects.eccentricity.share, n).astype(float)
    theta = Theta(truth_of(plant), coulomb, plant.drives.torque_lag_s, line.control.latency_s, share)
    disturbance = float(np.max(plant.rollers.disturbance_m_per_s2)) * np.sqrt(STEP_S)  # held for a step
    cells = plant.sensors
    none = [None] * n
    return model_of(
        {
            "format": 1,
            "site": line.site,
            "line": line.line,
            "created": "2026-01-05T06:00:00+00:00",
            "program_version": "truth",
            "method": "the truth",
            "structure": {
                "per_roller": True, "coulomb": bool(coulomb.any()), "torque_lag": plant.drives.torque_lag_s > 0.0
            },
            "parameters": parameters_of(theta),
            "noise": {
                "tension_n": cells.tension_noise_n,
                "speed_m_per_s": cells.speed_noise_m_per_s,
                "acceleration_m_per_s1_5": disturbance,
            },
            "intervals": {},
            "data": {
                "digest": "0" * 64, "source": "the plant itself", "samples": 1, "period_s": line.control.period_s
            },
            "region": {
                "speed_from_m_per_s": 0.0, "speed_to_m_per_s": TOP_M_PER_S, "tension_from_n": none,
                "tension_to_n": none,
            },
        }
    )  # fmt: skip
