"""What every control law looks like to the cycle: engage, ask, commit.

The configuration is frozen; the state is a value that goes in and comes out. `commit` is told the torque that was
really applied, after limits and envelope, so that integrators never run away from the actuators.
"""

from dataclasses import dataclass
from typing import Protocol, TypeVar

from gateway.control.deviation import Errors, Measured
from gateway.control.reference import Reference
from gateway.core.signals import FloatArray

__all__ = ["Decision", "Law", "Measured"]


@dataclass(slots=True)
class Decision:
    """What a law asks for, and the errors that it has asked it on."""

    torque_nm: FloatArray  #: (n,)
    errors: Errors
    fallback: str = ""  #: why it is not what the law would have asked for by itself


State = TypeVar("State")


class Law(Protocol[State]):
    """A control law of `n` spans, ready to run."""

    n: int

    def engage(self, measured: Measured, reference: Reference, applied_nm: FloatArray) -> State:
        """The state from which the first `ask` returns `applied_nm` (n,): bumpless, whatever ran before."""
        ...

    def ask(self, state: State, measured: Measured, reference: Reference) -> Decision:
        """The torque that the law wants now, before any limit."""
        ...

    def commit(self, state: State, decision: Decision, applied_nm: FloatArray) -> State:
        """The state for the next period, given the torque (n,) that was really applied."""
        ...
