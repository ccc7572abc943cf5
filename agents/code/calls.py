"""What the Code agent computes: a closed list of calls. Inputs are names, choices and bounded numbers. Pure.

Models, controllers and recordings are named, never given: there is no key for a matrix, a limit or a file. A call is
read here in full, whoever has written it.
"""

import json
import re
from collections.abc import Sequence
from typing import Annotated, Any, Literal, Self, cast, get_args

from pydantic import AfterValidator, Field, ValidationError, model_validator

from gateway.core.json_problems import problems
from gateway.core.line import Strict
from gateway.core.line_problem import printable
from gateway.core.nearest import nearest

MOST_BYTES = 2048  #: of a call as JSON
IN_SERVICE, NOMINAL, NEWEST = "in-service", "nominal", "newest"
OF_A_CALL = "call "  #: before the number of an earlier call
LEAST_FACTOR, MOST_FACTOR = 0.1, 10.0

_HASH = r"[0-9a-f]{6,64}"
_MODEL = rf"^({IN_SERVICE}|{NOMINAL}|{_HASH})$"
_CONTROLLER = rf"^({IN_SERVICE}|{OF_A_CALL}[1-9][0-9]?)$"
_RECORDING = rf"^({NEWEST}|[1-9][0-9]{{0,2}})$"

ArchitectureName = Literal["pid", "lqr", "lqi", "lqg", "mpc"]
ScenarioName = Literal["tension-step", "speed-step"]
Channel = Literal["tension", "speed", "torque"]
#: The knobs of each architecture, as gateway/commissioning/architectures.py has them.
KNOBS: dict[ArchitectureName, tuple[str, ...]] = {
    "pid": ("speed_share", "tension_share"),
    "lqr": ("torque_per_nm2",),
    "lqi": ("torque_per_nm2", "integral_per_n2s2", "antiwindup"),
    "lqg": ("torque_per_nm2", "disturbance_nm_per_sqrt_s"),
    "mpc": ("torque_per_nm2", "disturbance_nm_per_sqrt_s"),
}


def _named(pattern: str, allowed: str, words: Sequence[str]) -> AfterValidator:
    def check(text: str) -> str:
        if re.fullmatch(pattern, text) is None:
            like = nearest(text[:64], words)
            hint = f"; the nearest is {like}" if like else ""
            raise ValueError(f"there is nothing of this name; allowed: {allowed}{hint}")
        return text

    return AfterValidator(check)


ModelRef = Annotated[
    str,
    Field(json_schema_extra={"pattern": _MODEL}),
    _named(
        _MODEL, f"{IN_SERVICE}, {NOMINAL} (of the line's file), or the accepted model's hash", (IN_SERVICE, NOMINAL)
    ),
]
ControllerRef = Annotated[
    str,
    Field(json_schema_extra={"pattern": _CONTROLLER}),
    _named(_CONTROLLER, f'{IN_SERVICE}, or an earlier call such as "{OF_A_CALL}1"', (IN_SERVICE, f"{OF_A_CALL}1")),
]
RecordingRef = Annotated[
    str,
    Field(json_schema_extra={"pattern": _RECORDING}),
    _named(_RECORDING, f'{NEWEST}, or its number as text, such as "2": 1 is the newest', (NEWEST,)),
]
Factor = Annotated[float, Field(ge=LEAST_FACTOR, le=MOST_FACTOR)]


class Simulate(Strict):
    """A controller on a model, through one of the line's two scenarios."""

    call: Literal["simulate"]
    controller: ControllerRef = IN_SERVICE
    model: ModelRef = IN_SERVICE
    scenario: ScenarioName = "tension-step"
    plants: Annotated[int, Field(ge=0, le=8)] = 0  #: more, drawn from what the model leaves open


class Identify(Strict):
    """Physics from recordings: parameters with intervals, and how they do on data that they were not made from."""

    call: Literal["identify"]
    recordings: Annotated[list[RecordingRef], Field(min_length=1, max_length=3)] = [NEWEST]

    @model_validator(mode="after")
    def _check(self) -> Self:
        _once("recordings", self.recordings)
        return self


class Design(Strict):
    """One architecture, its knobs turned by factors from where it begins."""

    call: Literal["design"]
    architecture: ArchitectureName
    model: ModelRef = IN_SERVICE
    knobs: dict[str, Factor] = {}  #: factors by name; what is not named stays

    @model_validator(mode="after")
    def _check(self) -> Self:
        known = KNOBS[self.architecture]
        for name in self.knobs:
            if name not in known:
                like = nearest(name[:64], known)
                hint = f"; the nearest is {like}" if like else ""
                raise ValueError(
                    f"knobs.{printable(name)[:64]}: {self.architecture} has no such knob; allowed: "
                    f"{', '.join(known)}{hint}"
                )
        return self


