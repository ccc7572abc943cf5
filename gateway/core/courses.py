"""Courses in time of a proposal that waits: the line as the gate has simulated it, with what is in service and with
what is proposed, to be drawn one over the other.
"""

from typing import Annotated, Literal

from pydantic import Field

from gateway.core.line import Strict
from gateway.core.line_model import Digest

MOST_NUMBERS = 20_000  #: in an answer, so that it fits a message
MOST_POINTS = 150  #: of a course: more nobody sees

Drawn = Literal["in service", "proposed"]


class ShowCourses(Strict):
    proposal: Digest


class DrawnCourse(Strict):
    """Of one scenario, at the model's mean and without noise. All lists by span are of the line's spans, in order.

    Of each stretch of time two points, least and greatest of each list in the order they came in: no peak is lost.
    """

    scenario: Annotated[str, Field(min_length=1, max_length=60)]
    time_s: list[float]  #: from the begin of the scenario
    setpoint_n: list[list[float]]  #: by span
    tension_n: dict[Drawn, list[list[float | None]]]  #: by span; null: it has run away


class Courses(Strict):
    courses: list[DrawnCourse]


class CoursesTold(Strict):
    format: Annotated[int, Field(ge=1, le=1)]
    proposal: Digest
    verdict: Digest  #: of the same simulations
    model: Digest | None  #: by which they were made; null: the line's file
    drawing: bool  #: they are not there yet: ask again
    courses: list[DrawnCourse]  #: empty where none could be drawn, too
