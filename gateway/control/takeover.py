"""Taking over without a jump: what a law would have changed the torque by at once, it changes it by in a while."""

from math import exp

FADE_S = 0.1  #: time constant


def fade(period_s: float) -> float:
    """What is left after a period of the torque that was taken over."""
    return exp(-period_s / FADE_S)
