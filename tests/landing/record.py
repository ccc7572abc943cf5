"""A pytest plugin that writes what each test comes to, a JSON line each, as it comes: `-p tests.landing.record`.

It writes in the process that reports only, not in xdist's workers, and at once: a run that is ended leaves what it did.
"""

import json
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Self

import pytest

#: Of what a crash says, the first line only, and no more of it than this.
CRASH_LENGTH = 200


def pytest_addoption(parser: pytest.Parser) -> None:
    parser.addoption("--record", metavar="FILE", help="write what each test comes to into FILE")


def pytest_configure(config: pytest.Config) -> None:
    path = config.getoption("--record")
    if path and not hasattr(config, "workerinput"):
        config.pluginmanager.register(_Recorder(Path(path)))


class _Recorder:
    def __init__(self, path: Path) -> None:
        self._file = path.open("w", buffering=1)

    def pytest_runtest_logstart(self, nodeid: str) -> None:
        self._write(test=nodeid, when="start")

    def pytest_runtest_logreport(self, report: pytest.TestReport) -> None:
        self._write(
            test=report.nodeid, when=report.when, outcome=report.outcome, took_s=report.duration,
            crash=_crash(report),
        )  # fmt: skip

    def pytest_collectreport(self, report: pytest.CollectReport) -> None:
        if report.failed:
            self._write(test=report.nodeid, when="collect", outcome="failed", crash=_crash(report))

    def pytest_sessionfinish(self, session: pytest.Session) -> None:
        self._write(test="", when="end", collected=session.testscollected)

    def pytest_unconfigure(self) -> None:
        self._file.close()

    def _write(self, **row: object) -> None:
        self._file.write(json.dumps(row) + "\n")


def _crash(report: pytest.TestReport | pytest.CollectReport) -> str:
    if not report.failed:
        return ""
    crash: Any = getattr(report.longrepr, "reprcrash", None)
    text = str(crash.message if crash else report.longrepr).strip()
    lines = text.splitlines() or [""]
    # What could not be imported says so in its last line.
    return (lines[0] if crash else lines[-1].removeprefix("E").strip())[:CRASH_LENGTH]


@dataclass
class Recorded:
    """What a run of pytest came to.

    `failed`: by test, or by file where that could not be collected, what it says of its crash. `whole`: those of them
    that failed elsewhere than in their own call: what failed may be what their file shares. `running`: begun, and not
    ended. `complete`: it came to its end, and every test that was collected did.
    """

    passed: set[str] = field(default_factory=set)
    skipped: set[str] = field(default_factory=set)
    failed: dict[str, str] = field(default_factory=dict)
    whole: set[str] = field(default_factory=set)
    running: set[str] = field(default_factory=set)
    ended: set[str] = field(default_factory=set)
    collected: int | None = None
    took_s: dict[str, float] = field(default_factory=dict)

    @classmethod
    def read(cls, path: Path) -> Self:
        """Of a file that may end in the middle of a line, or not be there."""
        recorded = cls()
        for row in _rows(path.read_text().splitlines() if path.exists() else ()):
            recorded._take(row["test"], row["when"], row.get("outcome", ""), row)
        recorded.passed -= recorded.failed.keys()
        return recorded

    @property
    def complete(self) -> bool:
        return len(self.ended) == self.collected and not self.running

    def _take(self, test: str, when: str, outcome: str, row: dict[str, Any]) -> None:
        if when == "start":
            self.running.add(test)
        elif when == "end":
            self.collected = row["collected"]
        else:
            self.took_s[test] = self.took_s.get(test, 0.0) + row.get("took_s", 0.0)
            self._count(test, when, outcome, row["crash"])

    def _count(self, test: str, when: str, outcome: str, crash: str) -> None:
        if outcome == "failed":
            self.failed.setdefault(test, crash)
            if when != "call":
                self.whole.add(test)
        elif outcome == "skipped":
            self.skipped.add(test)
        elif when == "call":
            self.passed.add(test)
        if when not in ("setup", "call", "collect"):  # xdist says "???" of a test at which a worker died
            self.running.discard(test)
            self.ended.add(test)


def _rows(lines: Iterable[str]) -> Iterator[dict[str, Any]]:
    for line in lines:
        try:
            yield json.loads(line)
        except ValueError:  # it was being written when the run was ended
            continue
