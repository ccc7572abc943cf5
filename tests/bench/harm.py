"""`make bench-harm`: what may hurt by itself, on drawn lines of every size, judged by the recorder and the truth.

    python -m tests.bench.harm [--draws 200] [--healthy 2000] [--rows no-web,web-break] [--workers 2] [--first-seed N]

Each row is a fault that nobody meant: no web, a web that breaks, a value that is torn. Told are which rule found it and
after how long, whether anything unsafe came of it, and when the line was at rest. Healthy lives beside them count what
is found where nothing is wrong. Draws whose file `check` refuses, or for which there is no controller, are left out and
counted.
"""

import argparse
import os
from collections import Counter
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor, as_completed
from dataclasses import dataclass
from functools import partial
from math import isfinite
from multiprocessing import get_context

import numpy as np
from rich.progress import Progress

from tests.bench.figures import Bench
from tests.bench.harm_lines import Drawn, drawn
from tests.bench.harm_runs import NEVER_S, NotStarted, Outcome, at_start, drawable, healthy, in_production

FIRST_SEED = 31_000
DRAWS, HEALTHY = 200, 2000
NOTES_KEPT = 12  #: of a row, of draws that did not come out as they should


@dataclass(frozen=True)
class Row:
    """A kind of fault. Bounds in s: NEVER_S where there is none."""

    run: Callable[[int], Outcome]
    found_bound_s: float
    rest_bound_s: float = NEVER_S


def _span(draw: Drawn, dice: np.random.Generator) -> int:
    return int(dice.integers(1, draw.size.spans + 1))


def _web_break(draw: Drawn, dice: np.random.Generator) -> str:
    return f"web {_span(draw, dice)} web-break"


def _cell_drift(draw: Drawn, dice: np.random.Generator) -> str:
    rate = 0.0036 * draw.size.tension_n * float(dice.choice((-1.0, 1.0)))  # 0.1 N/s of 28 N
    return f"load-cell {_span(draw, dice)} drift rate_n_per_s={rate:.6g}"


def _torn(draw: Drawn, dice: np.random.Generator) -> str:
    """The low word of a value is that of the one before: off by a share of the cell's capacity, within it."""
    height_n = draw.size.tension_n * float(dice.uniform(0.6, 1.5)) * float(dice.choice((-1.0, 1.0)))
    return f"load-cell {_span(draw, dice)} spike height_n={height_n:.6g}"


def _web_missing(seed: int) -> Outcome:
    dice = np.random.default_rng([seed, 35])
    return at_start("web-missing", seed, [_span(drawn(seed), dice)])


def _no_web(seed: int) -> Outcome:
    return at_start("no-web", seed, list(range(1, drawn(seed).size.spans + 1)))


ROWS = {
    "no-web": Row(_no_web, NEVER_S),
    "web-missing": Row(_web_missing, NEVER_S),
    "web-break": Row(
        partial(in_production, "web-break", fault=_web_break, within_s=60.0, spared=("tension-band",)), 0.05, 10.0
    ),
    "cell-torn": Row(partial(in_production, "cell-torn", fault=_torn, within_s=1.0), NEVER_S),
    "cell-drift": Row(partial(in_production, "cell-drift", fault=_cell_drift, within_s=90.0), 60.0),
}  # fmt: skip


def one(row: str, seed: int) -> Outcome | None:
    """None: no line of this seed can be had."""
    if not drawable(seed):
        return None
    try:
        return healthy("healthy", seed) if row == "healthy" else ROWS[row].run(seed)
    except NotStarted as reason:
        return Outcome(row, seed, {}, "not started", NEVER_S, NEVER_S, 0.0, str(reason))


def main() -> None:
    asked = _arguments()
    rows = asked.rows.split(",") if asked.rows else [*ROWS, "healthy"]
    if unknown := set(rows) - {*ROWS, "healthy"}:
        raise SystemExit(f"no such row: {', '.join(sorted(unknown))}; allowed: {', '.join([*ROWS, 'healthy'])}")
    found = _run(rows, asked)
    bench = Bench("harm-part" if asked.rows else "harm", [asked.first_seed], goals_of="harm")
    bench.tables["rows"] = [_table_row(row, outcomes) for row, outcomes in found.items()]
    bench.tables["not as wanted"] = [note for row, outcomes in found.items() for note in _notes(row, outcomes)]
    for row, outcomes in found.items():
        _figures(bench, row, outcomes)
        bench.figure(f"{row.replace('-', '_')}_left_out", _wanted(row, asked) - len(outcomes), "", _wanted(row, asked))
    _print(bench)
    bench.finish()


