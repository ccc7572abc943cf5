"""When what has failed is tried again: later each time, and told once, and when it is over."""

from collections.abc import Callable
from math import inf

FIRST_WAIT_S = 5.0  #: after the first failure; then twice as long each time
LONGEST_WAIT_S = 300.0


class Patience:
    """Of one thing that is tried: ask `is_due` before, say `failed` or `succeeded` afterwards."""

    def __init__(self, clock: Callable[[], float]) -> None:
        self._clock = clock
        self.begin_anew()

    def begin_anew(self) -> None:
        """What is to be tried is another thing now: it is due at once."""
        self._failures = 0
        self._due_s = -inf

    def is_due(self) -> bool:
        return self._clock() >= self._due_s

    def failed(self) -> bool:
        """Wait, longer than the last time. Returns whether it is the first failure in a row: to be told."""
        self._due_s = self._clock() + min(FIRST_WAIT_S * 2.0 ** min(self._failures, 16), LONGEST_WAIT_S)
        self._failures += 1
        return self._failures == 1

    def succeeded(self) -> bool:
        """Returns whether it had failed: that this is over is to be told."""
        had_failed = self._failures > 0
        self.begin_anew()
        return had_failed
