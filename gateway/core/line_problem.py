"""What is wrong with a line description, where, and what to do: the data that `check` prints."""

import json
import re
from dataclasses import dataclass
from typing import Any, Literal, cast

from gateway.core.toml_places import Path

_BARE_KEY = re.compile(r"[A-Za-z0-9_-]+")
_VALUE_LENGTH = 60
_OWN_MARKS = str.maketrans(dict.fromkeys('"\u201c\u201d\u201e\u201f\u00ab\u00bb\uff02', "'"))


@dataclass(frozen=True, slots=True)
class Finding:
    """Something wrong (or odd) at a path of the line description, not yet tied to a line of the file."""

    path: Path  #: indices from 0
    wrong: str  #: continues "key = value: "
    allowed: str = ""
    nearest: str = ""  #: what was perhaps meant
    severity: Literal["error", "warning"] = "error"


def odd(path: Path, wrong: str, advice: str = "") -> Finding:
    """Legal, but worth a second look."""
    return Finding(path, wrong, advice, severity="warning")


@dataclass(frozen=True, slots=True)
class Problem:
    """A finding with its place in the file."""

    file: str
    line: int  #: 1-based; of the key, or of the table's header when the key is missing
    key: str  #: in the file's own words; [3] is the third such table or element
    value: str  #: as TOML, "" when there is none
    wrong: str
    allowed: str = ""
    nearest: str = ""

    def __str__(self) -> str:
        found = f" = {self.value}" if self.value else ""
        key = f" {self.key}{found}:" if self.key else ""
        allowed = f"; allowed: {self.allowed}" if self.allowed else ""
        nearest = f"; did you mean {self.nearest}?" if self.nearest else ""
        return f"{self.file}:{self.line}:{key} {self.wrong}{allowed}{nearest}"


class LineRefused(Exception):
    """The text is no valid line description; carries every problem, in the order of the file."""

    def __init__(self, problems: list[Problem]) -> None:
        super().__init__("\n".join(map(str, problems)))
        self.problems = problems


def key_in_words(path: Path) -> str:
    """`drives[3].address`: elements counted from 1, as rollers and spans are."""
    words = ""
    for part in path:
        if isinstance(part, int):
            words += f"[{part + 1}]"
        else:
            key = part if _BARE_KEY.fullmatch(part) else printable(json.dumps(part, ensure_ascii=False))
            words += f".{key}" if words else key
    return words


def value_in_words(value: Any) -> str:
    """A value as TOML writes it, on one short line; "" for nothing and for tables."""
    if isinstance(value, dict) or value is None:
        return ""
    if isinstance(value, list):
        elements = cast(list[Any], value)
        if any(isinstance(element, dict) for element in elements):
            return ""
        words = "[" + ", ".join(map(value_in_words, elements[:20])) + "]"
    elif isinstance(value, bool | str):
        words = json.dumps(value, ensure_ascii=False)
    elif isinstance(value, int):
        words = str(value) if abs(value) < 10**_VALUE_LENGTH else "a number of more than 60 digits"
    else:
        words = str(value)  # float, date or time
    words = printable(words)
    return words if len(words) <= _VALUE_LENGTH else words[: _VALUE_LENGTH - 3] + "..."


def quoted(text: str, most: int | None = None) -> str:
    """What somebody has said, on one line, between quotation marks that its own cannot close.

    `most`: characters of it; \u2026 is the last of one that was longer.
    """
    said = printable(" ".join(text.split())).translate(_OWN_MARKS)
    if most is not None and len(said) > most:
        said = f"{said[: most - 1]}\u2026"
    return f"\u201c{said}\u201d"


def printable(text: str) -> str:
    """Control and formatting characters as escapes, so that a file cannot play with the terminal."""
    return "".join(c if c.isprintable() else f"\\u{ord(c):04x}" for c in text)
