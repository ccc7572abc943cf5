"""`make bench-cycle`: how late the loop wakes, how long a cycle takes, what it costs; beside the floor of this machine.

Slices of loop and floor alternate, so that both see the same weather. docs/timing.md says what is measured, and how.
"""

import argparse
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from math import ceil
from typing import Any, get_args

import numpy as np
from numpy.typing import NDArray

from gateway.core.line_file import load_line
from gateway.core.line_template import line_template
from tests.bench.figures import Bench
from tests.bench.floor import lateness_us, overruns, require_cyclictest
from tests.bench.lines import UDP_MULTICAST, WIRINGS, CanWire
from tests.bench.slices import Disturbance, NotRun, Slice, loop_cpu, loop_slice

KINDS = ("canopen", "modbus", "opcua", "mixed")
SLICE_S = 20.0
DISTURBED_RATE_HZ = 200
DISTURBANCES: tuple[Disturbance, ...] = get_args(Disturbance)
PRIORITY = load_line(line_template(), "line.toml").control.priority


@dataclass(frozen=True, slots=True)
class Settings:
    kinds: Sequence[str]
    rates_hz: Sequence[int]
    slices: int
    slice_s: float
    disturbed_kinds: Sequence[str]
    disturbed_rate_hz: int


@dataclass
class Cell:
    """All slices of one kind of line at one rate; `floor_us` of the slices of the floor between them."""

    kind: str
    rate_hz: int
    slices: list[Slice] = field(default_factory=list[Slice])
    not_run: list[str] = field(default_factory=list[str])  #: slices for which the line did not come to run, and why
    floor_us: NDArray[np.int64] = field(default_factory=lambda: np.empty(0, dtype=np.int64))

    @property
    def period_s(self) -> float:
        return 1.0 / self.rate_hz

    @property
    def periods(self) -> int:
        return len(self.lateness_us)

    @property
    def lateness_us(self) -> NDArray[np.float64]:
        return np.concatenate([one.lateness_us for one in self.slices])

    @property
    def cycle_us(self) -> NDArray[np.float64]:
        return np.concatenate([one.cycle_us for one in self.slices])

    @property
    def missed(self) -> int:
        return sum(one.missed for one in self.slices)

    def worst(self, value: Callable[[Slice], float]) -> float:
        return max(map(value, self.slices))

    def run(self, for_s: float, can: CanWire = UDP_MULTICAST, disturbance: Disturbance = "none") -> None:
        try:
            self.slices.append(loop_slice(self.kind, self.period_s, for_s, can, disturbance))
        except NotRun as error:
            self.not_run.append(str(error))
            print(f"NOT RUN: {error}", flush=True)

    def run_floor(self, for_s: float) -> None:
        found = lateness_us(loop_cpu(), PRIORITY, self.period_s, for_s)
        self.floor_us = np.concatenate([self.floor_us, found])

    def row(self) -> dict[str, Any]:
        """For the tables."""
        return {
            "line": self.kind,
            "rate_hz": self.rate_hz,
            "periods": self.periods,
            "lateness_us": spread(self.lateness_us),
            "cycle_us": spread(self.cycle_us),
            "missed": self.missed,
            "lost_frames": sum(one.lost_frames for one in self.slices),
            "floor_us": spread(self.floor_us) if self.floor_us.size else None,
            "floor_periods": len(self.floor_us),
            "floor_missed": overruns(self.floor_us, self.period_s),
            "first_cycle_s": [round(one.first_cycle_s, 3) for one in self.slices],
            "rss_mb": round(self.worst(lambda one: one.rss_mb), 1),
            "peak_rss_mb": round(self.worst(lambda one: one.peak_rss_mb), 1),
            "helpers_rss_mb": round(self.worst(lambda one: one.helpers_rss_mb), 1),
            "cpu_share": round(float(np.mean([one.cpu_share for one in self.slices])), 4),
            "reader_answers": sum(one.answers for one in self.slices),
            "unsafe_events": [event for one in self.slices for event in one.unsafe],
            "stops": [text for one in self.slices for text in one.stops],
        }


