"""Why a device map is refused, in words for a person: where, what is wrong, what is allowed, the nearest."""

from dataclasses import dataclass
from types import UnionType
from typing import Any, Union, get_args, get_origin

from pydantic import BaseModel

from gateway.core.line_problem import Problem, printable
from gateway.core.nearest import nearest
from gateway.core.toml_places import Path

_LONGEST_VALUE = 80  #: characters


class MapRefused(ValueError):
    """A map that cannot be used. `reasons` name file, line, key, what is wrong, what is allowed and the nearest."""

    def __init__(self, problems: list[Problem]) -> None:
        self.problems = problems
        self.reasons = [str(problem) for problem in problems]
        super().__init__("; ".join(self.reasons))


@dataclass(frozen=True, slots=True)
class Reason:
    """What is wrong with a map, before it is tied to a line of the file."""

    path: Path  #: of the key
    words: str  #: begin with the key


def reasons_of(model: type[BaseModel], error: Any) -> list[Reason]:
    """One pydantic error as what is wrong, where, what is allowed and the nearest."""
    path: Path = error["loc"]
    key = printable(".".join(str(part) for part in path))
    if error["type"] == "value_error":
        return [Reason(*_placed(path, text)) for text in str(error["ctx"]["error"]).splitlines()]
    if error["type"] == "extra_forbidden":
        return [Reason(path, f"{key}: unknown key; {_nearest(str(path[-1]), _keys_at(model, path[:-1]))}")]
    if error["type"] == "missing":
        return [Reason(path, f"{key}: is missing")]
    if error["type"] == "literal_error":
        allowed = [word.strip("'") for word in error["ctx"]["expected"].replace(" or ", ", ").split(", ")]
        return [Reason(path, f"{key}: {shown(error['input'])}; {_nearest(str(error['input']), allowed)}")]
    return [Reason(path, f"{key}: {shown(error['input'])}: {error['msg'].lower()}")]


def _placed(path: Path, text: str) -> tuple[Path, str]:
    """The path that a sentence of several fields names, from `path`, and the sentence with all of the path."""
    named, colon, _ = text.partition(":")
    parts: Path = tuple(int(part) if part.isdecimal() else part for part in named.split(".")) if colon else ()
    prefix = "".join(f"{part}." for part in path)
    return (*path, *parts), printable(prefix + text)


def shown(value: Any) -> str:
    """A value on one line, of at most `_LONGEST_VALUE` characters."""
    try:
        words = repr(value)
    except (ValueError, RecursionError):  # a number with thousands of digits
        words = "a value that cannot be shown"
    words = printable(words)
    return words if len(words) <= _LONGEST_VALUE else words[:_LONGEST_VALUE] + "..."


def _nearest(given: str, allowed: list[str]) -> str:
    near = nearest(given[:_LONGEST_VALUE], allowed)
    return f"allowed: {', '.join(allowed)}" + (f"; did you mean {near!r}?" if near else "")


def _keys_at(model: type[BaseModel], location: Path) -> list[str]:
    """The keys that are known at a place in a map; none where any may stand."""
    for part in location:
        field = model.model_fields.get(str(part))
        annotation = None if field is None else field.annotation
        if get_origin(annotation) in (Union, UnionType):
            annotation = next(choice for choice in get_args(annotation) if choice is not type(None))
        if not (isinstance(annotation, type) and issubclass(annotation, BaseModel)):
            return []
        model = annotation
    return list(model.model_fields)
