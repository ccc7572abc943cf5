"""What the loop does about a finding, in order of severity; the most severe wins. Each says what clears it."""

from collections.abc import Mapping
from dataclasses import dataclass
from enum import IntEnum

from gateway.core import finding as data
from gateway.core.finding import Value
from gateway.wording.catalogue import sentence


class Action(IntEnum):
    """Ordered: a higher one includes what a lower one does."""

    NONE = 0
    HOLD_OUTPUTS = 1  #: the torques of the period before stay; cleared by the next complete set of samples
    STOP = 2  #: controlled stop, then torque off; latched, cleared by `arm`
    BRAKE = (
        3  #: what turns is braked on its own speed, where the drives can; then torque off; latched, cleared by `arm`
    )
    TORQUE_OFF = 4  #: torque ramps to zero at once and comes off; latched, cleared by `arm`


@dataclass(frozen=True, slots=True)
class Finding:
    """One rule that is not met, with the measured numbers and what to do next."""

    rule: str  #: its code
    action: Action
    parameters: Mapping[str, Value]

    @property
    def text(self) -> str:
        """The English sentence: made where somebody is told, which most periods of a lasting finding are not."""
        return sentence(self.as_data())

    def as_data(self) -> data.Finding:
        """Code and parameters."""
        return data.Finding(code=self.rule, parameters=dict(self.parameters))


def found(code: str, action: Action, **parameters: float | str) -> Finding:
    """A finding of the catalogue, by its code; numbers in SI, the unit in the name."""
    return Finding(code, action, data.finding(code, **parameters).parameters)


def most_severe(findings: list[Finding]) -> Action:
    return max((finding.action for finding in findings), default=Action.NONE)
