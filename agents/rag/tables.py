"""A table as text that can be searched: what its columns hold, and its rows where they are few. Pure."""

import csv
import io
from collections.abc import Sequence
from statistics import median

MOST_ROWS = 500  #: that are told one by one; of longer tables - recordings - the columns say what is in them
MOST_COLUMNS = 200
MOST_VALUES = 12  #: of a column of words that are named
_DELIMITERS = ",;\t"


def text_of_csv(content: str) -> str:
    """Markdown. The first row names the columns. Raises ValueError where that is no table."""
    rows = _rows(content)
    if len(rows) < 2:
        raise ValueError("it has no row below the names of its columns")
    names = [name.strip() for name in rows[0]]
    if not 1 < len(names) <= MOST_COLUMNS:
        raise ValueError(f"it has {len(names)} columns; allowed: 2 to {MOST_COLUMNS}, separated by , or ; or tab")
    for number, row in enumerate(rows[1:], start=2):
        if len(row) != len(names):
            raise ValueError(f"row {number} has {len(row)} cells, its first row {len(names)}")
    columns = list(zip(*rows[1:], strict=True))
    told = [
        f"- {name or f'column {k}'}: {_column(cells)}"
        for k, (name, cells) in enumerate(zip(names, columns, strict=True), 1)
    ]
    text = f"{len(rows) - 1} rows.\n\n## Columns\n\n" + "\n".join(told)
    if len(rows) - 1 <= MOST_ROWS:
        listed = (
            "; ".join(f"{a}: {b.strip()}" for a, b in zip(names, row, strict=True) if b.strip()) for row in rows[1:]
        )
        text += "\n\n## Rows\n\n" + "\n\n".join(filter(None, listed))
    return text


def _rows(content: str) -> list[list[str]]:
    first = content.lstrip().partition("\n")[0]
    delimiter = max(_DELIMITERS, key=first.count)
    try:
        rows = list(csv.reader(io.StringIO(content), delimiter=delimiter, strict=True))
    except csv.Error as error:
        raise ValueError(str(error)) from error
    return [row for row in rows if any(cell.strip() for cell in row)]


def _column(cells: Sequence[str]) -> str:
    filled = [cell.strip() for cell in cells if cell.strip()]
    try:
        numbers = [float(cell) for cell in filled]
    except ValueError:
        values = list(dict.fromkeys(filled))
        more = f" and {len(values) - MOST_VALUES} more" if len(values) > MOST_VALUES else ""
        return ", ".join(values[:MOST_VALUES]) + more
    if not numbers:
        return "empty"
    return f"{min(numbers):g} to {max(numbers):g}, median {median(numbers):g}, {len(numbers)} values"
