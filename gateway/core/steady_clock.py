"""Ages that no setting of the wall clock makes longer or shorter. Pure; both clocks are given.

Within a boot of the machine the monotonic clock tells an age. Across boots only the wall clock can, and it is asked
only where it was seen to agree with the monotonic one for some time, then and now. Otherwise what is known is that the
age is at least as long as the machine has been up. So an age is an interval: what deletes, expires or lets something
go waits for its least, what asks whether something is recent enough asks for its most.

CLOCK_MONOTONIC stands still while a machine is suspended: ages are too short then, which keeps things longer.
"""

from collections.abc import Callable
from dataclasses import dataclass
from math import inf

JUMP_S = 0.5  #: what a wall clock that is being disciplined may move against the monotonic one
AGREES_AFTER_S = 600.0  #: without a jump
EARLIEST_WALL_S = 1_767_225_600.0  #: 2026, before this program was: a computer without a battery begins in 1970


@dataclass(frozen=True)
class Moment:
    """When something was, by both clocks."""

    wall_s: float  #: Unix time
    boot: str = ""  #: monotonic times compare within one; empty: not on record, and the wall clock is all there is
    monotonic_s: float = 0.0
    agreed: bool = False  #: the wall clock was seen to agree


@dataclass(frozen=True)
class Age:
    least_s: float
    most_s: float  #: inf: it is not known


class SteadyClock:
    """To be looked at often: a jump is seen between two looks."""

    def __init__(self, clock: Callable[[], float], wall_clock: Callable[[], float], boot: str) -> None:
        self.boot = boot
        self.agreed_ahead_s: float | None = None  #: Unix time minus monotonic time; None: it is not seen to agree now
        self._clock = clock
        self._wall_clock = wall_clock
        self._ahead_s = wall_clock() - clock()  # when it last began to agree
        self._since_s = clock()

    def look(self) -> None:
        """Compare the clocks."""
        now_s, wall_s = self._clock(), self._wall_clock()
        ahead_s = wall_s - now_s
        if not abs(ahead_s - self._ahead_s) <= JUMP_S:
            self._ahead_s, self._since_s = ahead_s, now_s
        agrees = now_s - self._since_s >= AGREES_AFTER_S and wall_s >= EARLIEST_WALL_S
        self.agreed_ahead_s = self._ahead_s if agrees else None

    def now(self) -> Moment:
        self.look()
        return Moment(self._wall_clock(), self.boot, self._clock(), self.agreed_ahead_s is not None)

    def age(self, moment: Moment) -> Age:
        """How long ago it was."""
        now = self.now()
        if not moment.boot:
            by_wall_s = max(0.0, now.wall_s - moment.wall_s)
            return Age(by_wall_s, by_wall_s)
        if moment.boot == self.boot:
            age_s = max(0.0, now.monotonic_s - moment.monotonic_s)
            return Age(age_s, age_s)
        up_s = max(0.0, now.monotonic_s)  # it was before this boot
        by_wall_s = now.wall_s - moment.wall_s
        if moment.agreed and now.agreed and by_wall_s >= up_s:
            return Age(by_wall_s, by_wall_s)
        return Age(up_s, inf)
