"""PLANT.toml: the truth of a simulated line. Strict, frozen, SI; every mistake is named at once."""

import difflib
import tomllib
from collections.abc import Sequence
from math import isfinite
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import AfterValidator, BaseModel, ConfigDict, Discriminator, Field, Tag, ValidationError
from pydantic_core import ErrorDetails, PydanticCustomError

from sim_plant.physics import FloatArray, WebParameters

_MAX_SPANS = 60

Positive = Annotated[float, Field(gt=0.0)]
NonNegative = Annotated[float, Field(ge=0.0)]


def _port(value: int) -> int:
    if not 1 <= value <= 65535:
        raise PydanticCustomError("port", "should be a port: 1 to 65535")
    return value


Port = Annotated[int, AfterValidator(_port), Field(json_schema_extra={"minimum": 1, "maximum": 65535})]
Unit = Annotated[int, Field(ge=1, le=247)]


_FORMS = ("(number)", "(list)", "(word)")


def _form(value: Any) -> str:
    """Which form of a value is meant, so that a mistake is told of that form alone."""
    return "(list)" if isinstance(value, list) else "(word)" if isinstance(value, str) else "(number)"


_ALLOWED_FORMS = {
    "'(number)', '(list)'": "a number, or a list with one number each",
    "'(number)', '(word)'": "a number or 'step'",
}

#: A parameter: one number for all rollers (spans), or a list with one number each.
PositiveEach = Annotated[
    Annotated[Positive, Tag("(number)")] | Annotated[list[Positive], Tag("(list)")], Discriminator(_form)
]
NonNegativeEach = Annotated[
    Annotated[NonNegative, Tag("(number)")] | Annotated[list[NonNegative], Tag("(list)")], Discriminator(_form)
]
SpeedRamp = Annotated[
    Annotated[Positive, Tag("(number)")] | Annotated[Literal["step"], Tag("(word)")], Discriminator(_form)
]


class PlantRefused(Exception):
    """A plant file that is not used. `reasons` name key, value and what is allowed, one mistake each."""

    def __init__(self, path: Path, reasons: list[str]) -> None:
        super().__init__(f"{path}: " + "; ".join(reasons))
        self.path = path
        self.reasons = reasons


class Strict(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True, strict=True, allow_inf_nan=False)


class Web(Strict):
    """The spans, and the tension at either end of the line."""

    stiffness_n: PositiveEach  #: E A
    length_m: PositiveEach  #: L_i
    tension_before_n: NonNegative = 0.0  #: T_0
    tension_after_n: NonNegative = 0.0  #: T_{n+1}


class Rollers(Strict):
    radius_m: PositiveEach  #: R_i
    inertia_kg_m2: PositiveEach  #: J_i
    friction_nms_per_rad: NonNegativeEach  #: f_i
    disturbance_m_per_s2: NonNegativeEach = 5e-2  #: b_i; b xi is held for 1 ms, xi ~ N(0, 1)


class Sensors(Strict):
    """Standard deviation of the noise of a reading."""

    tension_noise_n: NonNegative = 0.1
    speed_noise_m_per_s: NonNegative = 1e-4


class Drives(Strict):
    rated_torque_nm: Positive = 60.0
    max_torque_nm: Positive = 60.0  #: the drive gives no more, whatever is asked
    torque_rate_nm_per_s: Positive | None = None  #: how fast the drive's torque moves; absent: at once


class Plc(Strict):
    speed_ramp_m_per_s2: SpeedRamp = "step"  #: how fast v0 follows its request


class RecorderLimits(Strict):
    """By what the recorder counts unsafe events."""

    torque_nm: Positive = 60.0
    torque_rate_nm_per_s: Positive = 1000.0
    tension_min_n: NonNegative = 2.0
    tension_max_n: Positive = 60.0
    time_tolerance_s: NonNegative = 0.001  #: by which the interval between two SYNCs may be misjudged on a wire


class Canopen(Strict):
    interface: Literal["udp_multicast", "virtual", "socketcan"] = "udp_multicast"
    channel: str = "239.74.163.2"
    port: Port = 43113  #: udp_multicast only
    first_node: Annotated[int, Field(ge=1, le=127)] = 1  #: node of the drive of roller 1


class Modbus(Strict):
    host: str = "127.0.0.1"
    port: Port = 5020
    amplifier_unit: Unit = 1
    plc_unit: Unit = 2


class Wires(Strict):
    canopen: Canopen = Canopen()
    modbus: Modbus = Modbus()


