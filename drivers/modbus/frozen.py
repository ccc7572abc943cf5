"""Finds a drive that answers, and nothing that it says moves any more. No I/O.

A drive without a counter of its own says nothing new at standstill under a constant torque, and that is right. But
one that follows its torque command shows another torque when the command has changed by more than a few counts.
"""

from collections.abc import Sequence

ANSWERS_ALLOWED = 20  #: the same, to a command that differs; some interfaces renew their registers seldom
COUNTS_ALLOWED = 10  #: between the commands: a resolution may be coarser than its unit


class FrozenAnswers:
    """`nm_per_count` is the unit of the torque that the drive reports."""

    def __init__(self, nm_per_count: float) -> None:
        self._allowed_nm = COUNTS_ALLOWED * nm_per_count
        self._answer: Sequence[float] = ()
        self._commanded_nm = 0.0  #: when the answer moved last
        self._same = 0  #: answers since, to a command that differs from that one

    def after(self, answer: Sequence[float], commanded_nm: float, *, following: bool) -> bool:
        """Whether `answer`, the newest, is that of a frozen drive: until one moves.

        `following`: it was sent `commanded_nm`, and says that it follows its torque command.
        """
        if answer != self._answer:
            self._answer, self._commanded_nm, self._same = answer, commanded_nm, 0
        elif following and abs(commanded_nm - self._commanded_nm) > self._allowed_nm:
            self._same += 1
        return self._same > ANSWERS_ALLOWED

    def forget(self) -> None:
        self._answer, self._same = (), 0
