"""An exception of a part of the period is a finding, not the end of the process.

The first one stops the line in order: what failed is left out from then on, everything else goes on watching. A second
one in the same run shows that the loop cannot be relied on: it is raised, and ends the process, whose last act is to
take torque off (`process`). Arming gives every part another chance.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import ParamSpec, TypeVar

from safety.actions import Action, Finding, found

P = ParamSpec("P")
T = TypeVar("T")

PART_FAILED = "part-failed"  #: the code


@dataclass(frozen=True, slots=True)
class Part:
    """A part of the period, by the name that is told."""

    name: str
    of_configuration: bool = True  #: a controller or a model is in it: what fails says something of them


class Containment:
    """Of one loop. `failed`: the parts that are left out, with why."""

    def __init__(self) -> None:
        self.failed: dict[str, str] = {}
        self.speaks_of_configuration = False  #: something has failed that a configuration or its model is in
        self._untold: list[Finding] = []

    def run(self, part: Part, otherwise: T, do: Callable[P, T], *args: P.args, **named: P.kwargs) -> T:
        """What `do` returns; `otherwise` where it raises, or has been left out since. Raises what fails second."""
        if self.failed and part.name in self.failed:
            return otherwise
        try:
            return do(*args, **named)
        except Exception as error:  # whatever it is
            self.fail(part, error)
            return otherwise

    def fail(self, part: Part, error: Exception, action: Action = Action.STOP) -> None:
        """`part` has raised `error` and is left out from now on. Raises it again where it is the second."""
        if self.failed:
            raise error
        self.failed[part.name] = raised = f"{type(error).__name__}: {error}"
        self.speaks_of_configuration |= part.of_configuration
        self._untold.append(found(PART_FAILED, action, part=part.name, error=raised))

    def take_findings(self) -> list[Finding]:
        """What has failed since this was asked last."""
        untold = self._untold
        if untold:
            self._untold = []
        return untold

    def begin_anew(self) -> None:
        """A person arms."""
        self.failed.clear()
        self.speaks_of_configuration = False
