"""`make bench-harm`: what may hurt by itself, on drawn lines of every size, judged by the recorder and the truth.

    python -m tests.bench.harm [--draws 200] [--healthy 2000] [--rows no-web,web-break] [--workers 2] [--first-seed N]
        [--go-on]

Each row is a fault that nobody meant: no web, a web that breaks, a value that is torn, a wire in the wrong place. Told
are which rule found it and after how long, whether anything unsafe came of it, and when the line was at rest. Healthy
lives beside them count what is found where nothing is wrong. Draws whose file `check` refuses, or for which there is no
controller, are left out and counted; so are those that do not keep their tensions in production before anything is
injected. The whole takes hours: what a draw gave is written at once to out/bench/harm.jsonl, and `--go-on` runs only
what is not there yet.
"""

import argparse
import os
from collections import Counter
from collections.abc import Callable
from dataclasses import asdict, dataclass
from functools import partial
from math import isfinite
from pathlib import Path
from typing import Any

import numpy as np

from tests.bench.figures import Bench
from tests.bench.harm_cells import decimals, in_service, tared, zeroed_at_rest
from tests.bench.harm_drives import drill_of_dead_watchdog, wrong_mode
from tests.bench.harm_lines import DRAW_SPANS, Drawn, any_span, drawn
from tests.bench.harm_runs import NEVER_S, NotStarted, Outcome, at_start, drawable, healthy, in_production, rest_bound_s
from tests.bench.harm_wiring import MISTAKES, proof
from tests.bench.kept_rows import KeptRows
from tests.bench.workers import Workers

FIRST_SEED = 31_000
DRAWS, HEALTHY = 200, 2000
FOUND, FOUND_PART = Path("out/bench/harm.jsonl"), Path("out/bench/harm-part.jsonl")
NOT_STARTED = "not started"
WIRED_RIGHT = "wired-right"  #: a line without a mistake: nothing may be found
PROVED_WITHIN_S = 3000.0
DRILLED_WITHIN_S = 5.0  #: of virtual time: named, and nothing else with it
NO_WEB_S = 2.0  #: until it is told, from when the slack that may be there, and what radii leave open, is used up
CELL_S = 1.0  #: from a cell that changes to the stop
BREAK_S = 0.05  #: five periods: from a web break to the first reaction
HEALTHY_ROWS = ("healthy", "healthy-draw")
ON_DRAW_LINES = ("web-break-draw", "healthy-draw")  #: on lines with draw-controlled spans that nothing measures
NOTES_KEPT = 12  #: of a row, of draws that did not come out as they should


@dataclass(frozen=True)
class Row:
    """A kind of fault. Bounds in s: NEVER_S where there is none; that of rest is of a seed's line."""

    run: Callable[[int], Outcome]
    found_bound_s: float
    rest_bound_s: Callable[[int], float] | None = None

    def is_late(self, one: Outcome) -> tuple[bool, bool]:
        """Whether it was found too late, or the line at rest."""
        if one.code == NOT_STARTED:  # nothing was injected: counted for itself
            return False, False
        rest_bound_s = NEVER_S if self.rest_bound_s is None else self.rest_bound_s(one.seed)
        return one.found_s > self.found_bound_s, one.rest_s > rest_bound_s


def _web_break(draw: Drawn, dice: np.random.Generator) -> str:
    return f"web {any_span(draw, dice)} web-break"


def _unmeasured_break(draw: Drawn, dice: np.random.Generator) -> str:
    return f"web {int(dice.choice(draw.size.draw_spans))} web-break"


def _cell_drift(draw: Drawn, dice: np.random.Generator) -> str:
    rate = 0.0036 * draw.size.tension_n * float(dice.choice((-1.0, 1.0)))  # 0.1 N/s of 28 N
    return f"load-cell {any_span(draw, dice)} drift rate_n_per_s={rate:.6g}"


