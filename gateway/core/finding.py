"""What was found, as data: a code and the numbers that belong to it. Sentences are made of it for people, in `wording`.

A code, once published, never changes its meaning. Names of parameters carry their unit, in SI.
"""

from math import isfinite
from typing import Annotated

from pydantic import Field

from gateway.core.line import Strict

MOST_PARAMETERS = 16
LONGEST_PARAMETER = 200  #: characters

Code = Annotated[str, Field(pattern=r"^[a-z][a-z0-9-]{0,59}$")]
Value = int | float | Annotated[str, Field(max_length=LONGEST_PARAMETER)]


class Finding(Strict):
    """A rule that is not met, an alarm, or a refusal."""

    code: Code
    #: By name. A number that is none, or without end, is "nan", "inf" or "-inf": JSON has no other way to say it.
    parameters: Annotated[dict[str, Value], Field(max_length=MOST_PARAMETERS)] = {}


def finding(code: str, **parameters: float | str) -> Finding:
    """A finding of these parameters; a text that is too long is cut."""
    return Finding(code=code, parameters={name: _value(value) for name, value in parameters.items()})


def _value(value: float | str) -> Value:
    if isinstance(value, str):
        return value[:LONGEST_PARAMETER].encode("utf-8", "replace").decode("utf-8")  # a lone surrogate is no text
    if isinstance(value, int) and not isinstance(value, bool):
        return value
    number = float(value)  # of numpy, too
    return number if isfinite(number) else str(number)
