"""An exception of a part of the period is a finding, not the end of the process.

The first one stops the line in order: what failed is left out from then on, everything else goes on watching. A second
one in the same run shows that the loop cannot be relied on: it is raised, and ends the process, whose last act is to
take torque off (`process`). Arming gives every part another chance.
"""

from collections.abc import Callable
from typing import ParamSpec, TypeVar

from safety.actions import Action, Finding

P = ParamSpec("P")
T = TypeVar("T")

PART_FAILED = "part failed"  #: the rule's name
OUTSIDE = ("the link ", "the command ", "events", "telemetry")  #: how parts begin that no configuration is in


class Containment:
    """Of one loop. `failed`: the parts that are left out, with why."""

    def __init__(self) -> None:
        self.failed: dict[str, str] = {}
        self._untold: list[Finding] = []

    def run(self, part: str, otherwise: T, do: Callable[P, T], *args: P.args, **named: P.kwargs) -> T:
        """What `do` returns; `otherwise` where it raises, or has been left out since. Raises what fails second."""
        if self.failed and part in self.failed:
            return otherwise
        try:
            return do(*args, **named)
        except Exception as error:  # whatever it is
            self.fail(part, error)
            return otherwise

    def fail(self, part: str, error: Exception, action: Action = Action.STOP) -> None:
        """`part` has raised `error` and is left out from now on. Raises it again where it is the second."""
        if self.failed:
            raise error
        self.failed[part] = f"{type(error).__name__}: {error}"
        text = (
            f"{part} failed and is left out until the line is armed: {self.failed[part]}; keep the log, and report it"
        )
        self._untold.append(Finding(PART_FAILED, action, text))

    def take_findings(self) -> list[Finding]:
        """What has failed since this was asked last."""
        untold = self._untold
        if untold:
            self._untold = []
        return untold

    @property
    def speaks_of_configuration(self) -> bool:
        """Whether something has failed that a configuration or its model is in."""
        return any(not part.startswith(OUTSIDE) for part in self.failed)

    def begin_anew(self) -> None:
        """A person arms."""
        self.failed.clear()
