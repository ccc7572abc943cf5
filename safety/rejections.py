"""Samples that are not used because they cannot be true: told, counted, and too many of them stop the line. Pure.

What the next sample may confirm is told with that one, if it does not: where a web tears, no cell is to be looked at.
"""

from collections.abc import Collection, Sequence
from dataclasses import dataclass, field

from gateway.core.line import Line
from gateway.core.line_scales import line_scales
from safety.actions import Action, Finding, found

CODE = "value-impossible"
MOST, WINDOW = 3, 10  #: periods with such a sample among so many: the line stops
QUIET_MOMENTS = 50.0  #: without one of a channel until the next one of it is told again


@dataclass(frozen=True, slots=True)
class Impossible:
    """A sample that is not used: of which channel ("tension", "speed", "torque", "unwinder speed"), from 1."""

    channel: str
    number: int  #: 0 where there is one only
    value: float  #: N, m/s or Nm
    low: float  #: what was possible
    high: float
    unit: str
    confirmable: bool = False  #: the next sample may say that it was so after all

    @property
    def name(self) -> tuple[str, int]:
        """Channel and number."""
        return self.channel, self.number


@dataclass(slots=True)
class Rejections:
    """What was not used so far."""

    quiet_periods: int
    count: int = 0  #: samples since the loop began
    periods: int = 0
    history: int = 0  #: a bit a period, the newest lowest
    last: dict[tuple[str, int], int] = field(
        default_factory=dict[tuple[str, int], int]
    )  #: period, by channel and number
    waiting: list[Impossible] = field(default_factory=list[Impossible])  #: of the period before, not told yet


def rejections(line: Line) -> Rejections:
    """None yet."""
    return Rejections(line_scales(line).periods(QUIET_MOMENTS))


def take_in(
    state: Rejections, rejected: Sequence[Impossible], confirmed: Collection[tuple[str, int]] = ()
) -> list[Finding]:
    """A period's samples that were not used: what is to be told of them (no action), or stops the line.

    `confirmed`: channels whose sample says now that the one before, which was not used, was true.
    """
    state.periods += 1
    if not rejected and not state.history:
        return []
    state.history = ((state.history << 1) | bool(rejected)) & ((1 << WINDOW) - 1)
    state.count += len(rejected)
    stops = bool(rejected) and state.history.bit_count() >= MOST
    spoken_for = {*confirmed, *(one.name for one in rejected if stops)}
    untold = [one for one in state.waiting if one.name not in spoken_for]
    state.waiting = [one for one in rejected if one.confirmable and not stops]
    now = [one for one in rejected if stops or not one.confirmable]
    told = [_finding(state, one, Action.NONE) for one in untold if _is_news(state, one)]
    if stops:
        return told + [_finding(state, one, Action.STOP) for one in now]
    return told + [_finding(state, one, Action.NONE) for one in now if _is_news(state, one)]


def _is_news(state: Rejections, one: Impossible) -> bool:
    """Whether nothing was told of its channel of late; from now on it was."""
    before = state.last.get(one.name)
    state.last[one.name] = state.periods
    return before is None or state.periods - before > state.quiet_periods


def _finding(state: Rejections, one: Impossible, action: Action) -> Finding:
    return found(
        CODE,
        action,
        channel=f"{one.channel} {one.number}" if one.number else one.channel,
        value=one.value,
        low=one.low,
        high=one.high,
        unit=one.unit,
        count=state.count,
    )
