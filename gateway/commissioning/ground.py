"""What candidates are tried on: scenarios, the nominal model, and plants of the box in which the truth may lie."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from math import ceil

import numpy as np

from gateway.commissioning.belief import Draw, within_intervals, within_tolerances
from gateway.control.design import DesignRefused, DesignTask, task_of, task_on
from gateway.control.design.margins import LEAST_DELAY_MARGIN_S
from gateway.control.design.task import linear
from gateway.control.rollout import Course, Plants, Setup, plants_of
from gateway.core.line import Line
from gateway.core.line_model import LineModel, noise_of, theta_of
from gateway.core.line_scales import runaway_n
from gateway.core.scenario import Scenario
from gateway.core.signals import FloatArray
from gateway.core.web_model import WebModel, equilibrium_torque, reference_speeds

MOST_DRAWS = 200  #: per plant of the box, until one is found that can be held
FASTEST_MODE = 0.5  #: of an integration step, as |eigenvalue| times its length
MOST_SUBSTEPS = 50
ROUNDED = 0.025  #: of a period, by which a latency may be rounded that is no whole number of steps


@dataclass(frozen=True)
class Ground:
    task: DesignTask
    scenarios: tuple[Scenario, ...]
    models: tuple[WebModel, ...]  #: the nominal one first
    setup: Setup
    speeds_m_per_s: tuple[float, ...] = ()  #: over which gains follow the speed; none: one set for all
    least_margin_s: float = LEAST_DELAY_MARGIN_S

    @cached_property
    def plants(self) -> Plants:
        return plants_of(list(self.models))

    @cached_property
    def courses(self) -> tuple[Course, ...]:
        return tuple(course_of(scenario, self.task.period_s) for scenario in self.scenarios)

    def shortened(self, plants: int, lead_s: float, duration_s: float) -> "Ground":
        """The same with so many plants, `lead_s` before each change, `duration_s` in all beside its move, at most."""

        def shorter(scenario: Scenario) -> Scenario:
            lead = min(lead_s, scenario.change_at_s)
            end = min(duration_s + scenario.move_s, scenario.duration_s)
            return scenario.model_copy(update={"change_at_s": lead, "duration_s": end})

        return replace(self, scenarios=tuple(map(shorter, self.scenarios)), models=self.models[:plants])


def ground_of(
    line: Line,
    scenarios: Sequence[Scenario],
    plants: int,
    seed: int,
    speeds_m_per_s: Sequence[float] = (),
    model: LineModel | None = None,
) -> Ground:
    """The ground of a line: its nominal model, and `plants` more within its tolerances.

    With `model` that one and its intervals stand in their place. Raises DesignRefused where a scenario does not fit the
    line, or hardly any plant of the box can be held.
    """
    reasons = [reason for scenario in scenarios for reason in scenario.reasons_against(line.n, line.limits)]
    task = task_of(line) if model is None else task_on(line, theta_of(model), noise_of(model))
    reasons += [
        f"{scenario.name} changes after {scenario.change_at_s:g} s; allowed: {task.period_s:g} s, a period, or more"
        for scenario in scenarios
        if round(scenario.change_at_s / task.period_s) < 1
    ]
    if reasons:
        raise DesignRefused("; ".join(reasons))
    latency_s, substeps = _stepping(task)
    setup = Setup(
        task.period_s, latency_s, substeps, torque_nm=line.limits.torque_nm,
        torque_rate_nm_per_s=line.limits.torque_rate_nm_per_s, tension_noise_n=task.noise.tension_n,
        speed_noise_m_per_s=task.noise.speed_m_per_s, acceleration_m_per_s1_5=task.noise.acceleration_m_per_s1_5,
        runaway_n=runaway_n(line), seed=seed,
    )  # fmt: skip
    draw = within_tolerances(line) if model is None else within_intervals(line, model)
    models = (task.model, *box_models(line, scenarios, plants, seed, draw))
    return Ground(task, tuple(scenarios), models, setup, tuple(speeds_m_per_s))


def box_models(
    line: Line, scenarios: Sequence[Scenario], count: int, seed: int, draw: Draw | None = None
) -> list[WebModel]:
    """Models drawn from the tolerances, or by `draw`, every roller and span by itself.

    Those that the drives could not hold at an end of the scenarios are left out: there nobody could. Raises
    DesignRefused where too few remain.
    """
    generator = np.random.default_rng(seed)
    draw = draw or within_tolerances(line)
    found: list[WebModel] = []
    for _ in range(MOST_DRAWS * count):
        if len(found) == count:
            break
        model = draw(generator)
        if all(_can_be_held(model, scenario, line.limits.torque_nm) for scenario in scenarios):
            found.append(model)
    if len(found) < count:
        raise DesignRefused(
            f"of {MOST_DRAWS * count} lines within the tolerances only {len(found)} can be held by "
            f"{line.limits.torque_nm:g} Nm: narrower tolerances, a lower speed, or a greater torque limit"
        )
    return found


def course_of(scenario: Scenario, period_s: float) -> Course:
    """What the scenario asks for, period by period."""
    at = round(scenario.change_at_s / period_s)
    # Counted from the change, so that no rounding of a time puts it a period off.
    since = np.arange(-at, round(scenario.duration_s / period_s) - at, dtype=np.float64)
    time: FloatArray = scenario.change_at_s + since * period_s
    return Course(scenario.setpoints_n(time), scenario.speeds_m_per_s(time), at)


def _can_be_held(model: WebModel, scenario: Scenario, torque_nm: float) -> bool:
    ends = ((scenario.tension_n, scenario.speed_m_per_s), (scenario.tension_end_n, scenario.speed_end_m_per_s))
    for tension_n, speed_m_per_s in ends:
        tension = np.array(tension_n)
        speeds = reference_speeds(model, tension, speed_m_per_s)
        if not np.abs(equilibrium_torque(model, tension, speeds)).max() < torque_nm:  # what is no number holds nothing
            return False
    return True


def _stepping(task: DesignTask) -> tuple[float, int]:
    """Latency in s and integration steps a period, of which the latency is a whole number; where none fits, the
    nearest latency that does. Raises DesignRefused where the model is too fast for any."""
    A, _ = linear(task)
    fastest = float(np.abs(np.linalg.eigvals(A)).max())
    least = max(1, ceil(task.period_s * fastest / FASTEST_MODE))
    if least > MOST_SUBSTEPS:
        raise DesignRefused(
            f"the line has a mode of {1e3 / fastest:.2g} ms, too fast for a control period of "
            f"{1e3 * task.period_s:g} ms: check stiffness, lengths and inertias, or control faster"
        )
    steps = range(least, MOST_SUBSTEPS + 1)
    for substeps in steps:
        if abs(_whole_steps_s(task, substeps) - task.latency_s) < 1e-9:
            return task.latency_s, substeps
    allowed_s = ROUNDED * task.period_s
    substeps = next(one for one in steps if abs(_whole_steps_s(task, one) - task.latency_s) <= allowed_s)
    return _whole_steps_s(task, substeps), substeps


def _whole_steps_s(task: DesignTask, substeps: int) -> float:
    """The latency as the nearest whole number of steps."""
    step_s = task.period_s / substeps
    return round(task.latency_s / step_s) * step_s
