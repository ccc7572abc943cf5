"""What a judged configuration is put through, and what promises are of: steps, shaped moves, changes of speed.

Set-points go between two levels around those of the line, as far apart as the region permits in one step, with a
third of the step left to the limits of the set-points wherever there is room. Steps of several spans at once come to
no more together than the loop lets them (`limits.steps_together`): a roller's speed has to follow the sum of what is
asked of the spans before it. Three courses have a name that a promise may use:

    tension     all set-points at once: up, and down again
    velocity    the unwinder's speed, down by the largest step and up again, in one period each
    moves       a quarter of that, along a minimum-jerk move (`way_of_moves`), without noise
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TypeVar

import numpy as np

from gateway.control.reference import MinimumJerk
from gateway.control.rollout_terms import Course, course_through
from gateway.control.shaped_run import Way
from gateway.core.deployment import Region
from gateway.core.line import Line
from gateway.core.line_limits import setpoint_bands_n
from gateway.core.line_scales import line_scales
from gateway.core.signals import FloatArray

# Times in moments of the line, speeds in small ones (`line_scales`).
STAND = 15.0  #: before the first change
MOVE = 25.0  #: a shaped move, or longer where the line's rate asks for it
MOVED = 0.25  #: of the largest step: more in so short a time is a matter of the torque limit
LEAST_SPEED = 2.5  #: the slowest that is looked at, where the line is to run faster
NEAR = 0.5  #: above a speed that was measured: it is not the round number that was asked for
SLOW = 0.1  #: the slow speed, of the fast one
BETWEEN = 100.0  #: that a course stands between its changes, at most
LONGER = 50.0  #: that steps stand before their tail: what still settles there is no oscillation
LASTING, TAIL, REST = 125.0, 75.0, 50.0  #: a change, the tail behind it, and the rest after a shaped move
TURN = 12.5  #: from one step to that of the next span
ROOM = 1.0 / 3.0  #: of a step, to the set-points' limits
OTHERS_LOW = "some step, the others low"
MOST_ALONE = 3  #: spans that step alone, at a speed
SLOW_ALONE, FAST_ALONE = "alone, slow", "alone, fast"  #: in the names of the courses in which they do
T = TypeVar("T")

Courses = dict[str, Course]


@dataclass(frozen=True)
class Judged:
    """What a configuration is to be judged for."""

    line: Line
    tension_n: FloatArray  #: (n,), set-points of the line
    speed_max_m_per_s: float
    tension_step_n: float
    speed_step_m_per_s: float

    def lasting_s(self, moments: float) -> float:
        """Seconds that so many moments of the line last."""
        return moments * line_scales(self.line).moment_s

    def within(self, region: Region) -> "Judged":
        """No further than `region`; itself where that is no narrower. Speeds are measured: a millimetre is none."""
        speed = region.speed_max_m_per_s
        mine = Region(
            speed_max_m_per_s=speed
            if speed is not None and self.speed_max_m_per_s <= speed + near_m_per_s(self.line)
            else self.speed_max_m_per_s,
            tension_step_max_n=self.tension_step_n,
            speed_step_max_m_per_s=self.speed_step_m_per_s,
        )
        if mine.within(region):
            return self
        return replace(
            self,
            speed_max_m_per_s=_least(self.speed_max_m_per_s, region.speed_max_m_per_s),
            tension_step_n=_least(self.tension_step_n, region.tension_step_max_n),
            speed_step_m_per_s=_least(self.speed_step_m_per_s, region.speed_step_max_m_per_s),
        )

    @property
    def fast_m_per_s(self) -> float:
        return self.speed_max_m_per_s

    @property
    def slow_m_per_s(self) -> float:
        """The lower speed of steps."""
        return min(
            max(SLOW * self.speed_max_m_per_s, LEAST_SPEED * line_scales(self.line).speed_m_per_s),
            self.speed_max_m_per_s,
        )

    @property
    def before_m_per_s(self) -> float:
        """The lower speed of speed changes."""
        return max(self.speed_max_m_per_s - self.speed_step_m_per_s, self.slow_m_per_s)

    @property
    def at_once(self) -> int:
        """Spans that may make the largest step at the same time."""
        return int(self.line.limits.steps_together + 1e-9)

    def together(self) -> tuple[FloatArray, FloatArray]:
        """The two levels (n,) where all spans step at once, each by as much."""
        low, high = self.levels()
        moving = np.count_nonzero(high > low)
        center, half = 0.5 * (low + high), 0.5 * (high - low)
        share = min(1.0, self.line.limits.steps_together / max(moving, 1))
        return center - share * half, center + share * half

    def some(self, spans: Sequence[int]) -> tuple[FloatArray, FloatArray]:
        """The two levels (n,) where the last of `spans` (from 0) make the whole step, as many as may, and none else."""
        low, high = self.levels()
        center = 0.5 * (low + high)
        moving = [i for i in spans if high[i] > low[i]][-self.at_once :]
        one, other = center.copy(), center.copy()
        one[moving], other[moving] = low[moving], high[moving]
        return one, other

    def levels(self) -> tuple[FloatArray, FloatArray]:
        """The two levels (n,) of set-points. A draw-controlled span keeps its own."""
        least, most = setpoint_bands_n(self.line)
        step = np.minimum(self.tension_step_n, most - least)
        room = np.minimum(ROOM * step, 0.5 * (most - least - step))
        center = np.clip(self.tension_n, least + room + 0.5 * step, most - room - 0.5 * step)
        controlled = np.array([span.control == "tension" for span in self.line.spans])
        half = np.where(controlled, 0.5 * step, 0.0)
        own = np.where(half > 0.0, center, self.tension_n)
        return own - half, own + half


def near_m_per_s(line: Line) -> float:
    """By how much a speed that was measured may lie above the one that was asked for."""
    return NEAR * line_scales(line).speed_m_per_s


def improvement_courses(judged: Judged, lasting_s: float | None = None) -> Courses:
    """The named ones but moves, each change standing for `lasting_s`; of steps that the region permits."""
    stand_s = judged.lasting_s(STAND)
    lasting_s = judged.lasting_s(LASTING) if lasting_s is None else lasting_s
    low, high = judged.together()
    period_s, fast = judged.line.control.period_s, judged.fast_m_per_s
    found: Courses = {}
    if judged.tension_step_n > 0.0:
        parts = [(stand_s, low, fast), (lasting_s, high, fast), (lasting_s, low, fast)]
        found["tension"] = course_through(period_s, parts)
    if judged.speed_step_m_per_s > 0.0:
        now, before = judged.tension_n, judged.before_m_per_s
        found["velocity"] = course_through(
            period_s, [(stand_s, now, fast), (lasting_s, now, before), (lasting_s, now, fast)]
        )
    return found or {"standing": course_through(period_s, [(lasting_s, judged.tension_n, fast)])}


@dataclass(frozen=True)
class CornerCourse:
    """A course and the corners that it is for: all of them, or every so many from one on."""

    course: Course
    first: int = 0
    every: int = 1
    late: bool = True  #: it is looked at late, too

    @property
    def shared(self) -> bool:
        """With others of its kind it is shared out over the corners."""
        return self.every > 1

    def of(self, corners: Sequence[T]) -> Sequence[T]:
        """Its part of them."""
        return corners[self.first % len(corners) :: self.every]


CornerCourses = dict[str, CornerCourse]


def corner_courses(judged: Judged, lasting_s: float | None = None, tail_s: float | None = None) -> CornerCourses:
    """Speed down and up; steps of single spans, slow or fast; one after another; of some at once; each with a tail.

    Every other span steps slow, the others fast, and they share the corners among them. Without a tail nothing stands
    longer for it.
    """
    lasting_s, tail_s = _lasting(judged, lasting_s, tail_s)
    spans = [i for i, span in enumerate(judged.line.spans) if span.control == "tension"]
    some = judged.some(spans)
    period_s, fast, slow = judged.line.control.period_s, judged.fast_m_per_s, judged.slow_m_per_s
    now, before = judged.tension_n, judged.before_m_per_s

    def of(first: tuple[FloatArray, float], second: tuple[FloatArray, float], longer_s: float) -> Course:
        parts = [
            (judged.lasting_s(STAND), *first),
            (min(lasting_s, judged.lasting_s(BETWEEN)), *second),
            (lasting_s + longer_s, *first),
        ]
        return course_through(period_s, parts, tail_s)

    longer_s = judged.lasting_s(LONGER) if tail_s > 0.0 else 0.0
    found: CornerCourses = {"speed change": CornerCourse(of((now, fast), (now, before), 0.0))}
    if judged.tension_step_n > 0.0:
        every_other = (SLOW_ALONE, slow, spans[::2]), (FAST_ALONE, fast, spans[1::2] or spans)
        for name, speed, some_of in every_other:
            alone = _apart(some_of)
            for at, span in enumerate(alone):
                low, high = judged.some([span])
                found[f"span {span + 1} {name}"] = CornerCourse(
                    of((low, speed), (high, speed), longer_s), at, len(alone),
                    late=name == SLOW_ALONE and at == len(alone) // 2,
                )  # fmt: skip
        found["one after another"] = CornerCourse(
            course_through(period_s, _in_turn(judged, lasting_s, longer_s), tail_s)
        )
        found["neighbours"] = CornerCourse(of((some[0], fast), (some[1], fast), longer_s))
    return found


def programme_courses(judged: Judged, lasting_s: float | None = None, tail_s: float | None = None) -> CornerCourses:
    """Those, and one more: spans from the second on step up together while the others stand at their low level.

    Those that step draw web out of those that stand before them. Predictive control lets these fall by some newtons
    more than linear laws do, down to the limit that it plans by. Where fewer than two spans step there is none.
    """
    lasting_s, tail_s = _lasting(judged, lasting_s, tail_s)
    found, (low, high) = corner_courses(judged, lasting_s, tail_s), judged.levels()
    spans = np.flatnonzero(high > low)[1 : 1 + judged.at_once]
    if len(spans) == 0:
        return found
    up, fast = low.copy(), judged.fast_m_per_s
    up[spans] = high[spans]
    between_s = min(lasting_s, judged.lasting_s(BETWEEN))
    parts = [(judged.lasting_s(STAND), low, fast), (between_s, up, fast), (lasting_s, low, fast)]
    course = course_through(judged.line.control.period_s, parts, tail_s)
    return found | {OTHERS_LOW: CornerCourse(course, late=False)}


def _lasting(judged: Judged, lasting_s: float | None, tail_s: float | None) -> tuple[float, float]:
    """How long a change and the tail behind it last where nothing else is asked for (s)."""
    return (
        judged.lasting_s(LASTING) if lasting_s is None else lasting_s,
        judged.lasting_s(TAIL) if tail_s is None else tail_s,
    )


def _least(value: float, most: float | None) -> float:
    return value if most is None else min(value, most)


def _apart(spans: Sequence[int]) -> list[int]:
    """At most `MOST_ALONE` of them, at even distances."""
    count = min(len(spans), MOST_ALONE)
    return [spans[at * (len(spans) - 1) // max(count - 1, 1)] for at in range(count)]


def _in_turn(judged: Judged, lasting_s: float, longer_s: float) -> list[tuple[float, FloatArray, float]]:
    """From high to low, against the web, and back to the middle; each step before the last one is over."""
    low, high = judged.some(range(judged.line.n))
    parts, now = [(judged.lasting_s(STAND), high, judged.fast_m_per_s)], high
    for goal in (low, 0.5 * (low + high)):
        for i in np.flatnonzero(high != low)[::-1].tolist():
            now = np.where(np.arange(len(now)) == i, goal, now)
            parts.append((judged.lasting_s(TURN), now, judged.fast_m_per_s))
        parts[-1] = (min(lasting_s, judged.lasting_s(BETWEEN)), now, judged.fast_m_per_s)
    parts[-1] = (lasting_s + longer_s, now, judged.fast_m_per_s)
    return parts


def way_of_moves(judged: Judged, rest_s: float | None = None) -> Way | None:
    """The shaped move; None where no set-point may move at once."""
    low, high = judged.levels()
    middle, half = 0.5 * (low + high), 0.5 * MOVED * (high - low)
    needed_s = MinimumJerk.PEAK * MOVED * judged.tension_step_n / judged.line.moves.tension_rate_n_per_s
    time_s, rest_s = max(judged.lasting_s(MOVE), needed_s), judged.lasting_s(REST) if rest_s is None else rest_s
    way = Way(middle - half, middle + half, judged.fast_m_per_s, judged.lasting_s(STAND), time_s, rest_s)
    return way if judged.tension_step_n > 0.0 else None
