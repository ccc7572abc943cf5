"""What processes say to each other: commands and their replies (JSON), events (JSON), telemetry (see `telemetry`)."""

import json
from typing import Annotated, Any, Literal

from pydantic import Field, TypeAdapter, ValidationError

from gateway.core.experiment import Experiment, experiment_hash
from gateway.core.line import Strict


class Arm(Strict):
    """SILENT or STOP to READY: prove limits, PLC and watchdogs; zero torque."""

    command: Literal["arm"] = "arm"


class Start(Strict):
    """READY to RUN: tension the web, then run at the set speed. HOLD to RUN: back to the set speed."""

    command: Literal["start"] = "start"


class Hold(Strict):
    """RUN to HOLD: ramp the speed to standstill, tension control stays on."""

    command: Literal["hold"] = "hold"


class Stop(Strict):
    """Any state: controlled stop, then torque off. Never refused."""

    command: Literal["stop"] = "stop"


class SetTension(Strict):
    """A tension set-point. Ramped at the line's rate, or made at once within `limits.tension_step_max_n`."""

    command: Literal["set"] = "set"
    span: Annotated[int, Field(ge=1)]
    tension_n: float
    step: bool = False


class SetSpeed(Strict):
    """The line speed set-point (unwinder). Ramped, or made at once within `limits.speed_step_max_m_per_s`."""

    command: Literal["speed"] = "speed"
    speed_m_per_s: float
    step: bool = False


class SelectRecipe(Strict):
    """All set-points of a recipe of the line's file, ramped."""

    command: Literal["recipe"] = "recipe"
    name: str


class RunExperiment(Strict):
    """In RUN, with set-points that stand: move them as the experiment says, then back."""

    command: Literal["experiment"] = "experiment"
    experiment: Experiment


class AbortExperiment(Strict):
    """End the experiment that runs; set-points go back to where they stood before it."""

    command: Literal["experiment-abort"] = "experiment-abort"


Command = Annotated[
    Arm | Start | Hold | Stop | SetTension | SetSpeed | SelectRecipe | RunExperiment | AbortExperiment,
    Field(discriminator="command"),
]
_command: TypeAdapter[Command] = TypeAdapter(Command)


def in_words(command: Command) -> str:
    """A command as a person would type it: "set 3 44.0 step"."""
    if isinstance(command, RunExperiment):
        return f"experiment {command.experiment.name} ({experiment_hash(command.experiment)[:12]})"
    values = command.model_dump().items()
    return " ".join(key if value is True else str(value) for key, value in values if value is not False)


class Reply(Strict):
    """What was done, or why not. A refusal has changed nothing, but that a refused arming has released the devices."""

    ok: bool
    state: str  #: the loop's state after the command
    text: str  #: one sentence for a person, with what to do next where it was refused
    reasons: list[str] = []  #: every reason of a refusal


class Event(Strict):
    """Something that happened once: a state change, a trip, a set-point. `data` holds the measured numbers."""

    time_s: float  #: monotonic
    kind: str
    text: str
    data: dict[str, Any] = {}


class BusReport(Strict):
    """How a bus and its devices fare, in the loop's words."""

    name: str
    absent: list[str]  #: devices that do not answer now
    timeouts: int  #: samples that did not come in time, since the loop's start
    malformed: int  #: frames and answers that were discarded
    reconnects: int
    last_error: str


BUS_REPORTS: TypeAdapter[list[BusReport]] = TypeAdapter(list[BusReport])


class MalformedMessage(Exception):
    """Bytes from outside that are no message; the text says why."""


def _no_duplicates(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    keys = [key for key, _ in pairs]
    twice = {key for key in keys if keys.count(key) > 1}
    if twice:
        raise MalformedMessage(f"key given twice: {', '.join(sorted(twice))}")
    return dict(pairs)


def parse_command(payload: bytes) -> Command:
    """A command from outside. Raises MalformedMessage with every reason."""
    if len(payload) > 4096:
        raise MalformedMessage(f"a command has at most 4096 bytes, this one {len(payload)}")
    try:
        document = json.loads(payload, object_pairs_hook=_no_duplicates)
    except (ValueError, RecursionError) as error:
        raise MalformedMessage(f"not JSON: {error}") from error
    try:
        return _command.validate_python(document)
    except ValidationError as error:
        reasons = "; ".join(f"{'.'.join(map(str, e['loc']))}: {e['msg']}" for e in error.errors())
        raise MalformedMessage(reasons) from error
