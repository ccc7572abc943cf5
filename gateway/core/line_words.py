"""pydantic's errors in the words of the person who wrote the file: what is wrong, and what is allowed in which unit.

What is allowed is read from the model's JSON schema, so that it is said in one place only: `line.py`.
"""

import re
from collections.abc import Callable
from typing import Any

from pydantic_core import ErrorDetails

from gateway.core.line import Line
from gateway.core.line_problem import Finding
from gateway.core.nearest import nearest
from gateway.core.toml_places import Path

Schema = dict[str, Any]
_SCHEMA: Schema = Line.model_json_schema()

#: Longest ending first.
_UNITS = {
    "_nms_per_rad": "Nm s/rad",
    "_bit_per_s": "bit/s",
    "_nm_per_s": "Nm/s",
    "_m_per_s2": "m/s2",
    "_n_per_s": "N/s",
    "_m_per_s": "m/s",
    "_kg_m2": "kg m2",
    "_nm": "Nm",
    "_n": "N",
    "_m": "m",
    "_s": "s",
}
_NAME = "lower-case letters, digits and hyphens, at most 32 characters, with a letter or digit at either end"


def path_of(error: ErrorDetails) -> Path:
    """The path in the file: pydantic puts the protocol of a bus behind its index."""
    location = error["loc"]
    return location[:2] + location[3:] if location[0] == "buses" else location


def finding_of(error: ErrorDetails, document: dict[str, Any]) -> Finding:
    """The finding for an error of `Line.model_validate(document)`."""
    path = path_of(error)
    kind = error["type"]
    if kind == "extra_forbidden":
        return _unknown_key(path, document)
    if kind.startswith("union_tag"):
        path = (*path, "protocol")
        kind = "missing" if kind == "union_tag_not_found" else "literal_error"
    value = value_at(document, path)
    schema = schema_at(path, document)
    wrong = _WRONG.get(kind, _other)(value, schema)
    if path == ("format",) and kind == "less_than_equal":
        wrong = "is a newer format than this program knows"
    return Finding(path, wrong, allowed_in_words(schema, path), _nearest_value(kind, value, schema))


def _unknown_key(path: Path, document: dict[str, Any]) -> Finding:
    known = known_keys(path[:-1], document)
    return Finding(path, "there is no such key", "one of " + ", ".join(known), nearest_key(path, document))


def nearest_key(path: Path, document: dict[str, Any]) -> str:
    """The known key most like the unknown one at `path`; of equally near ones, one that the table still lacks."""
    table = value_at(document, path[:-1])
    lacking_first = sorted(known_keys(path[:-1], document), key=lambda key: key in table)
    return nearest(str(path[-1]), lacking_first)


def known_keys(path: Path, document: dict[str, Any]) -> list[str]:
    """The keys that the table at `path` may have."""
    return list(schema_at(path, document).get("properties", {}))


def _other(value: Any, schema: Schema) -> str:
    return "is not what belongs here"


def _wrong_kind(value: Any, schema: Schema) -> str:
    return f"is {_kind_of(value, schema)}"


def _kind_of(value: Any, schema: Schema) -> str:
    expected = schema.get("type")
    if isinstance(value, bool):
        return "true or false"
    if isinstance(value, str):
        number = re.fullmatch(r"\s*[-+.\d][\d_.eE+-]*\s*", value)
        return "text, not a number (remove the quotes)" if number and expected in ("number", "integer") else "text"
    if isinstance(value, int):
        return "a number too large to compute with" if expected in ("number", "integer") else "a number"
    if isinstance(value, float):
        return "not a whole number" if expected == "integer" else "a number"
    if isinstance(value, list):
        return "a list"
    return "a table" if isinstance(value, dict) else "a date or time"


_WRONG: dict[str, Callable[[Any, Schema], str]] = {
    "missing": lambda value, schema: "is missing",
    "float_type": _wrong_kind,
    "int_type": _wrong_kind,
    "int_parsing_size": _wrong_kind,
    "string_type": _wrong_kind,
    "list_type": _wrong_kind,
    "model_type": _wrong_kind,
    "model_attributes_type": _wrong_kind,
    "finite_number": lambda value, schema: "is not a finite number",
    "greater_than": lambda value, schema: "is too small",
    "greater_than_equal": lambda value, schema: "is too small",
    "less_than": lambda value, schema: "is too large",
    "less_than_equal": lambda value, schema: "is too large",
    "literal_error": lambda value, schema: "is none of the choices",
    "string_pattern_mismatch": lambda value, schema: "is no valid name",
    "too_short": lambda value, schema: "is empty",
    "too_long": lambda value, schema: f"has {len(value)} entries, too many",
}

#: Every error type of pydantic that `Line` can cause: a test holds this against what it does cause.
TRANSLATED = {*_WRONG, "extra_forbidden", "union_tag_invalid", "union_tag_not_found"}


