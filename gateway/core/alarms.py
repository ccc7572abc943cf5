"""The alarms of a line: what each means, what follows, what to do. No more than a person can keep in mind.

A proposal that waits is no alarm: it is a prompt. Nothing here acts on the line; what must act is the loop's.
"""

from dataclasses import dataclass
from typing import Annotated, Literal

from pydantic import Field

from gateway.core.line import Strict

Priority = Literal["high", "medium", "low"]
MOST_ALARMS = 12
LONGEST_SHELVED_S = 8.0 * 3600.0  #: a shift

AlarmName = Annotated[str, Field(pattern=r"^[a-z][a-z0-9-]{0,39}$")]


@dataclass(frozen=True)
class Alarm:
    """A row of the table."""

    name: str
    priority: Priority
    means: str  #: in a few words, for a list
    cause: str
    consequence: str  #: of doing nothing
    action: str


class AlarmStatus(Strict):
    """One alarm of the table that is active, or has not been acknowledged."""

    name: AlarmName
    priority: Priority
    means: str
    text: str  #: with the measured values, as they were when it came
    cause: str
    consequence: str
    action: str
    active: bool
    acknowledged: bool
    first_out: bool  #: the first of those that came together
    since_wall_s: float
    ended_wall_s: float | None  #: null: it is active
    acknowledged_by: str  #: empty: by nobody
    shelved_until_wall_s: float | None  #: null: it is not


class AcknowledgeAlarm(Strict):
    """A person has seen it."""

    command: Literal["acknowledge"] = "acknowledge"
    alarm: AlarmName
    comment: Annotated[str, Field(max_length=1000)] = ""


class ShelveAlarm(Strict):
    """Out of the way for a while: it is listed as shelved, comes back by itself, and never acts on the line."""

    command: Literal["shelve"] = "shelve"
    alarm: AlarmName
    for_s: Annotated[float, Field(ge=0.0, le=LONGEST_SHELVED_S)]  #: 0: back at once
    because: Annotated[str, Field(min_length=1, max_length=1000)]
