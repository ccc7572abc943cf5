"""Taking over without a jump: what a law would have changed the torque by at once, it changes it by in a while."""

from math import exp

FADE_S = 0.1  #: time constant
NEAR_SETPOINT = 0.02  #: a tension this near its set-point, as a fraction, is taken to be there: the rest is noise


def fade(period_s: float) -> float:
    """What is left after a period of the torque that was taken over."""
    return exp(-period_s / FADE_S)
