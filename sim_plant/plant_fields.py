"""What the tables of PLANT.toml are made of: a strict table, and numbers that are checked."""

from typing import Annotated, Any, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import AfterValidator, BaseModel, ConfigDict, Discriminator, Field, Tag
from pydantic_core import PydanticCustomError

Positive = Annotated[float, Field(gt=0.0)]
NonNegative = Annotated[float, Field(ge=0.0)]
Share = Annotated[float, Field(ge=0.0, le=0.1)]  #: a small part of something


def _port(value: int) -> int:
    if not 1 <= value <= 65535:
        raise PydanticCustomError("port", "should be a port: 1 to 65535")
    return value


Port = Annotated[int, AfterValidator(_port), Field(json_schema_extra={"minimum": 1, "maximum": 65535})]
Unit = Annotated[int, Field(ge=1, le=247)]


FORMS = ("(number)", "(list)", "(word)")  #: tags of the forms that a value may have; they are no keys
ALLOWED_FORMS = {
    "'(number)', '(list)'": "a number, or a list with one number each",
    "'(number)', '(word)'": "a number or 'step'",
}


def _form(value: Any) -> str:
    """Which form of a value is meant, so that a mistake is told of that form alone."""
    return "(list)" if isinstance(value, list) else "(word)" if isinstance(value, str) else "(number)"


#: A parameter: one number for all rollers (spans), or a list with one number each.
PositiveEach = Annotated[
    Annotated[Positive, Tag("(number)")] | Annotated[list[Positive], Tag("(list)")], Discriminator(_form)
]
NonNegativeEach = Annotated[
    Annotated[NonNegative, Tag("(number)")] | Annotated[list[NonNegative], Tag("(list)")], Discriminator(_form)
]
ShareEach = Annotated[Annotated[Share, Tag("(number)")] | Annotated[list[Share], Tag("(list)")], Discriminator(_form)]
NumberEach = Annotated[Annotated[float, Tag("(number)")] | Annotated[list[float], Tag("(list)")], Discriminator(_form)]
SpeedRamp = Annotated[
    Annotated[Positive, Tag("(number)")] | Annotated[Literal["step"], Tag("(word)")], Discriminator(_form)
]


class Strict(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True, strict=True, allow_inf_nan=False)


def each(value: float | list[float], n: int) -> NDArray[np.float64]:
    """A parameter as an array of shape (n,). A list must have n entries."""
    return np.broadcast_to(np.asarray(value, dtype=np.float64), (n,)).copy()
