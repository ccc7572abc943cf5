"""What an experiment does to tensions and torques before it is run: rollouts on corners of the line's tolerances.

Where the controller in service does not hold a corner, or would not with two milliseconds more delay, the last point on
the way to it that is held takes its place: the line runs, so the truth is not beyond. Should it be there after all, the
experiment ends itself.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import product
from math import ceil, inf

import numpy as np

from gateway.control.design.margins import is_stable
from gateway.control.design.task import linear, task_of
from gateway.control.mpc_linear import unconstrained
from gateway.control.rollout import Course, Setup, plants_of, simulate
from gateway.core.controller import Controller
from gateway.core.controller_laws import MpcConfig
from gateway.core.experiment import Experiment, ExperimentRefused, setpoints, speed_goals
from gateway.core.experiment_torques import Turns, at_limit, lasting_periods
from gateway.core.line import Line
from gateway.core.signals import FloatArray
from gateway.core.web_model import WebModel, equilibrium_torque, reference_speeds
from gateway.identification.regressions import MOVING, MOVING_SHARE
from gateway.identification.regressions import WINDOW_S as MOVED_S

HELD = 0.9  #: of the torque limit, for a line within the tolerances that goes at a speed
STANDS_S = 5.0  #: for which a corner must be held before anything moves
SHARES = (1.0, 0.9, 0.8, 0.7, 0.6, 0.5, 0.4, 0.3, 0.2, 0.1)  #: of the way to a corner
STANDS_DELAY_S = 0.002  #: more than the line's
AFTER_S = 1.0  #: that are watched after the end
FASTEST_MODE = 0.5  #: of an integration step, as |eigenvalue| times its length
WINDOW_S = 1.0  #: over which shares of periods are taken
CLEARLY = 1.1  #: times what the assessment of data wants: noise of tensions that move is told a little too high


@dataclass(frozen=True)
class Foreseen:
    """On all corners that were simulated, with noise."""

    deviation_n: float  #: greatest, of a tension from its set-point before the experiment
    tension_min_n: float
    tension_max_n: float
    saturated_share: float  #: of the periods of the worst second: a torque is at a limit
    reversal_share: float  #: a torque turns round
    change_n: float  #: what the tension that moves least changes by in `MOVED_S`, as the assessment of data takes it
    nominal_change_n: float  #: the same on the nominal line

    def text(self) -> str:
        return f"tensions from {self.tension_min_n:.1f} to {self.tension_max_n:.1f} N"


class Foresight:
    """A line under `config` that stands at tensions (n,) in N and a speed, and what its tolerances leave possible.

    Raises ExperimentRefused where the controller cannot even hold the nominal line.
    """

    def __init__(self, line: Line, config: Controller, base_n: FloatArray, speed_m_per_s: float) -> None:
        self.line, self.config = line, _without_limits(config)
        self.base_n, self.speed = base_n, speed_m_per_s
        self.task = task_of(line)
        self.setup = _setup(line)
        limits = line.limits
        self.low_n = limits.tension_min_n + limits.tension_margin_n  #: where tensions and set-points may go
        self.high_n = limits.tension_max_n - limits.tension_margin_n
        # Half of what a torque may move in 10 ms or a period, and from a twentieth to a tenth of its limit.
        lasting_s = lasting_periods(self.setup.period_s) * self.setup.period_s
        swing_nm = max(0.5 * limits.torque_rate_nm_per_s * lasting_s, 0.05 * limits.torque_nm)
        self.reversal_nm = min(swing_nm, 0.1 * limits.torque_nm)
        signs = [(0.0,) * 5, *product((-1.0, 1.0), repeat=5)]
        reached = [self._reached(one) for one in signs]
        if reached[0] is None:
            raise ExperimentRefused(
                f"the controller in service does not hold the nominal line at {speed_m_per_s:g} m/s within "
                f"{self.low_n:g} to {self.high_n:g} N when nothing moves, or would not with "
                f"{1e3 * STANDS_DELAY_S:g} ms more delay: design another first"
            )
        self.drawn_in = sum(
            any(one) and (point is None or point != one) for one, point in zip(signs, reached, strict=True)
        )
        held = [(one, point) for one, point in zip(signs, reached, strict=True) if point is not None]
        self.models = [self._corner(point) for _, point in held]  #: the nominal one first
        #: Nominal, and corners of a 2^(5-2) design, which moves each tolerance both ways: for what takes longer.
        self.some_models = [self._corner(point) for one, point in held if _is_some(one)]

    def needs_nm(self, speed_m_per_s: float) -> float:
        """The greatest torque that a line within the tolerances takes at a speed."""
        speeds = [reference_speeds(model, self.base_n, speed_m_per_s) for model in self.models]
        torques = [
            equilibrium_torque(model, self.base_n, speed) for model, speed in zip(self.models, speeds, strict=True)
        ]
        return float(np.abs(torques).max())

    @property
    def needs_change_n(self) -> float:
        """What `Foreseen.change_n` must be: with less, data are refused, since nothing moves but by noise."""
        by_noise_n = float(np.sqrt(2.0)) * self.setup.tension_noise_n
        return float(np.sqrt((CLEARLY * MOVING) ** 2 - 1.0)) * by_noise_n

    def can_go(self, speed_m_per_s: float) -> bool:
        return self.needs_nm(speed_m_per_s) <= HELD * self.line.limits.torque_nm

    def of(self, experiment: Experiment) -> Foreseen:
        """What it does at worst."""
        run = simulate(self.config, plants_of(self.models), self._course(experiment), self.setup, record=True)
        spans, limits = self.task.tension_spans, self.line.limits
        tension = np.nan_to_num(run.tension_n[:, :, spans], nan=inf)
        torque, period_s = run.torque_nm, self.setup.period_s
        lasting = lasting_periods(period_s)
        reach_nm = lasting * limits.torque_rate_nm_per_s * period_s
        cut = at_limit(torque[:, lasting:], torque[:, :-lasting], limits.torque_nm, reach_nm)
        turns, turned = Turns(torque[:, 0], self.reversal_nm), np.zeros(torque.shape[:2])
        for k in range(1, torque.shape[1]):
            turned[:, k] = turns.after(torque[:, k]).any(axis=1)
        window = round(WINDOW_S / period_s)
        change = _changes(tension[:, 1 : 1 + experiment.periods(period_s)], max(1, round(MOVED_S / period_s)))
        return Foreseen(
            float(np.abs(tension - self.base_n[spans]).max()),
            float(tension.min()),
            float(tension.max()),
            _worst_share(np.asarray(cut.any(axis=2), dtype=np.float64), window),
            _worst_share(turned, window),
            float(change.min()),
            float(change[0].min()),
        )

    def _course(self, experiment: Experiment) -> Course:
        """With the speed as the line's ramp makes it, and a while after the end."""
        period_s = self.setup.period_s
        after = round(AFTER_S / period_s)
        moved = setpoints(experiment, self.base_n, period_s)
        goals = np.concatenate((speed_goals(experiment, self.speed, period_s), np.full(after, self.speed)))
        reach, speed, speeds = self.line.moves.speed_rate_m_per_s2 * period_s, self.speed, [self.speed]
        for goal in goals.tolist():
            speed += max(-reach, min(reach, goal - speed))
            speeds.append(speed)
        return Course(np.vstack((self.base_n, moved, np.tile(self.base_n, (after, 1)))), np.array(speeds))

    def _reached(self, signs: Sequence[float]) -> tuple[float, ...] | None:
        """The point on the way from the nominal line to a corner up to which the line is held; None: nowhere."""
        ways = [tuple(share * sign for sign in signs) for share in SHARES] if any(signs) else [tuple(signs)]
        waiting = [way for way in ways if self._waits(self._corner(way))]
        stand = self._stand([self._corner(way) for way in waiting]) if waiting else []
        return next((way for way, stands in zip(waiting, stand, strict=True) if stands), None)

    def _stand(self, models: Sequence[WebModel]) -> list[bool]:
        periods = round(STANDS_S / self.setup.period_s)
        course = Course(np.tile(self.base_n, (periods, 1)), np.full(periods, self.speed))
        run = simulate(self.config, plants_of(list(models)), course, self.setup)
        spans = self.task.tension_spans
        low, high = run.tension_min_n[:, spans], run.tension_max_n[:, spans]
        return [bool((a >= self.low_n).all() and (b <= self.high_n).all()) for a, b in zip(low, high, strict=True)]

    def _waits(self, model: WebModel) -> bool:
        task = replace(self.task, model=model, tension_n=self.base_n, unwind_speed_m_per_s=self.speed)
        return is_stable(self.config, task, STANDS_DELAY_S)

    def _corner(self, signs: Sequence[float]) -> WebModel:
        line, model = self.line, self.task.model

        def factor(sign: float, tolerances: list[float]) -> FloatArray:
            return 1.0 + sign * np.array(tolerances)

        return WebModel(
            model.stiffness_n * (1.0 + signs[0] * line.web.stiffness_n.tolerance),
            model.length_m * factor(signs[1], [span.length_m.tolerance for span in line.spans]),
            model.radius_m * factor(signs[2], [roller.radius_m.tolerance for roller in line.rollers]),
            model.inertia_kg_m2 * factor(signs[3], [roller.inertia_kg_m2.tolerance for roller in line.rollers]),
            model.friction_nms_per_rad
            * factor(signs[4], [roller.friction_nms_per_rad.tolerance for roller in line.rollers]),
            model.tension_before_n,
            model.tension_after_n,
        )


