"""What is large and what is small on a line: the measures from which thresholds are derived that nobody gives.

A threshold that is a number of newtons fits one line. Here stand the quantities that every line's file has, and of
which thresholds are a share: the tension band, the greatest speed, the torque limit, the dead time of the loop, and the
time in which the line answers. Scale a line in length, force and time, and all of them scale with it.
"""

from dataclasses import dataclass
from math import sqrt
from typing import TYPE_CHECKING

if TYPE_CHECKING:  # the line's own defaults are derived from these
    from gateway.core.line import Line

BAND_SHARE = 58.0  #: a tension that is small on a line is so little of its band
SPEED_SHARE = 60.0  #: a speed that is small, so little of its greatest one: hardly more than standstill
WEB_SHARE = 25.0  #: one part in so many of the time in which the slowest span moves its roller
STEPS = 4.0  #: of an integration, in whatever is quickest on the line
ANSWERED = 30.0  #: of those moments, until the line has answered to what is asked of it


@dataclass(frozen=True, slots=True)
class LineScales:
    """Of one line. SI."""

    tension_n: float  #: small: 1 N where the band has 58
    speed_m_per_s: float  #: small: 2 mm/s where the greatest speed is 0.12 m/s
    torque_nm: float  #: the limit
    period_s: float
    dead_time_s: float  #: from a change on the line to the torque that answers it: a period and the latency
    moment_s: float  #: the shortest time in which anything can be told of the loop: 20 ms at 10 ms and 10 ms latency

    @property
    def response_s(self) -> float:
        """In which the line has answered to what is asked of it."""
        return ANSWERED * self.moment_s

    def periods(self, moments: float) -> int:
        """That so many moments last, at least one."""
        return max(1, round(moments * self.moment_s / self.period_s))


def runaway_n(line: "Line") -> float:
    """The tension (N) beyond which a simulated loop has run away, 17 times the greatest: it tells no more."""
    return line.limits.tension_max_n / 60.0 * 1000.0


def line_scales(line: "Line") -> LineScales:
    """The scales of `line`, from its limits, its timing and the nominal web."""
    control, limits = line.control, line.limits
    dead_time_s = control.period_s + control.latency_s
    return LineScales(
        tension_n=(limits.tension_max_n - limits.tension_min_n) / BAND_SHARE,
        speed_m_per_s=limits.speed_max_m_per_s / SPEED_SHARE,
        torque_nm=limits.torque_nm,
        period_s=control.period_s,
        dead_time_s=dead_time_s,
        moment_s=max(dead_time_s, web_time_s(line) / WEB_SHARE),
    )


def longest_step_of(line: "Line") -> float:
    """The longest step (s) of an integration that follows what the line does, at nominal values."""
    stiffness_n = line.web.stiffness_n.value
    shortest_s = min(
        min(
            sqrt(0.5 * span.length_m.value * roller.inertia_kg_m2.value / stiffness_n) / roller.radius_m.value,
            roller.inertia_kg_m2.value / roller.friction_nms_per_rad.value,
        )
        for span, roller in zip(line.spans, line.rollers, strict=False)
    )
    return min(line_scales(line).moment_s, shortest_s) / STEPS


def web_time_s(line: "Line") -> float:
    """In which the slowest span moves its own roller: sqrt(L J / (E A R^2)), at nominal values."""
    return max(  # no power, and no product in the divisor: absurd numbers give infinity, and others refuse them
        sqrt(span.length_m.value * roller.inertia_kg_m2.value / line.web.stiffness_n.value) / roller.radius_m.value
        for span, roller in zip(line.spans, line.rollers, strict=False)  # their numbers are another rule's
    )
