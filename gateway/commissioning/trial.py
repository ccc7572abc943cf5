"""Trying a candidate in simulation, and the cost J that it has there.

    J = sum over scenarios of the mean over plants of  integral (y - y_ref)' Q (y - y_ref) + u' R u  dt

(eq. control_objective) with Q = 1 on tensions that are measured. The plants are the nominal model and some of the box
in which the line's file says that the truth may lie: on the nominal model alone a law without integral action looks as
good as any.
"""

from collections.abc import Sequence
from dataclasses import replace
from math import inf, isfinite

import numpy as np

from gateway.commissioning.ground import Ground
from gateway.commissioning.records import Trial
from gateway.control.design import is_stable, margins, weak_spots
from gateway.control.rollout import Course, Rollouts, plants_of, simulate
from gateway.core.controller import Controller
from gateway.core.metrics import RunMetrics, run_metrics
from gateway.core.signals import FloatArray

TORQUE_PER_NM2 = 1e-5  #: R of J, N2/Nm2: the torque that holds the line is the same for every law
RUNAWAY_N = 1e3  #: a tension beyond it says only that the loop has run away


def tried(config: Controller, ground: Ground) -> Trial:
    """What becomes of a candidate on a ground."""
    return trial_of(config, ground, run_on(config, ground))


def run_on(config: Controller, ground: Ground) -> list[Rollouts]:
    """Recorded runs of all plants, course by course."""
    return [simulate(config, ground.plants, course, ground.setup, record=True) for course in ground.courses]


def trial_of(config: Controller, ground: Ground, runs: Sequence[Rollouts]) -> Trial:
    """The figures of a candidate, given its runs on the ground."""
    spans, period_s = ground.task.tension_spans, ground.setup.period_s
    # What has run away may be anything, not a number included.
    held = all((np.abs(run.tension_n) < RUNAWAY_N).all() for run in runs)
    both = list(zip(runs, ground.courses, strict=True))
    alone = [_nominal(run, course, spans, period_s) for run, course in both]
    quiet = [
        _nominal(run, course, spans, period_s)
        for run, course in zip(_quiet(config, ground), ground.courses, strict=True)
    ]
    settling_s = max((_greatest(metrics.settling_s) for metrics in quiet), default=0.0)
    found = margins(config, ground.task)
    stable = found.spectral_radius < 1.0
    cost_n2s = sum(_cost(run, course, spans, period_s) for run, course in both) if held else inf
    return Trial(
        cost_n2s=cost_n2s if isfinite(cost_n2s) else None,
        rmse_n={s.name: _bounded(m.rmse_n) for s, m in zip(ground.scenarios, alone, strict=True)},
        settling_s=settling_s if isfinite(settling_s) else None,
        watched_s=max((period_s * (course.periods - course.changed) for course in ground.courses), default=0.0),
        # Of numpy: Python's own extremes pass over what is no number, where it does not come first.
        overshoot_pct=_bounded(float(np.max([_greatest(metrics.overshoot_pct) for metrics in quiet], initial=0.0))),
        tension_min_n=-_bounded(-float(np.min([_least(run.tension_min_n[:, spans]) for run in runs]))),
        tension_max_n=_bounded(float(np.max([_greatest(run.tension_max_n[:, spans]) for run in runs]))),
        effort_n2m2s=_bounded(float(np.mean([metrics.effort_n2m2s for metrics in alone])), 1e12),
        robustness_n=max(_greatest(np.abs(run.tension_n - run.tension_n[:1])[..., spans]) for run in runs)
        if held
        else None,
        weak=_weak(config, ground) if stable else [],
        delay_margin_s=found.delay_margin_s,
        decay_per_s=found.decay_per_s,
        chatter_nm=found.chatter_nm if stable else 0.0,
        noise_floor_n=found.noise_floor_n if stable else 0.0,
    )


