"""What a part of the benchmark hands over: a section of the report, and figures by name."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from math import isfinite

import numpy as np

from gateway.cli.report import Section, Table
from gateway.cli.tiers import Tier

SEEDS, FEW_SEEDS = 20, 5
BY_THE_WAY = ("PID", "LQG")  #: laws that the comparison does not ask for: few seeds where a run takes long
SLOW_S = 0.005  #: a period below which a run takes long


@dataclass(frozen=True)
class Given:
    """What was asked for, and when."""

    command: str
    when: str  #: ISO 8601
    tiers: tuple[Tier, ...]
    laws: tuple[str, ...]
    seeds: int
    plants: int

    def seeds_of(self, tier: Tier, law: str) -> range:
        few = law in BY_THE_WAY and tier.period_s < SLOW_S
        return range(min(self.seeds, FEW_SEEDS) if few else self.seeds)

    def made(self, how: str) -> str:
        """How a table was produced."""
        return f"{how} Made by {self.command}, {self.when[:16].replace('T', ' ')} UTC."


def seeds_told(seeds: range) -> str:
    return "seed 0" if len(seeds) == 1 else f"seeds 0 to {seeds[-1]}"


@dataclass
class Part:
    section: Section
    figures: list[tuple[str, float, str, int]] = field(default_factory=list)  #: name, value, unit, measurements
    unsafe: int = 0  #: events at the drives, of all its runs
    runs: int = 0


def slug(*words: str) -> str:
    """A figure's name: what it was under, law, plant known, case, quantity."""
    return "_".join(words).lower().replace(" + ", "_").replace("-", "_")


def mean(values: Iterable[float]) -> float:
    return float(np.mean(list(values)))


def p95(values: Iterable[float]) -> float:
    return float(np.percentile(list(values), 95))


def told(value: float, decimals: int = 3) -> str:
    """A number of a table; a dash where there is none."""
    return f"{value:.{decimals}f}" if isfinite(value) else "never" if value == float("inf") else "–"


def numeric(heads: Sequence[str], words: int) -> frozenset[int]:
    """All columns behind the first `words`."""
    return frozenset(range(words, len(heads)))


def markdown(table: Table) -> str:
    """The same for a file that people read as it is."""

    def line(cells: Sequence[str]) -> str:
        return f"| {' | '.join(cell.replace('|', '/') for cell in cells)} |"

    rule = [("---:" if i in table.numeric else "---") for i in range(len(table.heads))]
    rows = [table.heads, rule, *table.rows, *([table.foot] if table.foot else [])]
    return "\n".join([f"**{table.caption}**", "", *map(line, rows), *(["", table.note] if table.note else [])])
