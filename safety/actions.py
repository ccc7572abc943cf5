"""What the loop does about a finding, in order of severity; the most severe wins. Each says what clears it."""

from dataclasses import dataclass
from enum import IntEnum


class Action(IntEnum):
    """Ordered: a higher one includes what a lower one does."""

    NONE = 0
    HOLD_OUTPUTS = 1  #: the torques of the period before stay; cleared by the next complete set of samples
    STOP = 2  #: controlled stop, then torque off; latched, cleared by `arm`
    TORQUE_OFF = 3  #: torque ramps to zero at once and comes off; latched, cleared by `arm`


@dataclass(frozen=True, slots=True)
class Finding:
    """One rule that is not met, with the measured numbers and what to do next."""

    rule: str
    action: Action
    text: str


def most_severe(findings: list[Finding]) -> Action:
    return max((finding.action for finding in findings), default=Action.NONE)
