"""How documents about a line say figures, moments and what somebody else has written."""

from collections.abc import Iterable, Sequence
from datetime import UTC, datetime

from gateway.core.line_problem import printable

MOST_LETTERS = 20_000  #: of a document of what happened
MOST_QUOTED = 1000  #: letters of what somebody has written


def number(value: float, unit: str = "") -> str:
    """Four digits, without an exponent where people would write none."""
    text = f"{value:.4g}"
    if "e" in text and 1.0 <= abs(value) < 1e9:
        text = f"{value:.0f}"
    return f"{text} {unit}".rstrip()


def moment(wall_s: float | None) -> str:
    """Unix time as ISO 8601 to the second; empty: nobody has noted it."""
    return "" if wall_s is None else datetime.fromtimestamp(wall_s, UTC).isoformat(timespec="seconds")


def on(date: str) -> str:
    """Of ISO 8601, as a sentence has it."""
    return f"on {date[:16].replace('T', ' at ')}" if date else "at a time that nobody has noted"


def quoted(said: str) -> str:
    """What a person or an agent has written: one line of Markdown that cannot be taken for one of the program's."""
    clean = printable(" ".join(said.split()))
    return f"> {clean[:MOST_QUOTED]}{' ...' if len(clean) > MOST_QUOTED else ''}" if clean else "> (nothing)"


def listed(head: str, rows: Iterable[str]) -> str:
    """Under a heading; empty without rows."""
    told = [f"- {row}" for row in rows]
    return "\n".join([f"## {head}", "", *told]) if told else ""


def section(head: str, *paragraphs: str) -> str:
    return "\n\n".join([f"## {head}", *filter(None, paragraphs)])


def whole(parts: Sequence[str], most: int = MOST_LETTERS) -> str:
    """A document of its parts, without the empty ones, and not longer than `most` letters and a word."""
    text = "\n\n".join(part for part in parts if part)
    return text if len(text) <= most else f"{text[:most]}\n\n(cut here: it goes on in the line's records)"