def _nearest_value(kind: str, value: Any, schema: Schema) -> str:
    if not isinstance(value, str):
        return ""
    if kind == "literal_error":
        like = nearest(value, [choice for choice in schema.get("enum", ()) if isinstance(choice, str)])
        return f'"{like}"' if like else ""
    if kind == "string_pattern_mismatch":
        name = re.sub(r"[^a-z0-9]+", "-", value.lower()).strip("-")[:32].strip("-")
        return f'"{name}"' if name else ""
    return ""


def value_at(document: Any, path: Path) -> Any:
    """What stands at `path`, None if nothing does."""
    value = document
    for part in path:
        if isinstance(value, str):  # which has elements, too
            return None
        try:
            value = value[part]
        except (IndexError, KeyError, TypeError):
            return None
    return value


def schema_at(path: Path, document: Any) -> Schema:
    """The schema node of `path`; the kind of a bus is taken from the document. {} where there is none."""
    node = _SCHEMA
    for depth, part in enumerate(path):
        node = node.get("items", {}) if isinstance(part, int) else node.get("properties", {}).get(part, {})
        node = _resolve(node, value_at(document, path[: depth + 1]))
    return node


def _resolve(node: Schema, value: Any) -> Schema:
    if "discriminator" in node:
        return _resolve_bus(node, value)
    if "anyOf" in node:
        return _resolve(node["anyOf"][0], value)  # "or nothing", which TOML cannot say
    return _SCHEMA["$defs"][node["$ref"].rsplit("/", 1)[1]] if "$ref" in node else node


def _resolve_bus(node: Schema, value: Any) -> Schema:
    kinds: dict[str, str] = node["discriminator"]["mapping"]
    protocol = value_at(value, ("protocol",))
    if isinstance(protocol, str) and protocol in kinds:
        return _resolve({"$ref": kinds[protocol]}, value)
    return {"type": "object", "properties": {"protocol": {"type": "string", "enum": list(kinds)}}}


def allowed_in_words(schema: Schema, path: Path) -> str:
    """What may stand at a schema node, in plain words with the unit that the key's name carries."""
    kind = schema.get("type")
    if "enum" in schema:
        words = ", ".join(f'"{choice}"' if isinstance(choice, str) else str(choice) for choice in schema["enum"])
        return _with_unit(words, path)
    if kind in ("number", "integer"):
        return _with_unit(_range_in_words("a whole number" if kind == "integer" else "a number", schema), path)
    if kind == "string":
        return _NAME if "pattern" in schema else "text in quotes"
    if kind == "array":
        return _list_in_words(schema, path)
    if set(schema.get("properties", ())) == {"value", "tolerance"}:
        return _with_unit("{ value = a number above 0, tolerance = a fraction above 0 and below 1 }, value in", path)
    return f"a table, headed [{path[-1]}] or in braces" if len(path) == 1 else "a table"


def _range_in_words(noun: str, schema: Schema) -> str:
    low, above = schema.get("minimum"), schema.get("exclusiveMinimum")
    high, below = schema.get("maximum"), schema.get("exclusiveMaximum")
    if low is not None and high is not None:
        return f"{low:g}" if low == high else f"{noun} from {low:g} to {high:g}"
    words = f"{noun} above {above:g}" if above is not None else noun
    words = f"{noun}, {low:g} or more" if low is not None else words
    words = f"{words} up to {high:g}" if high is not None else words
    return f"{words} and below {below:g}" if below is not None else words


def _list_in_words(schema: Schema, path: Path) -> str:
    if schema["items"].get("type") == "number":
        return _with_unit("a list [ ... ] of numbers above 0, one per span, in", path)
    most = f" to {schema['maxItems']}" if "maxItems" in schema else " or more"
    count = f"{schema.get('minItems', 0)}{most}"
    if schema["items"].get("type") == "string":
        return f"a list [ ... ] of {count} texts in quotes"
    return f"{count} tables, each headed [[{path[-1]}]]"


def name_and_unit(key: str) -> tuple[str, str]:
    """("torque", "Nm") of "torque_nm"; no unit where the key has none."""
    ending, unit = next(((ending, unit) for ending, unit in _UNITS.items() if key.endswith(ending)), ("", ""))
    return key.removesuffix(ending), unit


def _with_unit(words: str, path: Path) -> str:
    """`words` with the unit of the innermost key that names one; a tolerance has none."""
    if path[-1] == "tolerance":
        return f"{words}, a fraction: 0.3 means 30 % either way"
    keys = [part for part in path if isinstance(part, str) and part != "value"]
    _, unit = name_and_unit(keys[-1])
    return f"{words} {unit}".rstrip() if unit else words.removesuffix(", value in").removesuffix(", in")
