"""How often something may be asked: so many times a second, and some more after a pause. Pure, time passed in."""

BURST = 5.0  #: at once after a pause, also where less than that is allowed in a second


class Allowance:
    """A bucket that fills with `most_per_s`, up to `at_once`; without that up to a second of them or BURST."""

    def __init__(self, most_per_s: float, at_once: float | None = None) -> None:
        self._most_per_s = most_per_s
        self._full = max(BURST, most_per_s) if at_once is None else at_once
        self._left = self._full
        self._last_s: float | None = None

    def take(self, now_s: float) -> bool:
        """Whether one more is allowed at `now_s` (monotonic); what is not allowed costs nothing."""
        if self.wait_s(now_s) > 0.0:
            return False
        self._left -= 1.0
        return True

    def wait_s(self, now_s: float) -> float:
        """Seconds from `now_s` (monotonic) until one more is allowed; 0: it is. Takes nothing."""
        passed_s = 0.0 if self._last_s is None else max(0.0, now_s - self._last_s)
        self._left = min(self._full, self._left + passed_s * self._most_per_s)
        self._last_s = now_s
        return max(0.0, (1.0 - self._left) / self._most_per_s)