def spread(values_us: NDArray[Any]) -> dict[str, float]:
    p50, p99, p999 = np.percentile(values_us, (50, 99, 99.9))
    return {
        "p50": round(p50, 1),
        "p99": round(p99, 1),
        "p99.9": round(p999, 1),
        "max": round(float(values_us.max()), 1),
    }


def p99(values_us: NDArray[Any]) -> float:
    return float(np.percentile(values_us, 99))


def main() -> None:
    settings = _settings()
    require_cyclictest()
    bench = Bench("cycle", [1])
    bench.tables["settings"] = {
        "lines": list(settings.kinds),
        "rates_hz": list(settings.rates_hz),
        "slices": settings.slices,
        "slice_s": settings.slice_s,
        "processor": loop_cpu(),
        "priority": PRIORITY,
    }
    cells = undisturbed(bench, settings)
    disturbed = disturbances(bench, settings)
    wired = wire_time(bench, settings)
    everything = [*cells, *disturbed, *wired]
    periods = sum(cell.periods for cell in everything)
    bench.figure("unsafe_events", sum(len(one.unsafe) for cell in everything for one in cell.slices), "", periods)
    bench.figure("stops", sum(len(one.stops) for cell in everything for one in cell.slices), "", periods)
    bench.figure("slices_not_run", sum(len(cell.not_run) for cell in everything), "", periods)
    bench.tables["not_run"] = [text for cell in everything for text in cell.not_run]
    bench.tables["cells"] = [cell.row() for cell in cells if cell.slices]
    bench.finish()


def undisturbed(bench: Bench, settings: Settings) -> list[Cell]:
    """Every kind at every rate, each slice after a slice of the floor."""
    cells = [Cell(kind, rate) for kind in settings.kinds for rate in settings.rates_hz]
    for cell in cells:
        for _ in range(settings.slices):
            cell.run_floor(settings.slice_s)
            cell.run(settings.slice_s)
        told(cell)
    every, cells = cells, [cell for cell in cells if cell.slices]
    if not cells:
        raise SystemExit("no line came to run")
    worst = max(cells, key=lambda cell: p99(cell.lateness_us) / p99(cell.floor_us))
    bench.figure("lateness_p99_us", max(p99(cell.lateness_us) for cell in cells), "us", worst.periods)
    bench.figure("lateness_p99_to_floor", p99(worst.lateness_us) / p99(worst.floor_us), "x", worst.periods)
    for kind in settings.kinds:
        of_kind = [cell for cell in cells if cell.kind == kind]
        if not of_kind:
            continue
        slowest = max(of_kind, key=lambda cell: p99(cell.cycle_us))
        bench.figure(f"cycle_p99_{kind}_us", p99(slowest.cycle_us), "us", slowest.periods)
    beyond = sum(max(0, cell.missed - overruns(cell.floor_us, cell.period_s)) for cell in cells)
    bench.figure("missed_beyond_floor", beyond, "", sum(cell.periods for cell in cells))
    slices = sum(len(cell.slices) for cell in cells)
    bench.figure("rss_mb", max(cell.worst(lambda one: one.rss_mb) for cell in cells), "MB", slices)
    with_helpers = max(cell.worst(lambda one: one.rss_mb + one.helpers_rss_mb) for cell in cells)
    bench.figure("rss_with_helpers_mb", with_helpers, "MB", slices)
    bench.figure("cpu_share", max(cell.worst(lambda one: one.cpu_share) for cell in cells), "cpus", slices)
    bench.figure("first_cycle_s", max(cell.worst(lambda one: one.first_cycle_s) for cell in cells), "s", slices)
    return every


