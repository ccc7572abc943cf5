"""What a long benchmark has found so far, on the disk row by row: one that was ended goes on where it was.

Each row says which program it was found with. Rows of another program count as long as nobody deletes them, and the
result says how many there are of each: whoever changed what the rows are about begins anew.
"""

import hashlib
import json
from collections import Counter
from collections.abc import Iterator
from functools import cache
from pathlib import Path
from typing import Any

PROGRAM = ("gateway", "safety", "drivers", "sim_plant", "tests/bench", "tests/closed_loop")
SOURCES = (".py", ".toml")
_MADE_BY = "program"


class KeptRows:
    """Rows of JSON in `path`; without `go_on` what was there is gone."""

    def __init__(self, path: Path, go_on: bool) -> None:
        self._path = path
        path.parent.mkdir(parents=True, exist_ok=True)
        if not go_on:
            path.unlink(missing_ok=True)
        self._rows = list(_rows(path))
        # Whole ones alone, or the next would be written behind the half of one that was cut off.
        path.write_text("".join(json.dumps(row) + "\n" for row in self._rows), encoding="utf-8")
        program()  # of what is imported now

    def __iter__(self) -> Iterator[dict[str, Any]]:
        """What was found, without who found it."""
        return ({key: value for key, value in row.items() if key != _MADE_BY} for row in self._rows)

    def add(self, row: dict[str, Any]) -> None:
        """It is on the disk afterwards."""
        self._rows.append({**row, _MADE_BY: program()})
        with self._path.open("a", encoding="utf-8") as file:
            file.write(json.dumps(self._rows[-1]) + "\n")

    def made_by(self) -> dict[str, int]:
        """How many rows there are of each program; that of today is called so."""
        names = Counter("this program" if row.get(_MADE_BY) == program() else row.get(_MADE_BY) for row in self._rows)
        return {str(name): count for name, count in names.items()}


@cache
def program() -> str:
    """The beginning of a hash of the sources of the program, and of those that draw and judge."""
    content = hashlib.sha256()
    for path in sorted(path for folder in PROGRAM for path in Path(folder).rglob("*") if path.suffix in SOURCES):
        content.update(f"{path}\n".encode() + path.read_bytes())
    return content.hexdigest()[:12]


def _rows(path: Path) -> Iterator[dict[str, Any]]:
    """Those that were written whole: the last one of a run that was killed may not be."""
    if not path.exists():
        return
    for line in path.read_text(encoding="utf-8").splitlines():
        try:
            yield json.loads(line)
        except json.JSONDecodeError:
            continue