def reasons_against(trial: Trial, ground: Ground) -> list[str]:
    """Why a candidate must not be offered: stability, delay, tension limits. Torque the loop limits itself.

    A figure that is no number speaks against it.
    """
    found: list[str] = []
    limits, least_s = ground.task.limits, ground.least_margin_s
    if not trial.decay_per_s > 0.0:
        return ["the loop is unstable"]
    if not trial.delay_margin_s >= least_s:
        found.append(f"it stands {1e3 * trial.delay_margin_s:.1f} ms more delay, less than {1e3 * least_s:g} ms")
    found += trial.weak
    if trial.cost_n2s is None or not isfinite(trial.cost_n2s):
        found.append("a line within the tolerances runs away")
    elif not (limits.tension_min_n <= trial.tension_min_n and trial.tension_max_n <= limits.tension_max_n):
        found.append(
            f"within the tolerances tension goes from {trial.tension_min_n:.1f} to {trial.tension_max_n:.1f} N, "
            f"the limits are {limits.tension_min_n:g} and {limits.tension_max_n:g} N"
        )
    return found


def diagnosis(trial: Trial, ground: Ground) -> str:
    """What holds a candidate back, in words: what somebody who tunes by hand would look at first."""
    if not trial.decay_per_s > 0.0:
        return "the loop is unstable"
    if trial.delay_margin_s < 2.0 * ground.least_margin_s:
        return f"it stands only {1e3 * trial.delay_margin_s:.1f} ms more delay"
    if trial.settling_s is None:
        return "a span never settles within 2 % of its set-point"
    share = sum(trial.noise_floor_n / rmse for rmse in trial.rmse_n.values() if rmse) / len(trial.rmse_n)
    if share > 0.5:
        return f"noise makes {share:.0%} of the error"
    if trial.robustness_n is not None and trial.robustness_n > 2.0 * max(trial.rmse_n.values()):
        return f"a model that is wrong within its tolerances moves a tension by up to {trial.robustness_n:.1f} N"
    if trial.overshoot_pct > 20.0:
        return f"overshoot is {trial.overshoot_pct:.0f} %"
    return f"the slowest span settles after {trial.settling_s:.2f} s"


def _weak(config: Controller, ground: Ground) -> list[str]:
    """Speeds of the nominal model at which the loop stands too little, and plants of the box that are not stable."""
    found = weak_spots(config, ground.task, ground.least_margin_s)
    unstable = sum(not is_stable(config, replace(ground.task, model=model)) for model in ground.models[1:])
    if unstable:
        found.append(f"{unstable} of {len(ground.models) - 1} lines within the tolerances are unstable")
    return found


def _quiet(config: Controller, ground: Ground) -> list[Rollouts]:
    """The nominal model without noise: when a span has settled is no matter of luck."""
    setup = replace(ground.setup, tension_noise_n=0.0, speed_noise_m_per_s=0.0, acceleration_m_per_s1_5=0.0)
    nominal = plants_of([ground.models[0]])
    return [simulate(config, nominal, course, setup, record=True) for course in ground.courses]


def _cost(run: Rollouts, course: Course, spans: list[int], period_s: float) -> float:
    squared_error: FloatArray = run.squared_error_n2[:, spans].sum(axis=1)  # (b,)
    effort: FloatArray = run.effort_n2m2s.sum(axis=1)
    return period_s * course.periods * float(np.mean(squared_error)) + TORQUE_PER_NM2 * float(np.mean(effort))


def _nominal(run: Rollouts, course: Course, spans: list[int], period_s: float) -> RunMetrics:
    time_s: FloatArray = np.arange(course.periods, dtype=np.float64) * period_s
    changed_s = (course.changed - 0.5) * period_s
    return run_metrics(time_s, run.tension_n[0][:, spans], course.tension_n[:, spans], run.torque_nm[0], changed_s)


def _least(values: FloatArray) -> float:
    return float(values.min(initial=inf))


def _greatest(values: FloatArray) -> float:
    """0 where there is none: a line without load cells has no tension to speak of."""
    return float(values.max(initial=0.0))


def _bounded(value: float, most: float = RUNAWAY_N) -> float:
    """What has run away as a number that can be written down; what is none is the greatest."""
    return float(np.clip(np.nan_to_num(value, nan=most, posinf=inf, neginf=-inf), -most, most))
