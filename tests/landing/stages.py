"""What a change must pass, as stages: those about nothing but results first, those that a stall may fail last.

Long tests are left to `make test-long`: with them a slow machine would not come to its end in time.
"""

from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path


@dataclass(frozen=True)
class Stage:
    name: str
    paths: tuple[str, ...]
    marks: str  #: pytest's `-m`; empty for all
    workers: int  #: pytest processes beside each other; 0 for none but one
    limit_s: float
    besides: tuple[str, ...] = ()  #: below the paths, and not of the stage
    needs: str = ""  #: a module that installs what the stage needs beside the environment

    def of(self, only: Iterable[str]) -> tuple[str, ...]:
        """What is to be run of it where only these files and folders are asked for; none: nothing is."""
        found: set[Path] = set()
        for asked in map(Path, only):
            for path in map(Path, self.paths):
                if asked.is_relative_to(path):
                    found.add(asked)
                elif path.is_relative_to(asked):
                    found.add(path)
        return tuple(sorted(str(path) for path in found if not any(map(path.is_relative_to, self.besides))))


STAGES = (
    Stage("pure", ("tests",), "not wires and not realtime and not long", 2, 2700.0, ("tests/system",)),
    Stage(
        "wires", ("tests/unit", "tests/protocol", "tests/closed_loop"), "wires and not realtime and not long", 2, 1800.0
    ),
    Stage("real time", ("tests/closed_loop",), "realtime and not long", 0, 2400.0),
    Stage("system", ("tests/system",), "", 0, 2700.0, needs="tests.system.needs"),
)

#: Of all stages together: whoever runs this has a limit, too, and wants to read what was found until then.
WHOLE_LIMIT_S = 4800.0

#: The same examples, whatever the machine's environment says: new ones are sought with `make search`, not at the door.
SAME_DRAWS = ("--hypothesis-profile", "landing")