class Tune(Strict):
    """Algorithm 1 with few turns, by the search that needs nobody. (Predictive control takes too long for it.)"""

    call: Literal["tune"]
    architecture: Literal["pid", "lqr", "lqi", "lqg"]
    model: ModelRef = IN_SERVICE
    iterations: Annotated[int, Field(ge=1, le=8)] = 4


class Margins(Strict):
    """How far a loop is from trouble, on a model."""

    call: Literal["margins"]
    controller: ControllerRef = IN_SERVICE
    model: ModelRef = IN_SERVICE


class Spectrum(Strict):
    """What swings in a channel of a recording, and which roller's turning it matches."""

    call: Literal["spectrum"]
    channel: Channel
    index: Annotated[int, Field(ge=1, le=60)]  #: of the span, or of the roller
    recording: RecordingRef = NEWEST
    model: ModelRef = IN_SERVICE  #: whose radii tell the turns


class Compare(Strict):
    """Controllers in the same scenario, or models on the same recording."""

    call: Literal["compare"]
    controllers: Annotated[list[ControllerRef], Field(max_length=5)] = []
    scenario: ScenarioName = "tension-step"  #: of controllers
    model: ModelRef = IN_SERVICE  #: of controllers
    models: Annotated[list[ModelRef], Field(max_length=2)] = []
    recording: RecordingRef = NEWEST  #: of models

    @model_validator(mode="after")
    def _check(self) -> Self:
        if (len(self.controllers) >= 2) is (len(self.models) == 2) or (self.controllers and self.models):
            raise ValueError(
                f"it names {len(self.controllers)} controllers and {len(self.models)} models; allowed: two to five "
                "controllers and no models, or two models and no controllers"
            )
        _once("controllers", self.controllers)
        _once("models", self.models)
        return self


Call = Annotated[
    Simulate | Identify | Design | Tune | Margins | Spectrum | Compare,
    Field(discriminator="call"),
]
AnyCall = Simulate | Identify | Design | Tune | Margins | Spectrum | Compare
CALLS: dict[str, type[AnyCall]] = {
    get_args(one.model_fields["call"].annotation)[0]: one
    for one in (Simulate, Identify, Design, Tune, Margins, Spectrum, Compare)
}


class CallRefused(Exception):
    """It is not carried out; `reasons` are all of them."""

    def __init__(self, reasons: Sequence[str]) -> None:
        super().__init__("; ".join(reasons))
        self.reasons = list(reasons)


def parse_call(document: Any) -> AnyCall:
    """The call that `document` (parsed JSON) is. Raises CallRefused with every reason."""
    if not isinstance(document, dict):
        raise CallRefused(['it is no object; allowed: one with the key "call" and that call\'s inputs'])
    call = cast(dict[str, Any], document)
    size = size_of(call)
    if size is None:
        raise CallRefused(["it is no JSON: numbers must be finite, and text whole characters"])
    if size > MOST_BYTES:
        raise CallRefused([f"it has {size} bytes; allowed: {MOST_BYTES}: things are named here, not given"])
    kind = call.get("call")
    if not isinstance(kind, str) or kind not in CALLS:
        raise CallRefused([_no_such_call(kind)])
    try:
        return CALLS[kind].model_validate(call)
    except ValidationError as error:
        raise CallRefused(problems(error, CALLS[kind])) from error


def size_of(document: Any) -> int | None:
    """Bytes as JSON; None where it is none: numbers without end, halves of characters."""
    try:
        return len(json.dumps(document, allow_nan=False, ensure_ascii=False).encode())
    except (ValueError, TypeError, RecursionError):
        return None


def _no_such_call(kind: Any) -> str:
    named = "is missing" if kind is None else f"is {printable(str(kind))[:64]}, which is not computed here"
    like = nearest(str(kind)[:64], CALLS)
    hint = f"; the nearest is {like}" if like else ""
    return f"call {named}; allowed: {', '.join(CALLS)}{hint}"


def _once(what: str, names: Sequence[str]) -> None:
    if twice := sorted({name for name in names if names.count(name) > 1}):
        raise ValueError(f"{what} has {', '.join(twice)} twice; allowed: each once")
