"""What a judged configuration is put through, and what promises are of: steps, shaped moves, changes of speed.

Set-points go between two levels around those of the line, as far apart as the region permits in one step, with a
quarter of the step left to the limits of the set-points wherever there is room. Three courses have a name that a
promise may use:

    tension     all set-points at once: up, and down again
    velocity    the unwinder's speed, down by the largest step and up again, in one period each
    moves       a quarter of that, along a minimum-jerk move (`way_of_moves`), without noise
"""

from dataclasses import dataclass

import numpy as np

from gateway.control.reference import MinimumJerk
from gateway.control.rollout_terms import Course, course_through
from gateway.control.shaped_run import Way
from gateway.core.line import Line
from gateway.core.signals import FloatArray

STAND_S = 0.3  #: before the first change
MOVE_S = 0.5  #: a shaped move, or longer where the line's rate asks for it
MOVED = 0.25  #: of the largest step: more in so short a time is a matter of the torque limit
LEAST_SPEED_M_PER_S = 0.005  #: the slowest that is looked at, where the line is to run faster
SLOW = 0.1  #: the slow speed, of the fast one
ROOM = 0.25  #: of a step, to the set-points' limits

Courses = dict[str, Course]


@dataclass(frozen=True)
class Judged:
    """What a configuration is to be judged for."""

    line: Line
    tension_n: FloatArray  #: (n,), set-points of the line
    speed_max_m_per_s: float
    tension_step_n: float
    speed_step_m_per_s: float

    @property
    def fast_m_per_s(self) -> float:
        return self.speed_max_m_per_s

    @property
    def slow_m_per_s(self) -> float:
        """The lower speed of steps."""
        return min(max(SLOW * self.speed_max_m_per_s, LEAST_SPEED_M_PER_S), self.speed_max_m_per_s)

    @property
    def before_m_per_s(self) -> float:
        """The lower speed of speed changes."""
        return max(self.speed_max_m_per_s - self.speed_step_m_per_s, self.slow_m_per_s)

    def levels(self) -> tuple[FloatArray, FloatArray]:
        """The two levels (n,) of set-points. A draw-controlled span keeps its own."""
        limits = self.line.limits
        least, most = limits.tension_min_n + limits.tension_margin_n, limits.tension_max_n - limits.tension_margin_n
        step = min(self.tension_step_n, most - least)
        room = min(ROOM * step, 0.5 * (most - least - step))
        center = np.clip(self.tension_n, least + room + 0.5 * step, most - room - 0.5 * step)
        half = np.array([0.5 * step if span.control == "tension" else 0.0 for span in self.line.spans])
        own = np.where(half > 0.0, center, self.tension_n)
        return own - half, own + half


def improvement_courses(judged: Judged, lasting_s: float = 2.5) -> Courses:
    """The named ones but moves, each change standing for `lasting_s`; of steps that the region permits."""
    low, high = judged.levels()
    period_s, fast = judged.line.control.period_s, judged.fast_m_per_s
    found: Courses = {}
    if judged.tension_step_n > 0.0:
        parts = [(STAND_S, low, fast), (lasting_s, high, fast), (lasting_s, low, fast)]
        found["tension"] = course_through(period_s, parts)
    if judged.speed_step_m_per_s > 0.0:
        now, before = judged.tension_n, judged.before_m_per_s
        found["velocity"] = course_through(
            period_s, [(STAND_S, now, fast), (lasting_s, now, before), (lasting_s, now, fast)]
        )
    return found or {"standing": course_through(period_s, [(lasting_s, judged.tension_n, fast)])}


def corner_courses(judged: Judged, lasting_s: float = 2.5, tail_s: float = 1.5) -> Courses:
    """Up and down slow and fast, every second span alone, speed down and up; each with a tail that stands."""
    low, high = judged.levels()
    second = np.arange(len(low)) % 2 == 0
    center = 0.5 * (low + high)
    one, other = np.where(second, low, center), np.where(second, high, center)
    period_s, fast, slow = judged.line.control.period_s, judged.fast_m_per_s, judged.slow_m_per_s
    now, before = judged.tension_n, judged.before_m_per_s
    step = judged.tension_step_n > 0.0

    def of(first: tuple[FloatArray, float], second: tuple[FloatArray, float]) -> Course:
        return course_through(period_s, [(STAND_S, *first), (lasting_s, *second), (lasting_s, *first)], tail_s)

    found: Courses = {"speed change": of((now, fast), (now, before))}
    if step:
        found |= {
            "steps, fast": of((low, fast), (high, fast)),
            "steps, slow": of((low, slow), (high, slow)),
            "every second span": of((one, fast), (other, fast)),
        }
    return found


def way_of_moves(judged: Judged, rest_s: float = 1.0) -> Way | None:
    """The shaped move; None where no set-point may move at once."""
    low, high = judged.levels()
    middle, half = 0.5 * (low + high), 0.5 * MOVED * (high - low)
    time_s = max(MOVE_S, MinimumJerk.PEAK * MOVED * judged.tension_step_n / judged.line.moves.tension_rate_n_per_s)
    way = Way(middle - half, middle + half, judged.fast_m_per_s, STAND_S, time_s, rest_s)
    return way if judged.tension_step_n > 0.0 else None
