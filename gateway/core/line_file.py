"""From the text of `line.toml` to a `Line`, or to every problem at once, each with its line in the file."""

import tomllib
from collections.abc import Mapping, Sequence
from copy import deepcopy
from dataclasses import dataclass
from typing import Any

from pydantic import TypeAdapter, ValidationError
from pydantic_core import ErrorDetails

from gateway.core.line import Line
from gateway.core.line_checks import Role, findings
from gateway.core.line_problem import Finding, LineRefused, Problem, key_in_words, value_in_words
from gateway.core.line_words import finding_of, nearest_key, path_of, value_at
from gateway.core.nearest import is_typo, nearest
from gateway.core.toml_places import Path, line_of, places
from gateway.core.toml_syntax import syntax_problem

_FIELDS: dict[str, TypeAdapter[Any]] = {
    name: TypeAdapter(field.rebuild_annotation()) for name, field in Line.model_fields.items()
}


@dataclass(frozen=True, slots=True)
class CheckedLine:
    """A valid line description, and what is odd about it."""

    line: Line
    warnings: list[Problem]


def load_line(
    text: str,
    source: str,
    known_maps: Mapping[str, Role] | None = None,
    unusable_maps: Mapping[str, Sequence[Problem]] | None = None,
) -> Line:
    """The line that `text` describes. Raises LineRefused with every problem.

    `source` is the file's name in messages. `known_maps` gives protocol and role of each device type; without
    it map names are not checked. `unusable_maps` gives the reasons why a map that is there cannot be used.
    """
    return check_line(text, source, known_maps, unusable_maps).line


def check_line(
    text: str,
    source: str,
    known_maps: Mapping[str, Role] | None = None,
    unusable_maps: Mapping[str, Sequence[Problem]] | None = None,
) -> CheckedLine:
    """As `load_line`, with the warnings."""
    text = text.removeprefix("\ufeff").replace("\r\n", "\n")
    try:
        document = tomllib.loads(text)
        where = places(text)
    except (ValueError, RecursionError) as error:
        raise LineRefused([syntax_problem(error, text, source)]) from None
    found, valid, names = _validate(document)
    line = Line.model_construct(**valid) if found else Line.model_validate(document)
    found += findings(line, set(valid), known_maps, unusable_maps or {})
    in_file_order = sorted(
        ((finding, _problem(finding, source, document, where, names, line)) for finding in found),
        key=lambda pair: pair[1].line,
    )
    errors = [problem for finding, problem in in_file_order if finding.severity == "error"]
    if errors:
        raise LineRefused(errors)
    return CheckedLine(line, [problem for _, problem in in_file_order])


# A mistyped key would hide what stands under it, and make the key that was meant look missing. So the document is
# read on as it was probably meant; what was mended stays an error and is named as it stands in the file.


@dataclass(slots=True)
class _Mended:
    """A copy of the document with mistyped keys put right, and how they are spelled in the file."""

    document: dict[str, Any]
    names: dict[Path, str]
    found: list[Finding]

    def rename(self, path: Path, key: str) -> None:
        table = value_at(self.document, path[:-1])
        table[key] = table.pop(path[-1])
        self.names[(*path[:-1], key)] = str(path[-1])


def _validate(document: dict[str, Any]) -> tuple[list[Finding], dict[str, Any], dict[Path, str]]:
    """Findings about single values, the tables without such, and the file's spelling of mistyped keys."""
    mended = _Mended(deepcopy(document), {}, [])
    errors = _errors(mended.document)
    while any([_mend(error, mended) for error in errors]):
        errors = _errors(mended.document)
    found = mended.found + [finding_of(error, mended.document) for error in errors]
    failed = {error["loc"][0] for error in errors}
    valid = {
        name: adapter.validate_python(mended.document[name]) if name in mended.document else _default(name)
        for name, adapter in _FIELDS.items()
        if name not in failed
    }
    return found, valid, mended.names


def _default(name: str) -> Any:
    return Line.model_fields[name].get_default(call_default_factory=True)


def _errors(document: dict[str, Any]) -> list[ErrorDetails]:
    try:
        Line.model_validate(document)
    except ValidationError as error:
        return error.errors(include_url=False)
    return []


def _mend(error: ErrorDetails, mended: _Mended) -> bool:
    """Note an unknown key and take it out of the way. False if the error is of another kind."""
    path = path_of(error)
    if error["type"] == "extra_forbidden":
        _mend_key(error, path, mended)
        return True
    if error["type"] == "union_tag_not_found":
        table: dict[str, Any] = value_at(mended.document, path)
        mistyped = next((key for key in table if is_typo(key, "protocol")), None)
        if mistyped is not None:
            mended.found.append(Finding((*path, mistyped), "there is no such key", nearest="protocol"))
            mended.rename((*path, mistyped), "protocol")
            return True
    if error["type"] == "union_tag_invalid":
        return _mend_protocol(error, path, mended)
    return False


def _mend_key(error: ErrorDetails, path: Path, mended: _Mended) -> None:
    mended.found.append(_in_file_words(finding_of(error, mended.document), mended.names))
    table: dict[str, Any] = value_at(mended.document, path[:-1])
    meant = nearest_key(path, mended.document)
    if meant and meant not in table and is_typo(str(path[-1]), meant):
        mended.rename(path, meant)
    else:
        table.pop(str(path[-1]))


def _mend_protocol(error: ErrorDetails, path: Path, mended: _Mended) -> bool:
    finding = finding_of(error, mended.document)
    table: dict[str, Any] = value_at(mended.document, path)
    meant = nearest(str(table["protocol"]), ("canopen", "modbus-tcp"))
    if not meant:
        return False
    mended.found.append(_in_file_words(finding, mended.names))
    table["protocol"] = meant
    return True


def _in_file_words(finding: Finding, names: Mapping[Path, str]) -> Finding:
    return Finding(_as_written(finding.path, names), finding.wrong, finding.allowed, finding.nearest, finding.severity)


def _as_written(path: Path, names: Mapping[Path, str]) -> Path:
    return tuple(names.get(path[: depth + 1], part) for depth, part in enumerate(path))


def _problem(
    finding: Finding, source: str, document: dict[str, Any], where: dict[Path, int], names: dict[Path, str], line: Line
) -> Problem:
    path = _as_written(finding.path, names)
    value = value_in_words(value_at(document, path))
    if not value:
        default = _default_at(line, finding.path)
        value = f"{value_in_words(default)} (the default)" if isinstance(default, int | float | str) else ""
    return Problem(
        source, line_of(where, path), key_in_words(path), value, finding.wrong, finding.allowed, finding.nearest
    )


def _default_at(line: Line, path: Path) -> Any:
    """The value that a key got without standing in the file, None if it got none."""
    value: Any = line
    for part in path:
        try:
            value = value[part] if isinstance(part, int) else getattr(value, part)
        except (AttributeError, IndexError, TypeError):
            return None
    return value
