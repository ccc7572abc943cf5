"""Trying a candidate in simulation, and the cost J that it has there.

    J = sum over scenarios of the mean over plants of  integral (y - y_ref)' Q (y - y_ref) + u' R u  dt

(eq. control_objective) with Q = 1 on tensions. The plants are the nominal model and some of the box in which the line's
file says that the truth may lie: on the nominal model alone a law without integral action looks as good as any.
"""

from collections.abc import Sequence
from math import inf, isfinite

import numpy as np

from gateway.commissioning.ground import Ground
from gateway.commissioning.records import Trial
from gateway.control.design import margins
from gateway.control.design.margins import Margins
from gateway.control.rollout import Course, Rollouts, simulate
from gateway.core.controller import Controller
from gateway.core.metrics import RunMetrics, run_metrics
from gateway.core.signals import FloatArray

TORQUE_PER_NM2 = 1e-5  #: R of J, N2/Nm2: the torque that holds the line is the same for every law
RUNAWAY_N = 1e3  #: a tension beyond it says only that the loop has run away


def tried(config: Controller, ground: Ground) -> Trial:
    """What becomes of a candidate on a ground."""
    runs = [simulate(config, ground.plants, course, ground.setup, record=True) for course in ground.courses]
    return trial_of(ground, margins(config, ground.task), runs)


def trial_of(ground: Ground, found: Margins, runs: Sequence[Rollouts]) -> Trial:
    """The figures of recorded runs on the ground's courses."""
    # What has run away may be anything, not a number included.
    held = all((np.abs(run.tension_n) < RUNAWAY_N).all() for run in runs)
    both = list(zip(runs, ground.courses, strict=True))
    alone = [_nominal(run, course, ground.setup.period_s) for run, course in both]
    settling_s = max((float(metrics.settling_s.max()) for metrics in alone), default=0.0)
    stable = found.spectral_radius < 1.0
    return Trial(
        cost_n2s=sum(_cost(run, course, ground.setup.period_s) for run, course in both) if held else None,
        rmse_n={s.name: _bounded(m.rmse_n) for s, m in zip(ground.scenarios, alone, strict=True)},
        settling_s=settling_s if isfinite(settling_s) else None,
        overshoot_pct=_bounded(max(float(metrics.overshoot_pct.max()) for metrics in alone)),
        tension_min_n=_bounded(min(float(run.tension_min_n[0].min()) for run in runs)),
        tension_max_n=_bounded(max(float(run.tension_max_n[0].max()) for run in runs)),
        effort_n2m2s=float(np.mean([metrics.effort_n2m2s for metrics in alone])),
        robustness_n=max(float(np.abs(run.tension_n - run.tension_n[:1]).max()) for run in runs) if held else None,
        delay_margin_s=found.delay_margin_s,
        decay_per_s=found.decay_per_s,
        chatter_nm=found.chatter_nm if stable else 0.0,
        noise_floor_n=found.noise_floor_n if stable else 0.0,
    )


def reasons_against(trial: Trial, ground: Ground) -> list[str]:
    """Why a candidate must not be offered: stability, delay, tension limits. Torque the loop limits itself."""
    found: list[str] = []
    limits, least_s = ground.task.limits, ground.least_margin_s
    if not trial.decay_per_s > 0.0:
        return ["the loop is unstable"]
    if trial.delay_margin_s < least_s:
        found.append(f"it stands {1e3 * trial.delay_margin_s:.1f} ms more delay, less than {1e3 * least_s:g} ms")
    if trial.cost_n2s is None:
        found.append("a line within the tolerances runs away")
    if trial.tension_min_n < limits.tension_min_n or trial.tension_max_n > limits.tension_max_n:
        found.append(
            f"tension goes from {trial.tension_min_n:.1f} to {trial.tension_max_n:.1f} N, the limits are "
            f"{limits.tension_min_n:g} and {limits.tension_max_n:g} N"
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


def _cost(run: Rollouts, course: Course, period_s: float) -> float:
    squared_error: FloatArray = run.squared_error_n2.sum(axis=1)  # (b,)
    effort: FloatArray = run.effort_n2m2s.sum(axis=1)
    return period_s * course.periods * float(np.mean(squared_error)) + TORQUE_PER_NM2 * float(np.mean(effort))


def _nominal(run: Rollouts, course: Course, period_s: float) -> RunMetrics:
    time_s: FloatArray = np.arange(course.periods, dtype=np.float64) * period_s
    changed_s = (course.changed - 0.5) * period_s
    return run_metrics(time_s, run.tension_n[0], course.tension_n, run.torque_nm[0], changed_s)


def _bounded(value: float) -> float:
    """What has run away as a number that can be written down."""
    return float(np.clip(np.nan_to_num(value, nan=RUNAWAY_N, posinf=inf, neginf=-inf), -RUNAWAY_N, RUNAWAY_N))
