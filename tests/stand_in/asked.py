"""What a persona makes of a request: the question in it, the form that is asked for, and which option is best. Pure.

Written from the schema of questions and from what is on the wire, not with the product's code.
"""

import json
import re
from collections.abc import Mapping, Sequence
from typing import Any

from tests.stand_in.spoken import Form, Message

#: Figures by which options are compared, the first that any option has. Less is better.
DECIDING = ("tracking error", "rmse", "score", "error")
_BLOCK = re.compile(r"^```json\n(.*?)\n```$", re.DOTALL | re.MULTILINE)


def question_in(messages: Sequence[Message]) -> dict[str, Any] | None:
    """The question in the last block of JSON that a user's message has."""
    for message in reversed(messages):
        for block in reversed(_BLOCK.findall(message.get("content", "")) if message["role"] == "user" else []):
            try:
                found = json.loads(block)
            except ValueError:
                continue
            if isinstance(found, dict) and found.get("options"):
                return found
    return None


def refusals(messages: Sequence[Message], form: Form) -> int:
    """How many refusals of an answer the conversation tells of."""
    told = sum(message["role"] == "user" and message["content"].startswith("That is no answer") for message in messages)
    return told if form is not None else 0


def values(question: Mapping[str, Any]) -> dict[str, float]:
    """By option, the figure that decides; only of options that have it."""
    for word in DECIDING:
        found = {
            option["id"]: figure["value"]
            for option in question["options"]
            for figure in reversed(option["figures"])
            if word in figure["name"].lower() and figure["value"] is not None
        }
        if found:
            return found
    return {}


def best(question: Mapping[str, Any]) -> str:
    """The option with the least deciding figure, of equal ones the usual; the usual where none has such a figure."""
    found, usual = values(question), str(question["usual"])
    return min(found, key=lambda option: (found[option], option != usual)) if found else usual


def worst(question: Mapping[str, Any]) -> str:
    """The option with the greatest; without figures the last that is not usual."""
    if found := values(question):
        return max(found, key=lambda option: found[option])
    others = [option["id"] for option in question["options"] if option["id"] != question["usual"]]
    return str(others[-1] if others else question["usual"])


def fields(form: Form) -> dict[str, Mapping[str, Any]]:
    """The form's keys and what may stand under each."""
    return dict(form.get("properties", {})) if isinstance(form, Mapping) else {}


def knobs(form: Form) -> dict[str, tuple[float, float]]:
    """The form's numbers with their bounds."""
    numbers = {key: field for key, field in fields(form).items() if field.get("type") == "number"}
    return {key: (field.get("minimum", 0.0), field.get("maximum", 1.0)) for key, field in numbers.items()}


def filled(form: Form, option: str, factors: Mapping[str, float], because: str) -> dict[str, Any]:
    """The form: the choice where one of several is to be named, `factors` or 1 where a number is, else words."""
    document: dict[str, Any] = {}
    for key, field in fields(form).items():
        if "enum" in field:
            document[key] = option
        elif field.get("type") == "number":
            document[key] = factors.get(key, 1.0)
        else:
            document[key] = because
    return document
