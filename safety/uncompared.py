"""Drives of whose torque nothing is heard that counts: what they give is compared with nothing. Pure.

The status of a value may go bad and its drive run on: speed and state are there, and nobody sees any more what it
gives. That is told soon, and after the time in which a drive that differs would be blamed (`drive_feedback`) the drive
is one that is not compared any more. A status that comes and goes is counted as a difference is: two up, one down.
"""

from dataclasses import dataclass, field

import numpy as np

from gateway.core.signals import BoolArray, CountArray, Inputs, Quality
from safety.actions import Action, Finding, found
from safety.drive_feedback import FeedbackLimits

_GOOD = int(Quality.GOOD)


@dataclass(slots=True)
class UncomparedState:
    """Of the drives of a line with `n` rollers. Arrays (n,)."""

    n: int
    unheard: CountArray = field(init=False)  #: up by two in a period without a torque, down by one in one with it
    told: BoolArray = field(init=False)
    uncompared: BoolArray = field(init=False)  #: until their torque has been heard for as long

    def __post_init__(self) -> None:
        self.begin_anew()

    def begin_anew(self) -> None:
        """A person arms, or nothing is compared now."""
        self.unheard = np.zeros(self.n, np.int64)
        self.told, self.uncompared = np.zeros((2, self.n), np.bool_)


def find_uncompared(limits: FeedbackLimits, state: UncomparedState, inputs: Inputs, lost: BoolArray) -> list[Finding]:
    """Bring `state` up to date; what is to be told, which stops nothing. Drives that are `lost` (n,) are not judged."""
    if inputs.torque.good() and not any(state.unheard.tobytes()):
        return []
    unheard = (inputs.torque.quality != _GOOD) & ~lost
    state.unheard = np.clip(state.unheard + np.where(unheard, 2, -1), 0, limits.doubted)
    soon = (state.unheard >= limits.unheard) & ~state.told
    late = (state.unheard >= limits.doubted) & ~state.uncompared
    heard = state.unheard == 0
    state.told, state.uncompared = (state.told | soon) & ~heard, (state.uncompared | late) & ~heard
    return [
        found(code, Action.NONE, drive=limits.names[i])
        for code, which in (("torque-status-bad", soon), ("torque-not-compared", late))
        for i in np.flatnonzero(which).tolist()
    ]
