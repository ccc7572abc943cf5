"""A page of sections with tables and charts, as frozen data: what benchmarks and studies have to say.

All text is plain: the rendering escapes it. Arrays have one entry per sample, NaN for "not measured", drawn as a gap.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from datetime import datetime

import numpy as np

from gateway.cli.report.data import FloatArray
from gateway.core.verdict import Verdict

LARGEST = 3e38  #: that the page can carry


@dataclass(frozen=True, slots=True)
class Table:
    """Raises ValueError where a row has not as many cells as there are heads, or a numeric column does not exist."""

    caption: str
    heads: tuple[str, ...]  #: "Quantity, unit"; the first column names the rows
    rows: tuple[tuple[str, ...], ...]
    numeric: frozenset[int] = frozenset()  #: columns (from 0) whose cells are numbers
    foot: tuple[str, ...] | None = None
    note: str = ""  #: below it

    def __post_init__(self) -> None:
        where, width = f"table {self.caption!r}", len(self.heads)
        for i, row in enumerate((*self.rows, *(() if self.foot is None else (self.foot,)))):
            if len(row) != width:
                raise ValueError(f"{where}: row {i} has {len(row)} cells for {width} heads")
        if not self.numeric <= set(range(width)):
            raise ValueError(f"{where}: numeric columns are {sorted(self.numeric)}; allowed: 0 to {width - 1}")


@dataclass(frozen=True, slots=True)
class Fold:
    """What a reader opens who wants to know it word by word."""

    title: str
    text: str


@dataclass(frozen=True, slots=True)
class Story:
    """Something that happened, told from its beginning to its end, with the details folded away."""

    title: str
    paragraphs: tuple[str, ...] = ()
    tables: tuple[Table, ...] = ()
    lead: str = ""  #: whose words follow
    quote: str = ""  #: somebody's own words
    after: tuple[str, ...] = ()  #: paragraphs behind them
    folds: tuple[Fold, ...] = ()
    facts: tuple[tuple[str, tuple[str, ...]], ...] = ()  #: names, and what is said of each; before the tables
    verdict: Verdict | None = None  #: what the gate has found of it, before the folds


@dataclass(frozen=True, slots=True, eq=False)
class Series:
    name: str
    values: FloatArray  #: (k,)
    dashed: bool = False  #: a reference, such as a set-point or a goal


@dataclass(frozen=True, slots=True, eq=False)
class Chart:
    """Series over one x. Where as many are dashed as are not, each dashed one has the colour of the other of its place.

    Raises ValueError where shapes disagree, x does not increase, or a value cannot be drawn.
    """

    title: str
    unit: str
    x: FloatArray  #: (k,)
    series: tuple[Series, ...]
    x_label: str = "Time, s"
    log_y: bool = False
    points: bool = False  #: mark the samples: there are few

    def __post_init__(self) -> None:
        where, k = f"chart {self.title!r}", len(self.x)
        if self.x.ndim != 1 or k < 2 or not np.isfinite(self.x).all() or not (np.diff(self.x) > 0).all():
            raise ValueError(f"{where}: x must have two finite samples or more, and increase from each to the next")
        if not self.series:
            raise ValueError(f"{where}: no series; at least one is needed")
        for one in self.series:
            what = f"{where}: {one.name!r}"
            if one.values.shape != (k,):
                raise ValueError(f"{what} has shape {one.values.shape}; {(k,)} is needed")
            if (np.abs(one.values) > LARGEST).any():
                raise ValueError(f"{what} holds a value beyond {LARGEST:g}; give NaN for what was not measured")
            if self.log_y and (one.values.astype(np.float32) <= 0.0).any():
                raise ValueError(f"{what} holds a value of 0 or below, which a logarithmic scale has no place for")

    @property
    def colours(self) -> tuple[int, ...]:
        """Index of the colour of each series."""
        dashed = [one.dashed for one in self.series]
        if 2 * sum(dashed) != len(dashed):
            return tuple(range(len(dashed)))
        return tuple(sum(other is flag for other in dashed[:i]) for i, flag in enumerate(dashed))


@dataclass(frozen=True, slots=True)
class Section:
    title: str
    paragraphs: tuple[str, ...] = ()
    tables: tuple[Table, ...] = ()
    charts: tuple[Chart, ...] = ()
    stories: tuple[Story, ...] = ()  #: before the charts


@dataclass(frozen=True, slots=True)
class Page:
    """Raises ValueError when `when` is no ISO date, or nothing is said first."""

    title: str
    origin: str  #: what was looked at: a line, a plant, a study
    when: str  #: ISO 8601
    command: str  #: that makes this page again
    versions: Mapping[str, str]  #: by name of the program or library
    machine: str
    answer: tuple[str, ...]  #: the first sentences a reader sees
    sections: tuple[Section, ...]
    notes: tuple[str, ...] = ()
    audit_head: str = ""  #: NUMBER:HASH of the line's audit when this was made; empty: there is none

    def __post_init__(self) -> None:
        datetime.fromisoformat(self.when)
        if not self.answer:
            raise ValueError("a page needs an answer: the sentences that its reader sees first")