class Plant(Strict):
    format: Literal[1]
    name: Annotated[str, Field(pattern=r"^[a-z0-9]([a-z0-9-]{0,30}[a-z0-9])?$")]
    spans: Annotated[int, Field(ge=1, le=_MAX_SPANS)]
    web: Web
    rollers: Rollers
    sensors: Sensors = Sensors()
    drives: Drives = Drives()
    plc: Plc = Plc()
    recorder: RecorderLimits = RecorderLimits()
    wires: Wires = Wires()

    def parameters(self) -> WebParameters:
        """The parameters of the equations, one entry per span or roller."""
        web, rollers = self.web, self.rollers
        return WebParameters(
            stiffness_n=self._each(web.stiffness_n),
            length_m=self._each(web.length_m),
            radius_m=self._each(rollers.radius_m),
            inertia_kg_m2=self._each(rollers.inertia_kg_m2),
            friction_nms_per_rad=self._each(rollers.friction_nms_per_rad),
            disturbance_m_per_s2=self._each(rollers.disturbance_m_per_s2),
            tension_before_n=web.tension_before_n,
            tension_after_n=web.tension_after_n,
        )

    def _each(self, value: float | list[float]) -> FloatArray:
        return np.broadcast_to(np.asarray(value, dtype=np.float64), (self.spans,)).copy()


def load_plant(path: Path | str) -> Plant:
    """The plant of a file. Raises PlantRefused with every reason, OSError when the file cannot be read."""
    path = Path(path)
    try:
        document = tomllib.loads(path.read_text(encoding="utf-8"))
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise PlantRefused(path, [f"not a TOML file: {error}"]) from error
    return plant_of(document, path)


def plant_of(document: dict[str, Any], path: Path = Path("PLANT.toml")) -> Plant:
    """The plant of a parsed file; `path` is for the messages. Raises PlantRefused with every reason."""
    reasons = _together(document)
    try:
        plant = Plant.model_validate(document)
    except ValidationError as error:
        raise PlantRefused(path, _single(error) + reasons) from error
    if reasons:
        raise PlantRefused(path, reasons)
    return plant


def _single(error: ValidationError) -> list[str]:
    """What single values break, one sentence each."""
    return [_sentence(mistake) for mistake in error.errors()]


def _sentence(mistake: ErrorDetails) -> str:
    if mistake["type"] == "extra_forbidden":
        return f"{_dotted(mistake['loc'])}: unknown key; {_nearest(mistake['loc'])}"
    key = _dotted([part for part in mistake["loc"] if part not in _FORMS])
    value, message = mistake["input"], mistake["msg"]
    if mistake["type"] == "missing":
        return f"{key}: this key is required"
    if mistake["type"] == "union_tag_invalid":
        return f"{key}: is {value!r}, should be {_ALLOWED_FORMS[str(mistake.get('ctx', {}).get('expected_tags'))]}"
    return f"{key}: is {value!r}, {message[0].lower()}{message[1:]}".replace(", input should", ", should")


def _nearest(keys: Sequence[int | str]) -> str:
    known = list(_model_at(keys[:-1]).model_fields)
    match = difflib.get_close_matches(str(keys[-1]), known, n=1, cutoff=0.5)
    return f"did you mean {match[0]}?" if match else f"allowed here: {', '.join(known)}"


def _model_at(keys: Sequence[int | str]) -> type[BaseModel]:
    model: type[BaseModel] = Plant
    for key in keys:
        inner = model.model_fields[str(key)].annotation
        assert isinstance(inner, type) and issubclass(inner, BaseModel)
        model = inner
    return model


def _dotted(keys: Sequence[int | str]) -> str:
    text = ""
    for key in keys:
        text += f"[{key}]" if isinstance(key, int) else f".{key}" if text else key
    return text


def _together(document: dict[str, Any]) -> list[str]:
    """What values break together. Works on the raw document, so that it is told along with single mistakes."""
    spans = document.get("spans")
    if not isinstance(spans, int) or isinstance(spans, bool) or not 1 <= spans <= _MAX_SPANS:
        return []
    reasons = [
        f"{table}.{key}: has {len(value)} entries; give one number, or a list of {spans} (spans = {spans})"
        for table in ("web", "rollers")
        for key, value in _table(document, table).items()
        if isinstance(value, list) and len(value) != spans
    ]
    limits = _table(document, "recorder")
    low = limits.get("tension_min_n", RecorderLimits().tension_min_n)
    high = limits.get("tension_max_n", RecorderLimits().tension_max_n)
    if _number(low) and _number(high) and low >= high:
        reasons.append(f"recorder.tension_min_n: is {low}, must be below tension_max_n = {high}")
    first = _table(_table(document, "wires"), "canopen").get("first_node", 1)
    if isinstance(first, int) and 1 <= first <= 127 < first + spans - 1:
        reasons.append(f"wires.canopen.first_node: is {first}, at most {128 - spans} for {spans} nodes (1 to 127)")
    return reasons


def _table(document: dict[str, Any], key: str) -> dict[str, Any]:
    value = document.get(key)
    return value if isinstance(value, dict) else {}


def _number(value: Any) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool) and isfinite(value)
