"""Numbers as a person reads them, and the tables they stand in."""

import math
from collections.abc import Iterable, Mapping
from html import escape

import numpy as np

from gateway.cli.report.data import FloatArray

SPAN_COLOURS = 6  #: as many as the style sheet keeps apart; further spans begin again with the first


def table(
    caption: str,
    heads: list[str],
    rows: Iterable[list[str]],
    numeric: set[int],
    foot: list[str] | None = None,
    style: str = "",
) -> str:
    """A table of cells that are HTML already. The first cell of a row is its header."""

    def cells(row: list[str]) -> str:
        marks = [' class="n"' if i in numeric else "" for i in range(len(row))]
        first = f'<th scope="row"{marks[0]}>{row[0]}</th>'
        return first + "".join(f"<td{mark}>{cell}</td>" for mark, cell in zip(marks[1:], row[1:], strict=True))

    head = "".join(
        f'<th scope="col"{" class=n" if i in numeric else ""}>{_together(name)}</th>' if name else "<td></td>"
        for i, name in enumerate(heads)
    )
    body = "".join(f"<tr>{cells(row)}</tr>" for row in rows)
    tail = f"<tfoot><tr>{cells(foot)}</tr></tfoot>" if foot else ""
    return (
        f'<div class="scroll"><table class="{style}"><caption>{caption}</caption>'
        f"<thead><tr>{head}</tr></thead><tbody>{body}</tbody>{tail}</table></div>"
    )


def _together(head: str) -> str:
    """A unit stays on the line of the word before it."""
    return head.replace(", ", ",&nbsp;")


def number(value: float, digits: int = 4) -> str:
    """`value` with so many significant digits (all those before the point), or words where it was not measured."""
    if math.isnan(value):
        return "not measured"
    decimals = digits - 1 - math.floor(math.log10(abs(value))) if value else 0
    text = f"{value:.{max(0, decimals)}f}"
    return (text.rstrip("0").rstrip(".") if "." in text else text).replace("-", "−")


def fixed(value: float, decimals: int) -> str:
    """`value` with so many decimals, for columns that are compared down the page."""
    return "not measured" if math.isnan(value) else f"{value:.{decimals}f}".replace("-", "−")


def grouped(value: int) -> str:
    return f"{value:,}".replace(",", "\u202f")


def count(value: int, style: str) -> str:
    """A count of what should not happen: 0 in plain ink, anything else marked by sign and colour."""
    return f'<span class="{style}">▲ {grouped(value)}</span>' if value else "0"


def plural(amount: int, noun: str) -> str:
    return f"{grouped(amount)} {noun}" if amount == 1 else f"{grouped(amount)} {noun}s"


def move(start: float, end: float) -> str:
    """A value that stays, or the two between which it moves."""
    return number(start) if start == end else f"{number(start)} → {number(end)}"


def flagged(value: float, bad: bool) -> str:
    """`value`, marked by sign and colour where it is bad."""
    text = fixed(value, 2)
    return f'<span class="alarm-text">▲ {text}</span>' if bad else text


def largest(values: FloatArray) -> float:
    """The largest that was measured, NaN if none was."""
    finite = values[~np.isnan(values)]
    return float(finite.max()) if finite.size else math.nan


def percentile(values: FloatArray, percent: float) -> float:
    finite = values[~np.isnan(values)]
    return float(np.percentile(finite, percent)) if finite.size else math.nan


def range_words(values: FloatArray, unit: str) -> str:
    """Smallest to largest, for a reader who does not see the chart."""
    if np.isnan(values).all():
        return "not measured"
    return f"{number(-largest(-values))} to {number(largest(values))} {unit}"


def versions_text(versions: Mapping[str, str]) -> str:
    """Programs and libraries with their versions, in one line of HTML."""
    return ", ".join(f"{escape(name)} {escape(version)}" for name, version in versions.items())


def swatch(index: int, style: str = "") -> str:
    """A patch of the colour in which span `index` (from 0) is drawn."""
    return f'<span class="swatch t{index % SPAN_COLOURS}{style}"></span>'


def zoom_bar(whole: str = "Whole time", more: str = "") -> str:
    """Where the cursor is, and the buttons that zoom; `whole` names the one that shows all."""
    actions = (("in", "Zoom in"), ("out", "Zoom out"), ("reset", whole))
    buttons = "".join(f'<button type="button" data-zoom="{action}">{name}</button>' for action, name in actions)
    return f'<div class="bar"><span class="now" data-at></span>{buttons}{more}</div>'


def chart_place(name: str, words: str, more: str = "") -> str:
    """A place for a chart; `words` say what it shows, for those who do not see it. `more` are further attributes."""
    return (
        f'<div class="chart" data-chart="{name}" tabindex="0" role="application"'
        f' aria-roledescription="chart" aria-label="{escape(words)}"{more}></div>'
    )