def disturbances(bench: Bench, settings: Settings) -> list[Cell]:
    """The same with a busy processor, and with a reader at full speed, each held against quiet slices in between."""
    rows: list[dict[str, Any]] = []
    every: list[Cell] = []
    ratios: dict[str, list[float]] = {}
    for kind in settings.disturbed_kinds:
        cells: dict[Disturbance, Cell] = {name: Cell(kind, settings.disturbed_rate_hz) for name in DISTURBANCES}
        for _ in range(ceil(settings.slices / 2)):
            for disturbance, cell in cells.items():
                cell.run(settings.slice_s, disturbance=disturbance)
        every += cells.values()
        quiet = cells["none"]
        for disturbance, cell in cells.items():
            if not (cell.slices and quiet.slices):
                continue
            told(cell, disturbance)
            rows.append({"disturbance": disturbance, **cell.row()})
            if cell is not quiet:
                name = disturbance.replace(" ", "_").replace("-", "_")
                for what in ("lateness_us", "cycle_us"):
                    ratio = p99(getattr(cell, what)) / p99(getattr(quiet, what))
                    ratios.setdefault(f"{name}_{what[:-3]}_p99_ratio", []).append(ratio)
    periods = min((cell.periods for cell in every if cell.slices), default=0)
    for name, found in ratios.items():
        bench.figure(name, max(found), "x", periods)
    bench.tables["disturbed"] = rows
    return every


def wire_time(bench: Bench, settings: Settings) -> list[Cell]:
    """With the time that frames take on a real bus, for the kinds that have one. No goal: the bus sets the pace."""
    cells = [
        Cell(kind, settings.disturbed_rate_hz) for kind in settings.disturbed_kinds if WIRINGS[kind].uses("canopen")
    ]
    for cell in cells:
        cell.run(settings.slice_s, CanWire(wire_time=True))
        if not cell.slices:
            continue
        told(cell, "wire time")
        bench.figure(f"wire_time_cycle_p99_{cell.kind}_us", p99(cell.cycle_us), "us", cell.periods)
    bench.tables["wire_time"] = [cell.row() for cell in cells if cell.slices]
    return cells


def told(cell: Cell, what: str = "") -> None:
    """One line for whoever waits."""
    if not cell.slices:
        return
    floor = f", floor {p99(cell.floor_us):.0f}" if cell.floor_us.size else ""
    print(
        f"{cell.kind} {cell.rate_hz} Hz {what}: p99 of lateness {p99(cell.lateness_us):.0f} us{floor}, "
        f"of the cycle {p99(cell.cycle_us):.0f} us; {cell.missed} of {cell.periods} missed",
        flush=True,
    )


def _settings() -> Settings:
    parser = argparse.ArgumentParser(prog="make bench-cycle", description=__doc__)
    parser.add_argument("--seconds", type=float, default=60.0, help="of the loop per line and rate (default 60)")
    parser.add_argument("--rates", type=_list(int), default=[100, 200, 250], help="in Hz (default 100,200,250)")
    parser.add_argument("--lines", type=_list(_kind), default=list(KINDS), help=f"(default {','.join(KINDS)})")
    parser.add_argument("--quick", action="store_true", help="a smoke run: one rate, 3 s, disturbances of one line")
    given = parser.parse_args()
    if given.quick:
        return Settings(given.lines, given.rates[:1], 1, 3.0, given.lines[:1], given.rates[0])
    slices = max(1, round(given.seconds / SLICE_S))
    rate = DISTURBED_RATE_HZ if DISTURBED_RATE_HZ in given.rates else given.rates[0]
    return Settings(given.lines, given.rates, slices, given.seconds / slices, given.lines, rate)


def _list(kind: Callable[[str], Any]) -> Callable[[str], list[Any]]:
    return lambda text: [kind(part) for part in text.split(",")]


def _kind(text: str) -> str:
    if text not in KINDS:
        raise argparse.ArgumentTypeError(f"{text!r} is no kind of line: {', '.join(KINDS)}")
    return text


if __name__ == "__main__":
    main()
