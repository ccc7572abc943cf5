"""PLANT.toml: the truth of a simulated line. Strict, frozen, SI; every mistake is named at once."""

import difflib
import os
import tomllib
from collections.abc import Sequence
from math import isfinite
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import BaseModel, Field, ValidationError
from pydantic_core import ErrorDetails

from sim_plant.physics import WebParameters
from sim_plant.plant_effects import Effects, Lag, effects_rules
from sim_plant.plant_fields import (
    ALLOWED_FORMS,
    FORMS,
    NonNegative,
    NonNegativeEach,
    NumberEach,
    Positive,
    PositiveEach,
    SpeedRamp,
    Strict,
    each,
)
from sim_plant.plant_wires import Wires, wires_rules

_MAX_SPANS = 60


class PlantRefused(Exception):
    """A plant file that is not used. `reasons` name key, value and what is allowed, one mistake each."""

    def __init__(self, path: Path, reasons: list[str]) -> None:
        super().__init__(f"{path}: " + "; ".join(reasons))
        self.path = path
        self.reasons = reasons


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
    """What readings suffer; `effects_sensors` has the equation."""

    tension_noise_n: NonNegative = 0.1  #: standard deviation
    speed_noise_m_per_s: NonNegative = 1e-4  #: standard deviation
    tension_corner_hz: Positive | None = None  #: of the load cells' low pass; absent: none
    tension_zero_n: NumberEach = 0.0  #: reading without tension
    tension_zero_per_n: NumberEach = 0.0  #: by how much the zero moves per N of tension
    tension_drift_n_per_s: NumberEach = 0.0
    tension_walk_n_per_sqrt_s: NonNegativeEach = 0.0  #: spread of the random walk after 1 s
    tension_step_n: NonNegative = 0.0  #: quantisation; 0: none
    speed_step_m_per_s: NonNegative = 0.0  #: quantisation; 0: none

    @property
    def load_cells_are_ideal(self) -> bool:
        """Whether load cells show tension and noise, and nothing else."""
        shifts = (self.tension_zero_n, self.tension_zero_per_n, self.tension_drift_n_per_s)
        amounts = (*shifts, self.tension_walk_n_per_sqrt_s, self.tension_step_n)
        return self.tension_corner_hz is None and not any(np.any(amount) for amount in amounts)


class Drives(Strict):
    rated_torque_nm: Positive = 60.0
    max_torque_nm: Positive = 60.0  #: the drive gives no more, whatever is asked
    torque_rate_nm_per_s: Positive | None = None  #: how fast the drive's torque moves; absent: at once
    torque_lag_s: Lag = 0.0  #: time constant of the torque behind its command
    torque_step_nm: NonNegative = 0.0  #: quantisation of the torque; 0: none


class Plc(Strict):
    speed_ramp_m_per_s2: SpeedRamp = "step"  #: how fast v0 follows its request
    speed_interpolation_s: NonNegative = 0.0  #: in which v0 goes straight to each new request; 0: not at all


class RecorderLimits(Strict):
    """By what the recorder counts unsafe events."""

    torque_nm: Positive = 60.0
    torque_rate_nm_per_s: Positive = 1000.0
    tension_min_n: NonNegative = 2.0
    tension_max_n: Positive = 60.0
    time_tolerance_s: NonNegative = 0.001  #: by which the interval between two SYNCs may be misjudged on a wire


class Plant(Strict):
    format: Literal[1]
    name: Annotated[str, Field(pattern=r"^[a-z0-9]([a-z0-9-]{0,30}[a-z0-9])?$")]
    spans: Annotated[int, Field(ge=1, le=_MAX_SPANS)]
    web: Web
    rollers: Rollers
    sensors: Sensors = Sensors()
    drives: Drives = Drives()
    plc: Plc = Plc()
    effects: Effects = Effects()
    recorder: RecorderLimits = RecorderLimits()
    wires: Wires = Wires()

    @property
    def is_plain(self) -> bool:
        """Whether the paper's two equations are the whole truth of this line."""
        return not self.effects.any and self.drives.torque_lag_s == 0.0 and self.drives.torque_step_nm == 0.0

    def parameters(self) -> WebParameters:
        """The parameters of the equations, one entry per span or roller."""
        web, rollers = self.web, self.rollers
        return WebParameters(
            stiffness_n=each(web.stiffness_n, self.spans),
            length_m=each(web.length_m, self.spans),
            radius_m=each(rollers.radius_m, self.spans),
            inertia_kg_m2=each(rollers.inertia_kg_m2, self.spans),
            friction_nms_per_rad=each(rollers.friction_nms_per_rad, self.spans),
            disturbance_m_per_s2=each(rollers.disturbance_m_per_s2, self.spans),
            tension_before_n=web.tension_before_n,
            tension_after_n=web.tension_after_n,
        )


MOST_BYTES = 1_000_000  #: of a file


def load_plant(path: Path | str) -> Plant:
    """The plant of a file. Raises PlantRefused with every reason, OSError when the file cannot be read."""
    path = Path(path)
    try:
        document = tomllib.loads(_text_of(path))
    except (ValueError, RecursionError) as error:
        raise PlantRefused(path, [f"not a TOML file: {error}"]) from error
    return plant_of(document, path)


def _text_of(path: Path) -> str:
    """The text of a regular file of at most `MOST_BYTES`. Raises OSError, ValueError."""
    if not path.is_file() and os.path.exists(path) and not path.is_dir():  # a pipe would be waited for
        raise ValueError("it is a pipe, a socket or a device")
    with path.open("rb") as stream:
        content = stream.read(MOST_BYTES + 1)
    if len(content) > MOST_BYTES:
        raise ValueError(f"it has more than {MOST_BYTES / 1e6:g} MB")
    return content.decode("utf-8-sig")


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
    key = _dotted([part for part in mistake["loc"] if part not in FORMS])
    value, message = mistake["input"], mistake["msg"]
    if mistake["type"] == "missing":
        return f"{key}: this key is required"
    if mistake["type"] == "union_tag_invalid":
        return f"{key}: is {value!r}, should be {ALLOWED_FORMS[str(mistake.get('ctx', {}).get('expected_tags'))]}"
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
        f"{name}.{key}: has {len(value)} entries; give one number, or a list of {spans} (spans = {spans})"
        for name, table in _tables_with_lists(document)
        for key, value in table.items()
        if isinstance(value, list) and len(value) != spans
    ]
    limits = _table(document, "recorder")
    low = limits.get("tension_min_n", RecorderLimits().tension_min_n)
    high = limits.get("tension_max_n", RecorderLimits().tension_max_n)
    if _number(low) and _number(high) and low >= high:
        reasons.append(f"recorder.tension_min_n: is {low}, must be below tension_max_n = {high}")
    reasons += effects_rules(_table(document, "effects"), spans)
    reasons += wires_rules(_table(document, "wires"), spans)
    return reasons


def _tables_with_lists(document: dict[str, Any]) -> list[tuple[str, dict[str, Any]]]:
    """Names and tables in which a parameter may be a list with one entry per span or roller."""
    tables = [(name, _table(document, name)) for name in ("web", "rollers", "sensors")]
    effects = _table(document, "effects")
    return tables + [(f"effects.{name}", _table(effects, name)) for name in Effects.model_fields]


def _table(document: dict[str, Any], key: str) -> dict[str, Any]:
    value = document.get(key)
    return value if isinstance(value, dict) else {}


def _number(value: Any) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool) and isfinite(value)
