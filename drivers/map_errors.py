"""Why a device map is refused, in words for a person: where, what is wrong, what is allowed, the nearest."""

from types import UnionType
from typing import Any, Union, get_args, get_origin

from pydantic import BaseModel

from gateway.core.nearest import nearest


class MapRefused(ValueError):
    """A map that cannot be used. `reasons` name file, key, what is wrong, what is allowed and the nearest."""

    def __init__(self, reasons: list[str]) -> None:
        super().__init__("; ".join(reasons))
        self.reasons = reasons


def reasons_of(model: type[BaseModel], error: Any) -> list[str]:
    """One pydantic error as what is wrong, where, what is allowed and the nearest."""
    key = ".".join(str(part) for part in error["loc"])
    if error["type"] == "value_error":
        prefix = f"{key}." if key else ""
        return [prefix + line for line in str(error["ctx"]["error"]).splitlines()]
    if error["type"] == "extra_forbidden":
        return [f"{key}: unknown key; {_nearest(str(error['loc'][-1]), _keys_at(model, error['loc'][:-1]))}"]
    if error["type"] == "missing":
        return [f"{key}: is missing"]
    if error["type"] == "literal_error":
        allowed = [word.strip("'") for word in error["ctx"]["expected"].replace(" or ", ", ").split(", ")]
        return [f"{key}: {error['input']!r}; {_nearest(str(error['input']), allowed)}"]
    return [f"{key}: {error['input']!r}: {error['msg'].lower()}"]


def _nearest(given: str, allowed: list[str]) -> str:
    near = nearest(given, allowed)
    return f"allowed: {', '.join(allowed)}" + (f"; did you mean {near!r}?" if near else "")


def _keys_at(model: type[BaseModel], location: tuple[int | str, ...]) -> list[str]:
    """The keys that are known at a place in a map."""
    for part in location:
        annotation = model.model_fields[str(part)].annotation
        if get_origin(annotation) in (Union, UnionType):
            annotation = next(choice for choice in get_args(annotation) if choice is not type(None))
        assert isinstance(annotation, type) and issubclass(annotation, BaseModel)
        model = annotation
    return list(model.model_fields)
