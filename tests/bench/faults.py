"""`make bench-faults`: every fault of the fault catalogue, many times, and how soon the line was safe.

Most rows are injected into the real loop, drivers and simulated devices in virtual time: random targets, at a random
phase of the period, seeded by row and number. Detection counts from the injection, not from the first period that
could see it, to the first command at the recorder that takes speed or torque away (or holds it); torque off counts to
zero torque at every drive. Rows about a balance of torques are in stepped time, some rows are repeated over real wires
in real time. What is about processes that die stands in `make bench-processes`.

ARGS="--injections 20 --rows frame-once,emcy --wire 0" measures less.
"""

import argparse
import logging
import os
from collections.abc import Callable, Iterator
from concurrent.futures import Future, ProcessPoolExecutor, as_completed
from dataclasses import dataclass, replace
from multiprocessing import get_context
from typing import Any

import numpy as np
from rich.progress import Progress

from tests.bench.faults_arming import TRANSACTION_BOUND_S, no_watchdog, sdo_abort
from tests.bench.faults_clock import wall_clock
from tests.bench.faults_lines import DEMO
from tests.bench.faults_rows import ROWS, T, Wanted
from tests.bench.faults_seen import Injection
from tests.bench.faults_stepped import DRIFT_BOUND_S, SATURATION_BOUND_S, drift, saturation
from tests.bench.faults_virtual import OBSERVED_PERIODS, injections
from tests.bench.faults_wire import SECOND_INSTANCE_BOUND_S, WIRE_ROWS, second_instance
from tests.bench.faults_wire import injections as wire_injections
from tests.bench.figures import Bench

INJECTIONS, WIRE_INJECTIONS = 200, 5
CHUNK = 20  #: injections of one task; most of them share a line
ROUNDING_S = 1e-6
NOTES_KEPT = 12  #: of injections that did not come out as they should, for each row
UNSEEN_S = OBSERVED_PERIODS * T  #: what counts for a reaction that did not come: it was waited for so long


@dataclass(frozen=True, slots=True)
class Judged:
    """A row as it is judged. `share` of the injections: some take long."""

    injected: str
    wanted: str
    bound: str
    bound_s: float
    share: float = 1.0
    one: Callable[[int], Injection] | None = None  #: for rows that are no rows of `faults_rows`


SPECIAL = {
    "sdo-abort": Judged("an SDO abort while arming", "refused", "1 s", TRANSACTION_BOUND_S, one=sdo_abort),
    "no-watchdog": Judged("a drive that refuses its watchdog", "refused", "before arming", 1.0, 0.2, no_watchdog),
    "wall-clock": Judged("the wall clock is set", "nothing", "-", 0.0, 0.2, wall_clock),
    "saturation": Judged("torque at its limit", "flag", "2 s + T", SATURATION_BOUND_S, 0.2, saturation),
    "cell-drift": Judged("a load cell drifts by 0.1 N/s (stepped time)", "flag", "60 s", DRIFT_BOUND_S, 0.1, drift),
}
#: Rows on further wirings, as row@wiring; the others are on the demonstration's (CANopen drives, Modbus cells and PLC).
ON_WIRINGS = {
    "canopen": ("frame-once", "frame-thrice", "heartbeat", "emcy", "stale-pdo", "cell-lost", "loop-dead"),
    "modbus": ("frame-once", "frame-thrice", "emcy", "frozen", "cell-lost", "encoder-twice", "loop-dead"),
    "opcua": ("emcy", "cell-once", "cell-lost", "encoder-twice", "loop-dead"),
    "mixed": ("frame-thrice", "emcy", "loop-dead"),
}
_ON_DEMO = {row.id: Judged(row.injected, row.wanted.value, row.bound, row.bound_s) for row in ROWS}
_ON_OTHERS = {
    f"{row_id}@{wiring}": replace(_ON_DEMO[row_id], share=0.3) for wiring, ids in ON_WIRINGS.items() for row_id in ids
}
JUDGED = _ON_DEMO | SPECIAL | _ON_OTHERS
SECOND_INSTANCE = Judged("a second loop is started", "refused", "1 s", SECOND_INSTANCE_BOUND_S)


