"""What is wrong with a JSON file of this program: each key, its value, what is allowed, and the nearest valid key."""

import json
from collections import Counter
from functools import cache
from itertools import islice
from typing import Any, cast

from pydantic import BaseModel, ValidationError
from pydantic_core import ErrorDetails

from gateway.core.line_problem import key_in_words, printable, value_in_words
from gateway.core.line_words import allowed_in_words
from gateway.core.nearest import nearest

Schema = dict[str, Any]
Path = tuple[str | int, ...]
MOST_TOLD = 40  #: errors of one document
MOST_DEEP = 64  #: objects and lists in one another; no format of this program needs ten

_WRONG = {
    "missing": "is missing",
    "finite_number": "is not a finite number",
    "greater_than": "is too small",
    "greater_than_equal": "is too small",
    "less_than": "is too large",
    "less_than_equal": "is too large",
    "literal_error": "is none of the choices",
    "too_short": "has too few entries",
    "too_long": "has too many entries",
    "string_too_short": "is empty",
    "string_too_long": "is too long",
    "string_pattern_mismatch": "has another form",
}
_KINDS: tuple[tuple[type, str], ...] = (
    (bool, "true or false"), (str, "text"), (int, "a number"), (float, "a number"), (list, "a list"),
    (dict, "an object"), (type(None), "null"),
)  # fmt: skip


class NotJson(Exception):
    """The text is no JSON object; the message says where it ceases to be one."""


def document_of(payload: bytes) -> dict[str, Any]:
    """The JSON object in `payload`. Raises NotJson, also where a key stands twice."""
    try:
        document: Any = json.loads(payload, object_pairs_hook=_once)
    except UnicodeDecodeError:
        raise NotJson("it is no text in UTF-8, so no JSON") from None
    except (ValueError, RecursionError) as error:
        raise NotJson(f"it is no JSON: {printable(str(error))[:200]}") from None
    if not isinstance(document, dict):
        raise NotJson(f"it is {_kind(document)}; allowed: a JSON object {{ ... }}")
    if _is_too_deep(document):  # whatever walks through it, such as what tells its mistakes, calls itself
        raise NotJson(f"objects and lists stand in one another more than {MOST_DEEP} deep")
    return cast(dict[str, Any], document)


def _is_too_deep(document: Any) -> bool:
    level: list[dict[str, Any] | list[Any]] = [document]
    for _ in range(MOST_DEEP):
        inner: list[Any] = []
        for one in level:
            inner += one.values() if isinstance(one, dict) else one
        level = [child for child in inner if isinstance(child, dict | list)]
        if not level:
            return False
    return True


def _once(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    found = dict(pairs)
    if len(found) < len(pairs):
        twice = next(key for key, count in Counter(key for key, _ in pairs).items() if count > 1)
        raise ValueError(f'the key "{twice}" stands twice in one object: keep one')
    return found


def problems(error: ValidationError, root: type[BaseModel]) -> list[str]:
    """Each error of `root.model_validate(document)` as a sentence, in the order of the fields.

    Of more than `MOST_TOLD` the first, and how many more there are: whoever sends nonsense costs no time with it.
    """
    schema, count = _schema_of(root), error.error_count()
    told = [_problem(details, schema) for details in islice(error.errors(include_url=False), MOST_TOLD)]
    return told if count <= MOST_TOLD else [*told, f"and {count - MOST_TOLD} more"]


@cache
def _schema_of(root: type[BaseModel]) -> Schema:
    return root.model_json_schema()


def _problem(error: ErrorDetails, root: Schema) -> str:
    path, kind, value = error["loc"], error["type"], error["input"]
    if kind == "json_invalid":
        return printable(error["msg"][:1].lower() + error["msg"][1:])
    if kind == "value_error":  # in the words of the format itself
        words = error["msg"].removeprefix("Value error, ")
        return _sentence(path, value if path else None, words) if path else words
    node = _node(path, root)
    if kind == "extra_forbidden":
        known = list(_node(path[:-1], root).get("properties", {}))
        return _sentence(path, value, "there is no such key", ", ".join(known), nearest(str(path[-1]), known))
    wrong = _WRONG.get(kind) or f"is {_kind(value)}"
    shown = None if kind == "missing" else "null" if value is None else value
    like = nearest(value, node.get("enum", ())) if kind == "literal_error" and isinstance(value, str) else ""
    return _sentence(path, shown, wrong, _allowed(node, path), like)


def _sentence(path: Path, value: Any, wrong: str, allowed: str = "", like: str = "") -> str:
    shown = "" if value is None else value if value == "null" else value_in_words(value)
    found = f" = {shown}" if shown else ""
    may = f"; allowed: {allowed}" if allowed else ""
    return f"{key_in_words(path)}{found}: {wrong}{may}{f'; did you mean {like}?' if like else ''}"


def _allowed(node: Schema, path: Path) -> str:
    """What may stand at a node of the schema, in words."""
    kind = node.get("type")
    if kind == "array":
        least, most = node.get("minItems"), node.get("maxItems")
        count = f" of {least} to {most} entries" if least is not None and most is not None else ""
        return f"a list{count}, each {_allowed(_resolved(node['items'], node['$root']), path)}"
    if kind == "object":
        return "an object { ... }"
    if kind == "boolean":
        return "true or false"
    if kind == "string" and "enum" not in node:
        if "pattern" in node:
            return f"text of the form {node['pattern']}"
        return f"text of {node['minLength']} to {node['maxLength']} letters" if "maxLength" in node else "text"
    return allowed_in_words(node, path)


def _node(path: Path, root: Schema) -> Schema:
    """The schema of what stands at `path`; {} where there is none."""
    node = _resolved(root, root)
    for part in path:
        inner = node.get("items", {}) if isinstance(part, int) else node.get("properties", {}).get(part)
        node = _resolved(_any_value(node) if inner is None else inner, root)
    return node


def _any_value(node: Schema) -> Schema:
    """What stands under a key that is no field, in an object whose keys are free or of a form."""
    of_a_form: dict[str, Schema] = node.get("patternProperties", {})
    free: Schema = node.get("additionalProperties") or {}
    return next(iter(of_a_form.values()), free)


def _resolved(node: Schema, root: Schema) -> Schema:
    if "anyOf" in node:  # "or null"
        node = node["anyOf"][0]
    if "$ref" in node:
        node = root["$defs"][node["$ref"].rsplit("/", 1)[1]]
    return {**node, "$root": root}


def _kind(value: Any) -> str:
    return next(words for kind, words in _KINDS if isinstance(value, kind))