def _without_limits(config: Controller) -> Controller:
    """Of MPC its feedback where no limit is reached: its rollouts would take minutes. The loop's limits stay."""
    return unconstrained(config) if isinstance(config, MpcConfig) else config


def _is_some(signs: Sequence[float]) -> bool:
    """Of a 2^(5-2) design, or the nominal line."""
    a, b, c, d, e = signs
    return d == a * b and e == a * c


def _setup(line: Line) -> Setup:
    """Integration steps a period: small enough for the line's modes, and the latency is a whole number of them."""
    task = task_of(line)
    A, _ = linear(task)
    fastest = float(np.abs(np.linalg.eigvals(A)).max())
    least = max(1, ceil(task.period_s * fastest / FASTEST_MODE))
    fitting = (m for m in range(least, least + 50) if _is_whole(task.latency_s * m / task.period_s))
    substeps = next(fitting, least + 50)
    step_s = task.period_s / substeps
    return Setup(
        task.period_s, ceil(task.latency_s / step_s - 1e-6) * step_s, substeps, line.limits.torque_nm,
        line.limits.torque_rate_nm_per_s, task.noise.tension_n, task.noise.speed_m_per_s,
        task.noise.acceleration_m_per_s1_5,
    )  # fmt: skip


def _is_whole(number: float) -> bool:
    return abs(number - round(number)) < 1e-6


def _changes(tension_n: FloatArray, window: int) -> FloatArray:
    """Of (b, k, n): root mean square over a window, of the fifth of the windows with most (b, n)."""
    change = np.abs(tension_n[:, window:] - tension_n[:, :-window])
    most = max(1, round(MOVING_SHARE * change.shape[1]))
    found: FloatArray = np.sqrt(np.mean(np.partition(change, -most, axis=1)[:, -most:] ** 2, axis=1))
    return found


def _worst_share(had: FloatArray, window: int) -> float:
    """Of the periods of any window, (b, k)."""
    counts = np.concatenate((np.zeros((len(had), 1)), np.cumsum(had, axis=1)), axis=1)
    window = min(window, counts.shape[1] - 1)
    return float((counts[:, window:] - counts[:, :-window]).max() / window)