def task(row_id: str, numbers: list[int]) -> list[Injection]:
    """Some injections of a row."""
    one = JUDGED[row_id].one
    if one is not None:
        return [one(number) for number in numbers]
    name, _, wiring = row_id.partition("@")
    found = injections(next(row for row in ROWS if row.id == name), numbers, wiring or DEMO)
    return [replace(injection, row=row_id) for injection in found]


def main() -> None:
    arguments = _arguments()
    rows = arguments.rows.split(",") if arguments.rows else list(JUDGED)
    if unknown := set(rows) - set(JUDGED):
        raise SystemExit(f"no such row: {', '.join(sorted(unknown))}; allowed: {', '.join(JUDGED)}")
    print(f"seeds: row and number, 0 to {arguments.injections - 1}", flush=True)
    virtual = _virtual(rows, arguments.injections, arguments.workers)
    wire = _wire(rows, arguments.wire)
    bench = Bench("faults-part" if arguments.rows or not arguments.wire else "faults", [0, arguments.injections - 1])
    bench.tables["rows"] = [_table_row(row_id, found) for row_id, found in virtual.items()]
    bench.tables["wire"] = [_table_row(row_id, found) for row_id, found in wire.items()]
    bench.tables["not as wanted"] = _notes(virtual) + _notes(wire)
    _figures(bench, virtual, wire)
    for title, name in (("virtual time", "rows"), ("real time", "wire")):
        _print(title, bench.tables[name])
    bench.finish()


def _arguments() -> argparse.Namespace:
    parser = argparse.ArgumentParser(prog="make bench-faults", description="The fault catalogue, many times.")
    parser.add_argument("--injections", type=int, default=INJECTIONS, help="of each row in virtual time")
    parser.add_argument("--rows", default="", help="only these, with commas between them; writes faults-part.json")
    parser.add_argument("--wire", type=int, default=WIRE_INJECTIONS, help="of each row in real time; 0 as for --rows")
    parser.add_argument("--workers", type=int, default=min(2, os.cpu_count() or 1))
    return parser.parse_args()


def _virtual(rows: list[str], count: int, workers: int) -> dict[str, list[Injection]]:
    found: dict[str, list[Injection]] = {row_id: [] for row_id in rows}
    work = list(_chunks(rows, count))
    with (
        Progress() as progress,
        ProcessPoolExecutor(workers, mp_context=get_context("spawn"), initializer=_be_quiet) as pool,
    ):
        bar = progress.add_task("virtual time", total=sum(len(numbers) for _, numbers in work))
        running: dict[Future[list[Injection]], int] = {
            pool.submit(task, row_id, numbers): len(numbers) for row_id, numbers in work
        }
        for done in as_completed(running):
            for injection in done.result():
                found[injection.row].append(injection)
            progress.advance(bar, running[done])
    return found


def _be_quiet() -> None:
    """In a worker: what pymodbus raises on a malformed answer is no news here."""
    logging.getLogger("asyncio").setLevel(logging.CRITICAL)


def _chunks(rows: list[str], count: int) -> Iterator[tuple[str, list[int]]]:
    for row_id in rows:
        numbers = list(range(max(1, round(count * JUDGED[row_id].share))))
        for first in range(0, len(numbers), CHUNK):
            yield row_id, numbers[first : first + CHUNK]


def _wire(rows: list[str], count: int) -> dict[str, list[Injection]]:
    found: dict[str, list[Injection]] = {}
    chosen = [row for row in WIRE_ROWS if row.id in rows]
    if not count:
        return found
    with Progress() as progress:
        bar = progress.add_task("real time", total=count * (len(chosen) + 1))
        for injection in [
            *wire_injections(chosen, count, lambda: progress.advance(bar)),
            *second_instance(count, lambda: progress.advance(bar)),
        ]:
            found.setdefault(injection.row, []).append(injection)
    return found


# what it comes to


