"""What the loop doubts while it runs on: each doubt blocks proposals, and says what a person can do."""

from enum import IntFlag


class Doubt(IntFlag):
    """Reasons why what is measured now is no ground for a change of the controller."""

    NONE = 0
    SATURATED = 1  #: torques have been at their limits for too long
    CELL_STUCK = 2  #: a load cell shows one value while the line moves
    CELL_DRIFTS = 4  #: torques and tensions no longer balance as they did at the same set-points
    TORQUE_UNCOMPARED = 8  #: what a drive gives is not known: it cannot be compared with what it is asked


WORDS: dict[Doubt, str] = {
    Doubt.SATURATED: "torques are at their limits: lower the set-points or the speed",
    Doubt.CELL_STUCK: "a load cell is stuck: check it, its amplifier and its cable",
    Doubt.CELL_DRIFTS: "a load cell seems to drift: check its zero when the line stands",
    Doubt.TORQUE_UNCOMPARED: "torque asked and given are not compared any more: check the drive's torque reading",
}


def in_words(doubts: int) -> list[str]:
    """The doubts in a mask, for a person; those of a newer loop are told as numbers."""
    known = [text for doubt, text in WORDS.items() if doubts & doubt]
    unknown = doubts & ~sum(WORDS)
    return known + ([f"doubt {unknown:#x}, which this program does not know"] if unknown else [])
