"""What failed and passed when it was tried again, kept beside the tests: `python -m tests.landing keep LOG`.

A line a run, and one more for each test. Who is in it three times in its last ten runs is mended before anything else.
"""

import json
import re
from collections import Counter
from pathlib import Path
from typing import Any

FILE = Path(__file__).parent / "intermittent.jsonl"
RUNS, MOST = 10, 2

#: How the runner begins its list, and each row of it: the test, and what its crash said.
HEADING = "intermittent:"
ROW = re.compile(r"^  (tests/\S+\.py(?:::.+?)?) \((.*)\)$")


def rows_of(log: str) -> dict[str, str]:
    """By test what its crash said, as a run printed it; empty where it had none."""
    lines = iter(log.splitlines())
    listed: dict[str, str] = {}
    for line in lines:
        if line == HEADING:
            for row in lines:
                if (match := ROW.match(row)) is None:
                    break
                listed[match[1]] = match[2]
    return listed


def keep(log: str, run: str, file: Path = FILE) -> int:
    """How many there were. A run that is kept already is not kept twice."""
    if any(row["run"] == run for row in _rows(file)):
        return 0
    found = rows_of(log)
    added: list[dict[str, str]] = [{"run": run}]
    added += [{"run": run, "test": test, "crash": crash} for test, crash in found.items()]
    with file.open("a") as kept:
        kept.writelines(json.dumps(row) + "\n" for row in added)
    return len(found)


def to_be_mended(file: Path = FILE) -> list[str]:
    """Tests that were intermittent in more than `MOST` of the last `RUNS` runs."""
    rows = _rows(file)
    last = list(dict.fromkeys(row["run"] for row in rows))[-RUNS:]
    seen = Counter(row["test"] for row in rows if "test" in row and row["run"] in last)
    return sorted(test for test, runs in seen.items() if runs > MOST)


def _rows(file: Path) -> list[dict[str, Any]]:
    return [json.loads(line) for line in file.read_text().splitlines()] if file.exists() else []