def _is_met(row_id: str, injection: Injection) -> bool:
    judged = JUDGED.get(row_id, SECOND_INSTANCE)
    in_time = not judged.bound_s or (injection.detected_s or 0.0) <= judged.bound_s + ROUNDING_S
    return _is_wanted(judged, injection) and in_time and not injection.unsafe


def _is_wanted(judged: Judged, injection: Injection) -> bool:
    return judged.wanted in (Wanted.SAFE.value, injection.reaction)


def _table_row(row_id: str, found: list[Injection]) -> dict[str, Any]:
    judged = JUDGED.get(row_id, SECOND_INSTANCE)
    reactions = [injection.reaction for injection in found]
    return {
        "row": row_id,
        "injected": judged.injected,
        "wanted": judged.wanted,
        "bound": judged.bound,
        "injections": len(found),
        "reactions": {reaction: reactions.count(reaction) for reaction in sorted(set(reactions))},
        "detected_ms": _milliseconds([injection.detected_s for injection in found]),
        "from_first_period_ms": _milliseconds([injection.met_s for injection in found]),
        "torque_off_ms": _milliseconds([injection.torque_off_s for injection in found]),
        "unsafe": sum(sum(injection.unsafe.values()) for injection in found),
        "met": sum(_is_met(row_id, injection) for injection in found),
        "variants": {
            variant: _milliseconds([injection.detected_s for injection in found if injection.variant == variant])
            for variant in sorted({injection.variant for injection in found})
        },
    }


def _milliseconds(times_s: list[float | None]) -> dict[str, float] | None:
    """p50, p99 and the worst of those that there are."""
    there = [1e3 * time_s for time_s in times_s if time_s is not None]
    if not there:
        return None
    p50, p99 = np.percentile(there, [50, 99])
    return {"p50": round(float(p50), 2), "p99": round(float(p99), 2), "worst": round(max(there), 2)}


def _notes(found: dict[str, list[Injection]]) -> list[str]:
    """What came of injections that are not met, some of each row."""
    notes: list[str] = []
    for row_id, injections_ in found.items():
        missed = [injection for injection in injections_ if not _is_met(row_id, injection)]
        notes += [
            f"{row_id}, {i.variant}: {i.reaction} after {i.detected_s} s, unsafe {i.unsafe}; {i.note}"
            for i in missed[:NOTES_KEPT]
        ]
    return notes


def _figures(bench: Bench, virtual: dict[str, list[Injection]], wire: dict[str, list[Injection]]) -> None:
    everything = [injection for found in (*virtual.values(), *wire.values()) for injection in found]
    bench.figure("unsafe_events", sum(sum(i.unsafe.values()) for i in everything), "", len(everything))
    wrong = [not _is_wanted(JUDGED[i.row], i) for found in virtual.values() for i in found]
    bench.figure("wrong_reactions", sum(wrong), "", len(wrong))
    timed = virtual | {row_id: wire[row_id] for row_id in ("second-instance",) if row_id in wire}
    for row_id, found in timed.items():
        judged = JUDGED.get(row_id, SECOND_INSTANCE)
        if judged.bound_s and "@" not in row_id:
            worst_s = max(UNSEEN_S if i.detected_s is None else i.detected_s for i in found)
            bench.figure(f"{row_id}_ms", 1e3 * worst_s, "ms", len(found))


def _print(title: str, rows: list[dict[str, Any]]) -> None:
    print(f"\n{title:<22}{'wanted':<9}{'bound':>22}{'p50':>9}{'p99':>9}{'worst':>9}{'off':>8}{'unsafe':>8}  met")
    for row in rows:
        times = [row["detected_ms"] and row["detected_ms"][name] for name in ("p50", "p99", "worst")]
        off = row["torque_off_ms"] and row["torque_off_ms"]["worst"]
        shown = "".join(f"{'-' if time is None else format(time, '.1f'):>9}" for time in times)
        off_shown = "-" if off is None else format(off, ".0f")
        met = f"{row['met']} of {row['injections']}"
        print(f"{row['row']:<22}{row['wanted']:<9}{row['bound']:>22}{shown}{off_shown:>8}{row['unsafe']:>8}  {met}")


if __name__ == "__main__":
    main()