def _arguments() -> argparse.Namespace:
    parser = argparse.ArgumentParser(prog="make bench-harm", description="What may hurt by itself, on drawn lines.")
    parser.add_argument("--draws", type=int, default=DRAWS, help="of each row")
    parser.add_argument("--healthy", type=int, default=HEALTHY, help="lives in which nothing is wrong")
    parser.add_argument("--rows", default="", help="only these, with commas between them; writes harm-part.json")
    parser.add_argument("--first-seed", type=int, default=FIRST_SEED)
    parser.add_argument("--workers", type=int, default=min(2, os.cpu_count() or 1))
    return parser.parse_args()


def _run(rows: list[str], asked: argparse.Namespace) -> dict[str, list[Outcome]]:
    found: dict[str, list[Outcome]] = {row: [] for row in rows}
    wanted = {row: _wanted(row, asked) for row in rows}
    with Progress() as progress, ProcessPoolExecutor(asked.workers, mp_context=get_context("spawn")) as pool:
        bar = progress.add_task("draws", total=sum(wanted.values()))
        running = {pool.submit(one, row, asked.first_seed + number) for row in rows for number in range(wanted[row])}
        for done in as_completed(running):
            if (outcome := done.result()) is not None:
                found[outcome.row].append(outcome)
            progress.advance(bar)
    return found


def _wanted(row: str, asked: argparse.Namespace) -> int:
    return asked.healthy if row == "healthy" else asked.draws


def _figures(bench: Bench, row: str, outcomes: list[Outcome]) -> None:
    count, name = len(outcomes), row.replace("-", "_")
    bench.figure(f"{name}_unsafe", sum(bool(one.unsafe) for one in outcomes), "", count)
    if row == "healthy":
        bench.figure("healthy_found", sum(bool(one.code) for one in outcomes), "", count)
        return
    wanted = ROWS[row]
    if isfinite(wanted.found_bound_s):
        bench.figure(f"{name}_found_late", sum(one.found_s > wanted.found_bound_s for one in outcomes), "", count)
    if isfinite(wanted.rest_bound_s):
        bench.figure(f"{name}_rest_late", sum(one.rest_s > wanted.rest_bound_s for one in outcomes), "", count)


def _table_row(row: str, outcomes: list[Outcome]) -> dict[str, object]:
    found = sorted(one.found_s for one in outcomes if isfinite(one.found_s))
    rest = sorted(one.rest_s for one in outcomes if isfinite(one.rest_s))
    return {
        "row": row, "draws": len(outcomes), "unsafe": sum(bool(one.unsafe) for one in outcomes), "found": len(found),
        "found_s": _percentiles(found), "rest_s": _percentiles(rest), "at rest": len(rest),
        "fastest": max((one.fastest for one in outcomes), default=0.0),
        "by": dict(Counter(one.code for one in outcomes).most_common(5)),
    }  # fmt: skip


def _percentiles(values: list[float]) -> list[float]:
    """p50, p99, worst."""
    if not values:
        return []
    return [round(float(np.quantile(values, share)), 3) for share in (0.5, 0.99, 1.0)]


def _notes(row: str, outcomes: list[Outcome]) -> list[dict[str, object]]:
    def is_wanted(one: Outcome) -> bool:
        if row == "healthy":
            return not one.code and not one.unsafe
        bounds = ROWS[row]
        return not one.unsafe and one.found_s <= bounds.found_bound_s and one.rest_s <= bounds.rest_bound_s

    against = [one for one in outcomes if not is_wanted(one)][:NOTES_KEPT]
    return [{"row": row, "seed": one.seed, "unsafe": one.unsafe, "code": one.code, "note": one.note} for one in against]


def _print(bench: Bench) -> None:
    for row in bench.tables["rows"]:
        print(f"{row['row']:<12} {row['draws']:>5} draws, unsafe {row['unsafe']}, found {row['found']} after "
              f"{row['found_s']} s, at rest {row['at rest']} after {row['rest_s']} s, fastest {row['fastest']:.2f} of "
              f"the top speed, by {row['by']}")  # fmt: skip
    for note in bench.tables["not as wanted"]:
        print(f"  {note['row']} {note['seed']}: {note['code']} {note['unsafe']} {note['note']}")


if __name__ == "__main__":
    main()