def _torn(draw: Drawn, dice: np.random.Generator) -> str:
    """The low word of a value is that of the one before: off by a share of the cell's capacity, within it."""
    height_n = draw.size.tension_n * float(dice.uniform(0.6, 1.5)) * float(dice.choice((-1.0, 1.0)))
    return f"load-cell {any_span(draw, dice)} spike height_n={height_n:.6g}"


def _torque_share(draw: Drawn, dice: np.random.Generator) -> str:
    return f"drive {any_span(draw, dice)} torque-share share={float(dice.choice((0.0, 0.1, 0.3, 0.5, 2.0, 3.0))):g}"


def _mode_lost(draw: Drawn, dice: np.random.Generator) -> str:
    return f"drive {any_span(draw, dice)} mode-lost for 0.6"


def _web_missing(seed: int) -> Outcome:
    dice = np.random.default_rng([seed, 35])
    return at_start("web-missing", seed, [any_span(drawn(seed), dice)])


def _no_web(seed: int) -> Outcome:
    return at_start("no-web", seed, list(range(1, drawn(seed).size.spans + 1)))


ROWS = {
    # From when the slack that may be there is used up. Torque goes off then, and rollers coast, slow as they are.
    "no-web": Row(_no_web, NO_WEB_S),
    "web-missing": Row(_web_missing, NO_WEB_S),
    "web-break": Row(
        partial(in_production, "web-break", fault=_web_break, within_s=60.0, spared=("tension-band",)),
        BREAK_S,
        rest_bound_s,
    ),
    "web-break-draw": Row(
        partial(
            in_production, "web-break-draw", fault=_unmeasured_break, within_s=60.0, spared=("tension-band",)
        ),
        BREAK_S,
        rest_bound_s,
    ),
    "cell-torn": Row(partial(in_production, "cell-torn", fault=_torn, within_s=1.0), NEVER_S),
    # The torque of a drive that gives something else than it is asked moves faster than what it is asked, by itself.
    "torque-share": Row(
        partial(in_production, "torque-share", fault=_torque_share, within_s=60.0, spared=("torque-rate",)), 1.0
    ),
    "mode-lost": Row(
        partial(in_production, "mode-lost", fault=_mode_lost, within_s=60.0, spared=("torque-rate",)), 1.0
    ),
    "mode-wrong": Row(partial(wrong_mode, "mode-wrong"), 1.0),
    "watchdog-dead": Row(partial(drill_of_dead_watchdog, "watchdog-dead"), DRILLED_WITHIN_S),
    "cell-tared": Row(partial(in_service, "cell-tared", fault=tared), CELL_S),
    "cell-decimals": Row(partial(in_service, "cell-decimals", fault=decimals), CELL_S),
    "cell-zeroed": Row(partial(zeroed_at_rest, "cell-zeroed"), 0.0),
    "cell-drift": Row(partial(in_production, "cell-drift", fault=_cell_drift, within_s=90.0), 60.0),
    # Named, and nothing else with it, before the proof is over: late is what was not.
    **{
        name: Row(partial(proof, name, mistake=mistake), NEVER_S if name == WIRED_RIGHT else PROVED_WITHIN_S)
        for name, mistake in MISTAKES.items()
    },
}  # fmt: skip

#: Rows to be asked for by name: the same draws, stopped in the period of the fault. What no rule can be quicker than.
AT_ONCE = {
    f"{name}-at-once": Row(
        partial(
            in_production, f"{name}-at-once", fault=fault, within_s=60.0, spared=("torque-rate",), stopped_at_once=True
        ),
        NEVER_S,
    )
    for name, fault in (("torque-share", _torque_share), ("mode-lost", _mode_lost))
}
EVERY_ROW = {**ROWS, **AT_ONCE}

ON_WIRES = ("mode-wrong", "watchdog-dead")  #: of the demonstration's line, over wires drawn by the seed


