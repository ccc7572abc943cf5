"""The life counter between gateway and PLC: it moves with every command, and so must the PLC's echo of it. No I/O.

An interface that still answers for a dead PLC is found by it, and one that counts by itself.
"""

ECHOES_ALLOWED = 3  #: answers in a row without an echo of a new command until the PLC counts as stale
COMMANDS_UNDER_WAY = 4  #: an echo is of one of the last commands


class LifeCounter:
    """16 bit; wraps."""

    def __init__(self) -> None:
        self.value = 0
        self._echo = -1.0
        self._same = 0

    def next(self) -> int:
        """The number to send with the next command."""
        self.value = (self.value + 1) & 0xFFFF
        return self.value

    def stands_still(self, echo: float, *, moving: bool) -> bool:
        """Whether no new command has been echoed for too long. `moving`: commands are being sent."""
        ours = (self.value - int(echo)) & 0xFFFF <= COMMANDS_UNDER_WAY
        self._same = 0 if (ours and echo != self._echo) or not moving else self._same + 1
        self._echo = echo
        return self._same >= ECHOES_ALLOWED

    def forget(self) -> None:
        """Silence: an echo that stands still is no wonder."""
        self._same = 0
