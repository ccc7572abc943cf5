"""`make bench-control`: the paper's cases under every tier, each law beside the oracle, in parts:

    a  every law on S_real under tiers P, A, A-fast and B, designed on S_sim and on the truth; the other boundary
    b  the ensemble of random plants around S_sim
    c  the paper's two tables beside ours
    d  compute time of a step
    e  rollouts a second
    f  growth with the number of spans
    g  independent checks of solver and designs
    h  after one and two adaptations: S_real under every tier, the ensemble, rollers that differ, lines beyond

Writes out/bench/control.json, .md and .html; of a part of it, out/bench/control-part.*.
"""

import argparse
import sys
import time
from datetime import UTC, datetime
from math import isfinite

from gateway.cli.report import Section
from gateway.cli.tiers import TIERS
from tests.bench.control_adaptation import after_adaptation, rmse_after
from tests.bench.control_checks import checks
from tests.bench.control_compute import compute, p50_ms
from tests.bench.control_ensemble import on_ensemble
from tests.bench.control_growth import growth
from tests.bench.control_page import drawings, write
from tests.bench.control_paper import beside_the_paper
from tests.bench.control_plants import TEST
from tests.bench.control_real import on_real
from tests.bench.control_rollouts import rollouts
from tests.bench.control_runs import LAWS, Runs
from tests.bench.control_tables import SEEDS, Given, Part
from tests.bench.figures import LIBRARIES, Bench

PARTS = "abcdefgh"
SOLVERS = ("osqp", "piqp", "clarabel", "control")


def main() -> None:
    given, wanted = _arguments()
    whole = (
        given.tiers == tuple(TIERS.values())
        and given.laws == tuple(LAWS)
        and (given.seeds, given.plants) == (SEEDS, len(TEST))
        and wanted == set(PARTS)
    )
    bench = Bench(
        "control" if whole else "control-part", list(range(given.seeds)), command=given.command,
        libraries=(*LIBRARIES, *SOLVERS), goals_of="control", date=given.when,
    )  # fmt: skip
    parts, drawn = _measured(given, wanted)
    for part in parts.values():
        for name, value, unit, n in part.figures:
            if isfinite(value):
                bench.figure(name, value, unit, n)
            else:
                print(f"{name}: no figure, {value}")
        bench.tables |= {table.caption: {"heads": table.heads, "rows": table.rows} for table in part.section.tables}
    for letter, name in (
        ("a", "unsafe_events"),
        ("b", "ensemble_unsafe_events"),
        ("c", "sim_unsafe_events"),
        ("h", "adapted_unsafe_events"),
    ):
        if letter in parts and parts[letter].runs:
            bench.figure(name, parts[letter].unsafe, "", parts[letter].runs)
    write(given, bench, [parts[letter] for letter in sorted(parts)], drawn)
    bench.finish()


def _measured(given: Given, wanted: set[str]) -> tuple[dict[str, Part], list[Section]]:
    """The parts by letter. What takes time of its own is measured first, with nothing beside it."""
    parts: dict[str, Part] = {}
    alone = {"d": compute, "e": rollouts, "f": growth, "g": checks}
    for letter, measure in alone.items():
        if letter in wanted:
            with _Timed(letter):
                parts[letter] = measure(given)
    drawn: list[Section] = []
    with Runs() as runs:
        if "a" in wanted:
            with _Timed("a"):
                parts["a"] = on_real(given, runs)
                drawn = drawings(given, runs)
        if "b" in wanted:
            with _Timed("b"):
                parts["b"] = on_ensemble(given, runs)
        if "h" in wanted:
            with _Timed("h"):
                parts["h"] = after_adaptation(given, runs)
        if "c" in wanted:
            with _Timed("c"):
                compute_ms = p50_ms(parts["d"]) if "d" in parts else {}
                adapted_n = rmse_after(parts["h"]) if "h" in parts else {}
                parts["c"] = beside_the_paper(given, runs, compute_ms, adapted_n)
    return parts, drawn


class _Timed:
    """Says how long a part has taken."""

    def __init__(self, letter: str) -> None:
        self._letter = letter

    def __enter__(self) -> None:
        self._began_s = time.monotonic()

    def __exit__(self, *_: object) -> None:
        print(f"part {self._letter}: {time.monotonic() - self._began_s:.0f} s", flush=True)


def _arguments() -> tuple[Given, set[str]]:
    parser = argparse.ArgumentParser(
        prog="make bench-control", description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--seeds", type=_count(SEEDS), default=SEEDS, help=f"on S_real, 1 to {SEEDS}")
    parser.add_argument(
        "--plants", type=_count(len(TEST)), default=len(TEST), help=f"of the ensemble, 1 to {len(TEST)}"
    )
    parser.add_argument("--tiers", type=_some(TIERS), default=tuple(TIERS), help=",".join(TIERS))
    parser.add_argument("--laws", type=_some(LAWS), default=tuple(LAWS), help=",".join(LAWS))
    parser.add_argument("--parts", type=_some(PARTS), default=tuple(PARTS), help=",".join(PARTS))
    args = parser.parse_args()
    more = " ".join(f"'{word}'" if " " in word else word for word in sys.argv[1:])
    return Given(
        command=f'make bench-control ARGS="{more}"' if more else "make bench-control",
        when=datetime.now(UTC).isoformat(timespec="seconds"),
        tiers=tuple(tier for name, tier in TIERS.items() if name in args.tiers),
        laws=tuple(law for law in LAWS if law in args.laws),
        seeds=args.seeds,
        plants=args.plants,
    ), set(args.parts)


def _count(most: int):
    def parse(text: str) -> int:
        if not text.isdecimal() or not 1 <= int(text) <= most:
            raise argparse.ArgumentTypeError(f"{text} is not 1 to {most}")
        return int(text)

    return parse


def _some(known):
    def parse(text: str) -> tuple[str, ...]:
        names = tuple(text.split(","))
        if unknown := [name for name in names if name not in known]:
            raise argparse.ArgumentTypeError(f"unknown: {', '.join(unknown)}; allowed: {', '.join(known)}")
        return names

    return parse


if __name__ == "__main__":
    main()
