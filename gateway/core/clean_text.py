"""Text and values of others, made harmless: bounded, and with nothing in them that plays with a terminal or a page.

Control characters, terminal escapes, marks that turn the direction of writing and halves of surrogate pairs become
visible escapes. Pure.
"""

from collections.abc import Mapping, Sequence
from math import isfinite
from typing import Any, cast

MOST_ITEMS, MOST_DEEP, MOST_LETTERS = 1000, 12, 4000
LARGEST_INTEGER = 2**53 - 1  #: what a page and a database still tell exactly
_KEPT = "\n\t"  #: of what is not printable


def clean(text: str, most: int = MOST_LETTERS) -> str:
    """At most `most` characters and what was left out, each printable or an end of line.

    Cut before it is looked through: its time is bounded, too.
    """
    left_out = len(text) - most
    if left_out > 0:
        text = text[:most]
    if not text.isprintable():
        text = "".join(c if c.isprintable() or c in _KEPT else f"\\u{ord(c):04x}" for c in text)
    return f"{text}... ({left_out} more characters)" if left_out > 0 else text


def clean_texts(document: Any) -> Any:
    """A document of JSON with every text harmless and nothing cut; a number that is none, or without end, is null."""
    if isinstance(document, str):
        return document if document.isprintable() else clean(document, len(document))
    if isinstance(document, float):
        return document if isfinite(document) else None
    if isinstance(document, dict):
        of_document = cast(dict[str, Any], document)
        return {clean_texts(key): clean_texts(one) for key, one in of_document.items()}
    if isinstance(document, list | tuple):
        return [clean_texts(one) for one in cast(Sequence[Any], document)]
    return document


def clean_value(value: Any, deep: int = MOST_DEEP) -> Any:
    """A value as JSON can say it: texts as `clean` makes them, at most `MOST_ITEMS` in a list and an object.

    A number that is none, or without end, is "nan", "inf" or "-inf"; a whole number that few programs take is a text.
    What is left out is told in its place.
    """
    if isinstance(value, str):
        return clean(value)
    if value is None or isinstance(value, bool):
        return value
    if isinstance(value, int):
        return value if abs(value) <= LARGEST_INTEGER else _in_letters(value)
    if isinstance(value, float):
        return value if isfinite(value) else str(value)
    if deep <= 0:
        return "... (nested more deeply)"
    if isinstance(value, Mapping):
        return _clean_object(cast(Mapping[Any, Any], value), deep - 1)
    if isinstance(value, Sequence):
        items = cast(Sequence[Any], value)
        some = [clean_value(one, deep - 1) for one in items[:MOST_ITEMS]]
        return some if len(items) <= MOST_ITEMS else [*some, f"... ({len(items) - MOST_ITEMS} more)"]
    return clean(str(value))


def _clean_object(value: Mapping[Any, Any], deep: int) -> dict[str, Any]:
    found: dict[str, Any] = {}
    for key, one in value.items():
        if len(found) >= MOST_ITEMS:
            found["..."] = f"{len(value) - MOST_ITEMS} more"
            break
        found[clean(str(key), 200)] = clean_value(one, deep)
    return found


def _in_letters(value: int) -> str:
    """A whole number of any length, at once: thousands of digits take seconds to write."""
    return str(value) if value.bit_length() <= 256 else f"a number of {value.bit_length()} bits"
