"""What every benchmark writes: `out/bench/NAME.json`, and the same as a table on the terminal."""

import os
import platform
import sys
import tomllib
from collections.abc import Sequence
from dataclasses import dataclass, field
from datetime import UTC, datetime
from importlib.metadata import version
from pathlib import Path
from typing import Any, Literal

from gateway.core.line import Strict

GOALS = tomllib.loads((Path(__file__).parent / "goals.toml").read_text())
LIBRARIES = ("numpy", "scipy", "numba", "python-can", "canopen", "pymodbus")
_MEETS = {"<=": lambda value, goal: value <= goal, ">=": lambda value, goal: value >= goal}


class Figure(Strict):
    name: str
    value: float
    unit: str
    op: Literal["<=", ">="] | None  #: None: there is no goal for it
    goal: float | None
    met: bool | None
    n: int  #: measurements behind it


class BenchResult(Strict):
    """What a benchmark writes. Schema in docs/schemas/bench.schema.json."""

    name: str
    command: str
    date: str  #: ISO 8601
    machine: str
    versions: dict[str, str]
    seeds: list[int]
    figures: list[Figure]
    tables: dict[str, Any]


@dataclass
class Bench:
    """Collect figures; `finish` holds them against the goals. A goal missed is shown as missed, not raised."""

    name: str
    seeds: list[int] = field(default_factory=list)
    figures: list[Figure] = field(default_factory=list)
    tables: dict[str, Any] = field(default_factory=dict)
    command: str = ""  #: empty: make bench-NAME
    libraries: tuple[str, ...] = LIBRARIES
    goals_of: str = ""  #: the benchmark whose goals figures are held against; empty: its own
    date: str = field(default_factory=lambda: datetime.now(UTC).isoformat(timespec="seconds"))

    def figure(self, name: str, value: float, unit: str, n: int) -> None:
        """One figure from `n` measurements."""
        goal = GOALS.get(self.goals_of or self.name, {}).get(name)
        met = None if goal is None else bool(_MEETS[goal["op"]](value, goal["value"]))
        self.figures.append(
            Figure(
                name=name,
                value=float(value),
                unit=unit,
                op=goal and goal["op"],
                goal=goal and goal["value"],
                met=met,
                n=n,
            )
        )

    def result(self) -> BenchResult:
        return BenchResult(
            name=self.name,
            command=self.command or f"make bench-{self.name}",
            date=self.date,
            machine=f"{os.cpu_count()} cpus, {platform.system()} {platform.release()}, Python {sys.version.split()[0]}",
            versions={name: version(name) for name in self.libraries},
            seeds=self.seeds,
            figures=self.figures,
            tables=self.tables,
        )

    def so_far(self, since: int = 0) -> int:
        """Write everything, print the figures from number `since` on; the number of the next one."""
        self._write()
        self._print_rows(self.figures[since:])
        return len(self.figures)

    def finish(self) -> None:
        """Write and print. Raises SystemExit when a figure that has a goal was not measured."""
        path = self._write()
        missing = set(GOALS.get(self.name, {})) - {figure.name for figure in self.figures}
        if missing:
            raise SystemExit(f"bench {self.name} did not measure {sorted(missing)}")
        print(f"\nbench {self.name}")
        print(f"  {'figure':<26}{'value':>13}  {'goal':>13}  {'':<7}{'n':>5}")
        self._print_rows(self.figures)
        print(f"  -> {path}")

    def _write(self) -> Path:
        path = Path("out/bench") / f"{self.name}.json"
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(self.result().model_dump_json(indent=2) + "\n")
        return path

    @staticmethod
    def _print_rows(figures: Sequence[Figure]) -> None:
        for figure in figures:
            goal = "" if figure.goal is None else f"{figure.op} {figure.goal:g}"
            verdict = {None: "", True: "met", False: "MISSED"}[figure.met]
            value = f"{figure.value:.4g} {figure.unit}"
            print(f"  {figure.name:<26}{value:>13}  {goal:>13}  {verdict:<7}{figure.n:>5}", flush=True)
