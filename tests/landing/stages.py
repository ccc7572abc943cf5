"""What a change must pass, as stages: those about nothing but results first, those that a stall may fail last."""

from dataclasses import dataclass


@dataclass(frozen=True)
class Stage:
    name: str
    paths: tuple[str, ...]
    marks: str  #: pytest's `-m`; empty for all
    workers: int  #: pytest processes beside each other; 0 for none but one
    limit_s: float
    needs: str = ""  #: a module that installs what the stage needs beside the environment


STAGES = (
    Stage("pure", ("tests",), "not wires and not realtime", 2, 2400.0),
    Stage("wires", ("tests/unit", "tests/protocol", "tests/closed_loop"), "wires and not realtime", 2, 1200.0),
    Stage("real time", ("tests/closed_loop",), "realtime", 0, 1500.0),
    Stage("system", ("tests/system",), "", 0, 1500.0, "tests.system.needs"),
)

#: Of all stages together: whoever runs this has a limit, too, and wants to read what was found until then.
WHOLE_LIMIT_S = 4800.0

#: The same examples, whatever the machine's environment says: new ones are sought with `make search`, not at the door.
SAME_DRAWS = ("--hypothesis-profile", "landing")