def one(row: str, seed: int) -> Outcome | None:
    """None: no line of this seed can be had."""
    if row not in ON_WIRES and not drawable(seed):
        return None
    try:
        return healthy(row, seed) if row in HEALTHY_ROWS else EVERY_ROW[row].run(seed)
    except NotStarted as reason:
        return Outcome(row, seed, {}, NOT_STARTED, NEVER_S, NEVER_S, 0.0, str(reason))


def main() -> None:
    asked = _arguments()
    rows = asked.rows.split(",") if asked.rows else [*ROWS, *HEALTHY_ROWS]
    if unknown := set(rows) - {*EVERY_ROW, *HEALTHY_ROWS}:
        raise SystemExit(
            f"no such row: {', '.join(sorted(unknown))}; allowed: {', '.join([*EVERY_ROW, *HEALTHY_ROWS])}"
        )
    kept = KeptRows(FOUND_PART if asked.rows else FOUND, asked.go_on)
    found = _run(rows, asked, kept)
    bench = Bench("harm-part" if asked.rows else "harm", [asked.first_seed], goals_of="harm")
    bench.tables["rows"] = [_table_row(row, outcomes) for row, outcomes in found.items()]
    bench.tables["not as wanted"] = [note for row, outcomes in found.items() for note in _notes(row, outcomes)]
    bench.tables["draws by program"] = kept.made_by()
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
    parser.add_argument("--go-on", action="store_true", help="with what an earlier run has left")
    return parser.parse_args()


def _run(rows: list[str], asked: argparse.Namespace, kept: KeptRows) -> dict[str, list[Outcome]]:
    """By row, in the order of their seeds: of those draws that could be had."""
    wanted = [
        (row, asked.first_seed + number + (DRAW_SPANS if row in ON_DRAW_LINES else 0))
        for row in rows
        for number in range(_wanted(row, asked))
    ]
    found = {(each["row"], each["seed"]): each["outcome"] for each in kept}
    with Workers(asked.workers) as workers:
        open_ = [draw for draw in wanted if draw not in found]
        for (row, seed), outcome in workers.as_done(_one, open_, "draws"):
            found[row, seed] = outcome
            kept.add({"row": row, "seed": seed, "outcome": outcome})
    by_row = {row: [found[draw] for draw in wanted if draw[0] == row] for row in rows}
    return {row: [Outcome(**each) for each in outcomes if each is not None] for row, outcomes in by_row.items()}


def _one(draw: tuple[str, int]) -> tuple[tuple[str, int], dict[str, Any] | None]:
    outcome = one(*draw)
    return draw, None if outcome is None else asdict(outcome)


def _wanted(row: str, asked: argparse.Namespace) -> int:
    return asked.healthy if row in HEALTHY_ROWS else asked.draws


def _figures(bench: Bench, row: str, outcomes: list[Outcome]) -> None:
    count, name = len(outcomes), row.replace("-", "_")
    bench.figure(f"{name}_unsafe", sum(bool(one.unsafe) for one in outcomes), "", count)
    if row in HEALTHY_ROWS:
        bench.figure(f"{name}_found", sum(bool(one.code) for one in outcomes), "", count)
        return
    if row == WIRED_RIGHT:
        bench.figure("wired_right_found", sum(bool(one.code) for one in outcomes), "", count)
        return
    bench.figure(f"{name}_not_started", sum(one.code == NOT_STARTED for one in outcomes), "", count)
    wanted = EVERY_ROW[row]
    if isfinite(wanted.found_bound_s):
        bench.figure(f"{name}_found_late", sum(wanted.is_late(one)[0] for one in outcomes), "", count)
    if wanted.rest_bound_s is not None:
        bench.figure(f"{name}_rest_late", sum(wanted.is_late(one)[1] for one in outcomes), "", count)


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
        if row in (*HEALTHY_ROWS, WIRED_RIGHT):
            return not one.code and not one.unsafe
        return not one.unsafe and one.code != NOT_STARTED and not any(EVERY_ROW[row].is_late(one))

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
