"""What a drive displays as its mode of operation, against the one that it was told. No I/O.

Some drives display 0 until they are enabled: of one whose map does not say that it displays its mode at rest, a 0 at
rest says nothing. Every drive displays it once it is enabled: until it has done so no torque is asked of it, whatever
it displayed before. One
reading is no proof: a wrong one is read again at once.
"""

from gateway.core.signals import DriveCondition

READ_S = 0.5  #: how often it is asked for where no cyclic data bring it
DOUBT_S = 0.05  #: the same while it is not what it should be
READINGS = 2  #: in a row that display another mode, until the drive is in another one
REFUSALS = 3  #: to display a mode that only the profile says is displayed, until it is not asked any more
_NO_MODE = 0
# As plain numbers: these are asked for in every cycle.
_NONE, _UNCONFIRMED, _WRONG = 0, int(DriveCondition.MODE_UNCONFIRMED), int(DriveCondition.WRONG_MODE)


class ModeDisplay:
    """`at_rest`: it is displayed also while the drive is not enabled. `certain`: the map says that it is displayed."""

    def __init__(self, wanted: int, *, at_rest: bool, certain: bool) -> None:
        self.mode: int | None = None  #: displayed last; None: not yet
        self.is_seen = True  #: False: the drive does not display it
        self._wanted = wanted
        self._at_rest = at_rest
        self._certain = certain
        self._wrong = 0  #: readings in a row
        self._of_enabled = False  #: the last reading was taken while it was enabled
        self._refusals = 0

    def on_mode(self, mode: int, *, enabled: bool) -> None:
        """It displays this; `enabled`: and was enabled when it was asked."""
        if enabled != self._of_enabled:
            self._of_enabled, self._wrong = enabled, 0
        self.mode = mode
        self._wrong = self._wrong + 1 if mode != self._wanted else 0
        self._refusals = 0

    def on_refusal(self) -> None:
        """It did not answer, or has no such object."""
        self._refusals += 1
        if not self._certain and self.mode is None and self._refusals >= REFUSALS:
            self.is_seen = False

    def condition(self, *, enabled: bool) -> int:
        """What follows of the readings for a drive that is enabled now, or is not: a mask of DriveCondition."""
        mode = self.mode
        if mode == self._wanted and (self._of_enabled or not enabled):
            return _NONE
        if not self.is_seen:
            return _NONE
        if mode is None or mode == self._wanted:
            return _UNCONFIRMED if enabled or self._at_rest else _NONE
        if mode == _NO_MODE and not (enabled or self._at_rest):
            return _NONE
        counts = self._of_enabled or not enabled or mode != _NO_MODE  # 0 from before it was enabled says nothing
        return _WRONG if counts and self._wrong >= READINGS else _UNCONFIRMED

    def read_after_s(self, *, enabled: bool) -> float:
        """How long after the last question the next one is due; infinite where there is none."""
        if not self.is_seen:
            return float("inf")
        if enabled and not self._of_enabled:
            return 0.0
        settled = self.mode == self._wanted or (self.mode == _NO_MODE and not (enabled or self._at_rest))
        return READ_S if settled else DOUBT_S

    def forget(self) -> None:
        """What it displayed before does not count any more."""
        self.mode = None
        self.is_seen = True
        self._wrong = self._refusals = 0
        self._of_enabled = False
