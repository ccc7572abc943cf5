"""What a judged configuration is put through, and what promises are of: steps, shaped moves, changes of speed.

Set-points go between two levels around those of the line, as far apart as the region permits in one step, with a
quarter of the step left to the limits of the set-points wherever there is room. Three courses have a name that a
promise may use:

    tension     all set-points at once: up, and down again
    moves       the same way, along minimum-jerk moves of `MOVE_S`
    velocity    the unwinder's speed, down by the largest step and up again, in one period each
"""

from dataclasses import dataclass

import numpy as np

from gateway.control.reference import MinimumJerk
from gateway.control.rollout_terms import Course, course_through
from gateway.core.line import Line
from gateway.core.signals import FloatArray

STAND_S = 0.3  #: before the first change
MOVE_S = 0.5  #: a shaped move
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
    """The named ones, each change standing for `lasting_s`; none of a step that the region does not permit."""
    low, high = judged.levels()
    period_s, fast = judged.line.control.period_s, judged.fast_m_per_s
    found: Courses = {}
    if judged.tension_step_n > 0.0:
        parts = [(STAND_S, low, fast), (lasting_s, high, fast), (lasting_s, low, fast)]
        found["tension"] = course_through(period_s, parts)
        found["moves"] = _moves(judged, low, high, lasting_s)
    if judged.speed_step_m_per_s > 0.0:
        now, before = judged.tension_n, judged.before_m_per_s
        found["velocity"] = course_through(
            period_s, [(STAND_S, now, fast), (lasting_s, now, before), (lasting_s, now, fast)]
        )
    return found or {"standing": course_through(period_s, [(lasting_s, judged.tension_n, fast)])}


def corner_courses(judged: Judged, lasting_s: float = 2.5, tail_s: float = 1.5) -> Courses:
    """Up and down slow and fast, neighbours against each other, speed down and up; each with a tail that stands."""
    low, high = judged.levels()
    odd = np.arange(len(low)) % 2 == 0
    one, other = np.where(odd, low, high), np.where(odd, high, low)
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
            "neighbours apart": of((one, fast), (other, fast)),
        }
    return found


def _moves(judged: Judged, low: FloatArray, high: FloatArray, lasting_s: float) -> Course:
    """Set-points along minimum-jerk moves, as a course; changes count from the begin of each."""
    period_s = judged.line.control.period_s
    way = MinimumJerk(np.array([0.0]))
    times = np.arange(0.0, MOVE_S, period_s)
    way.move(0, 1.0, 1e9, 0.0, MOVE_S)
    shape = np.array([float(way.at(t)[0, 0]) for t in times.tolist()])
    stand, rest = round(STAND_S / period_s), max(1, round(lasting_s / period_s) - len(shape))
    share = np.concatenate((np.zeros(stand), shape, np.ones(rest), 1.0 - shape, np.zeros(rest)))
    tension = low + share[:, None] * (high - low)
    speed = np.full(len(share), judged.fast_m_per_s)
    return Course(tension, speed, stand, (stand + len(shape) + rest,))
