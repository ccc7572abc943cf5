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
ENDS = re.compile(r"^(\d+ failed, )?\d+ passed, \d+ skipped in \d+ s$", re.MULTILINE)
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
    """How many more of the run at commit `run` are known now. Raises ValueError for a log that is not whole."""
    if not ENDS.search(log):
        raise ValueError("the log does not end with how many tests passed: it is of no whole run")
    found, rows = rows_of(log), _rows(file)
    there = {row.get("test") for row in rows if row["run"] == run}
    added = [{"run": run, "test": test, "crash": crash} for test, crash in found.items() if test not in there]
    _add(file, added if there else [{"run": run}, *added])
    return len(added)


def mend(test: str, run: str, file: Path = FILE) -> None:
    """What was seen of it until now counts no more: the change at `run`, or what follows it, has mended it."""
    _add(file, [{"run": run, "mended": test}])


def to_be_mended(file: Path = FILE) -> list[str]:
    """Tests that were intermittent in more than `MOST` of the last `RUNS` runs, and have not been mended since."""
    rows = _rows(file)
    last = list(dict.fromkeys(row["run"] for row in rows if "mended" not in row))[-RUNS:]
    seen: Counter[str] = Counter()
    for row in rows:
        if "mended" in row:
            del seen[row["mended"]]
        elif "test" in row and row["run"] in last:
            seen[row["test"]] += 1
    return sorted(test for test, runs in seen.items() if runs > MOST)


def _add(file: Path, rows: list[dict[str, str]]) -> None:
    with file.open("a") as kept:
        kept.writelines(json.dumps(row) + "\n" for row in rows)


def _rows(file: Path) -> list[dict[str, Any]]:
    return [json.loads(line) for line in file.read_text().splitlines()] if file.exists() else []
