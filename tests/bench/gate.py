"""`make bench-gate`: does the gate stop what would hurt a line, and nothing else? In parts:

    a  proposals of many classes on S_real and random lines: verdicts beside the truth, of the test half
    b  chains of small steps by an adversary who knows the truth
    c  bytes at the level of the format: mutations of valid proposals
    d  new lines commissioned through the gate, from the line's file to the highest speed (only where it is asked for)
    e  models held against new data of their own line, with friction, lag and eccentric rollers

The truth is told by tests/independent, which shares nothing with the gate; only what the loop refuses to do at once is
told by the product. Known good is what is safe there in every
case, 4 ms later too and under the rules' own stress around the truth, in no metric worse than what is in service and
than the baseline, and by 3 % better in one (docs/gate.md). In half of the contexts what is in service is tuned, in the
others poor but safe. Lines are made once for a state of the code, and kept in out/bench/gate-lines.

Writes out/bench/gate.json; of a part of it, out/bench/gate-part.json. Two processes at a time.
"""

import argparse
import sys
import time
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np
from scipy.stats import beta

from gateway.identification.identify import NotIdentified
from tests.bench.figures import Bench
from tests.bench.gate_adversary import Chain, chain
from tests.bench.gate_commissioning import bench_commissioning
from tests.bench.gate_contexts import gate_line
from tests.bench.gate_plants import is_for_tuning
from tests.bench.gate_proposals import CLASSES, Asked, mpc_proposals, proposals
from tests.bench.gate_runs import LineBench, Tried, measured
from tests.bench.gate_schema import Tally, mutated
from tests.bench.gate_validity import bench_validity
from tests.bench.workers import Workers

PARTS, ASKED_FOR = "abce", "d"  #: of the latter only what is named
SEED = 6100
DRAWS = 8  #: of proposals for a line, at most
CANDIDATES = 60  #: numbers of lines from which those are taken that the file's own controller holds
PAPER_RULE = "paper: approve"
PIECE = 20_000  #: mutations that a worker makes at a time


@dataclass(frozen=True)
class Sizes:
    plants: int = 21  #: S_real and random ones, half of these for tuning
    proposals: int = 4000
    predictive: int = 42
    chains: int = 60
    schema: int = 1_000_000
    models: int = 100


@dataclass(frozen=True)
class OfLine:
    """Of part a, of a line; `why` it has none, where its data give no model."""

    number: int
    tried: list[Tried]
    in_service: dict[str, str]  #: by context: what is unsafe about what runs there
    why: str = ""


def main() -> None:
    sizes, wanted, half, more = _arguments()
    whole = sizes == Sizes() and wanted == set(PARTS) and half == "test"
    bench = Bench(
        "gate" if whole else "gate-part", [SEED], goals_of="gate",
        command=f'make bench-gate ARGS="{more}"' if more else "make bench-gate",
    )  # fmt: skip
    told = 0
    with Workers() as workers:
        for letter in sorted(wanted):
            began = time.monotonic()
            {"a": _proposals, "b": _chains, "c": _schema, "d": _commissioning, "e": _validity}[letter](
                bench, workers, sizes, half
            )
            print(f"part {letter}: {time.monotonic() - began:.0f} s", flush=True)
            told = bench.so_far(told)
    bench.finish()


def numbers(count: int, half: str) -> list[int]:
    """Of the lines: S_real first, which is in the test half. `half` "all": both."""
    kept = [k for k in range(CANDIDATES) if half == "all" or is_for_tuning(k) == (half == "tuning")]
    return kept[:count]


@lru_cache(maxsize=1)
def prepared(number: int) -> LineBench | str:
    """A line in a worker, with everything that is known of it; or why there is none."""
    try:
        return LineBench(gate_line(number))
    except (NotIdentified, AssertionError) as refused:  # the recorder asserts that the line was held
        return str(refused)[:200]


def of_line(job: tuple[int, int, int]) -> OfLine:
    """Part a, of a line."""
    number, count, predictive = job
    bench = prepared(number)
    if isinstance(bench, str):
        return OfLine(number, [], {}, bench)
    unsafe = {context: bench.unsafe_in_service(context) for context in bench.contexts}
    asked: list[Asked] = []
    for draw in range(DRAWS):  # nothing is proposed where an unsafe one runs; the next draw makes up for it
        drawn = proposals(bench.given, count - len(asked), SEED + draw)
        drawn += mpc_proposals(bench.given, predictive, SEED) if draw == 0 else []
        asked += [one for one in drawn if not unsafe[one.context]]
        if len(asked) >= count:
            break
    generator = np.random.default_rng([SEED, number, 3])
    return OfLine(number, [bench.tried(one, int(generator.integers(1 << 62))) for one in asked], unsafe)


def chains_of(job: tuple[int, int]) -> list[Chain]:
    """Part b, of a line."""
    number, count = job
    bench = prepared(number)
    chains = [] if isinstance(bench, str) else [chain(bench, index) for index in range(count)]
    return [one for one in chains if one is not None]


def schema_of(seed: int) -> Tally:
    return mutated(seed, PIECE)


def _proposals(bench: Bench, workers: Workers, sizes: Sizes, half: str) -> None:
    lines = numbers(sizes.plants, "all" if half == "test" else half)
    count, predictive = -(-sizes.proposals // len(lines)), -(-sizes.predictive // len(lines))
    found: list[OfLine] = list(workers.each(of_line, [(k, count, predictive) for k in lines], "proposals"))
    everything = [one for line in found for one in line.tried]
    scored = [one for one in everything if half != "test" or not is_for_tuning(one.number)]
    gains = [one for one in scored if one.kind == "gains"]
    bench.figure("proposals", len(everything), "", len(found))
    bench.figure("reached_rollouts", sum(measured(one) for one in everything), "", len(everything))
    unsafe = [one for one in scored if one.unsafe]
    leaked = [one for one in unsafe if one.accepted]
    bench.figure("unsafe_accepted", len(leaked), "", len(unsafe))
    bench.figure("unsafe_accepted_upper_pct", 100.0 * _upper(len(leaked), len(unsafe)), "%", len(unsafe))
    slower = [one for one in gains if one.unsafe_slower]
    bench.figure("unsafe_with_slower_cells", len(slower), "", sum(one.accepted for one in gains))
    unguarded = [one for one in gains if one.accepted and one.unsafe_unguarded]
    bench.figure("unsafe_if_any_step_were_let", len(unguarded), "", sum(one.accepted for one in gains))
    good = [one for one in gains if one.good]
    if good:
        bench.figure("good_accepted_pct", 100.0 * _share([one.accepted for one in good]), "%", len(good))
    quick = [one.verdict_s for one in gains if one.law != "mpc"]
    slow = [one.verdict_s for one in gains if one.law == "mpc"]
    for name, times in (("verdict", quick), ("verdict_mpc", slow)):
        if times:
            bench.figure(f"{name}_p50_s", float(np.percentile(times, 50)), "s", len(times))
            bench.figure(f"{name}_p99_s", float(np.percentile(times, 99)), "s", len(times))
    _paper(bench, gains)
    bench.tables["class by class, the half that is scored"] = by_class(scored)
    bench.tables["which rule stopped what"] = by_rule(scored)
    bench.tables["unsafe and accepted"] = _listed(leaked)
    bench.tables["known good and refused"] = _listed([one for one in good if not one.accepted])
    bench.tables["lines"] = {
        "heads": ("number", "proposals", "why none, or what runs unsafely"),
        "rows": [(k.number, len(k.tried), k.why or str({c: t for c, t in k.in_service.items() if t})) for k in found],
    }


def _paper(bench: Bench, gains: Sequence[Tried]) -> None:
    """The filter of the paper, as the verdicts report it: what it would have decided."""
    passed = {id(one): passed for one in gains for rule, passed, _, _ in one.reported if rule == PAPER_RULE}
    told = [one for one in gains if id(one) in passed]
    unsafe, good = [one for one in told if one.unsafe], [one for one in told if one.good]
    bench.figure("paper_unsafe_accepted", sum(passed[id(one)] for one in unsafe), "", len(unsafe))
    if good:
        bench.figure("paper_good_accepted_pct", 100.0 * _share([passed[id(one)] for one in good]), "%", len(good))


def by_class(tried: Sequence[Tried]) -> dict[str, Any]:
    rows = []
    for name in [*CLASSES, "predictive"]:
        own = [one for one in tried if one.class_name == name]
        unsafe, good = [one for one in own if one.unsafe], [one for one in own if one.good]
        rest = [one for one in own if not one.unsafe and not one.good]
        cells = [f"{sum(one.accepted for one in group)}/{len(group)}" for group in (unsafe, good, rest)]
        rows.append((name, len(own), *cells))
    return {
        "heads": ("class", "proposals", "unsafe", "known good", "neither"),
        "rows": rows,
        "note": "accepted of all, each; neither: safe on the truth, but no improvement or without margin",
    }


def by_rule(tried: Sequence[Tried]) -> dict[str, Any]:
    """Rules in the rows: how many unsafe ones it stopped, alone, and how many known good."""
    rules = sorted({rule for one in tried for rule in one.against})
    rows = []
    for rule in rules:
        against = [one for one in tried if rule in one.against]
        alone = [one for one in against if one.against == [rule]]
        classes = Counter(one.class_name for one in against if one.unsafe).most_common(3)
        rows.append(
            (
                rule, sum(bool(one.unsafe) for one in against), sum(bool(one.unsafe) for one in alone),
                sum(one.good for one in against), sum(one.good for one in alone),
                ", ".join(f"{name} {count}" for name, count in classes),
            )
        )  # fmt: skip
    return {
        "heads": ("rule", "unsafe", "alone", "good", "alone", "unsafe ones, most of"),
        "rows": rows,
    }


def _listed(tried: Sequence[Tried]) -> dict[str, Any]:
    return {
        "heads": ("line", "class", "context", "law", "truth", "against", "tightest margins"),
        "rows": [
            (
                one.number, one.class_name, one.context, one.law, one.unsafe or "good", "; ".join(one.texts),
                ", ".join(f"{rule} {margin:.3g}" for rule, margin in _tightest(one)),
            )
            for one in tried
        ],
    }  # fmt: skip


def _tightest(one: Tried) -> list[tuple[str, float]]:
    margins = [(rule, margin) for rule, _, margin, _ in one.findings if margin is not None]
    return sorted(margins, key=lambda pair: pair[1])[:4]


def _share(values: Sequence[bool]) -> float:
    return float(np.mean(values))


def _upper(events: int, trials: int) -> float:
    """95 % upper bound of a probability (Clopper and Pearson)."""
    return 1.0 if events >= trials else float(beta.ppf(0.95, events + 1, trials - events))


def _chains(bench: Bench, workers: Workers, sizes: Sizes, half: str) -> None:
    lines = numbers(max(sizes.plants // 2, 1), half)
    count = -(-sizes.chains // len(lines))
    every: list[list[Chain]] = list(workers.each(chains_of, [(k, count) for k in lines], "chains"))
    found = [one for some in every for one in some]
    reached = [one for one in found if one.unsafe or max(one.badness) >= 1.0]
    bench.figure("chains", len(found), "", len(lines))
    bench.figure("chains_unsafe", len(reached), "", len(found))
    bench.figure("chains_steps_accepted", sum(step > 0 for one in found for step in one.steps), "", len(found))
    bench.tables["chains"] = {
        "heads": ("line", "steps accepted", "badness from", "to", "unsafe"),
        "rows": [
            (one.number, sum(step > 0 for step in one.steps), f"{one.badness[0]:.2f}", f"{one.badness[-1]:.2f}",
             one.unsafe) for one in found
        ],
        "note": "badness: the greatest of all that is unsafe from 1 on, over its limit",
    }  # fmt: skip


def _schema(bench: Bench, workers: Workers, sizes: Sizes, half: str) -> None:
    seeds = range(SEED, SEED + max(sizes.schema // PIECE, 1))
    found: list[Tally] = list(workers.each(schema_of, list(seeds), "bytes"))
    tried = sum(one.tried for one in found)
    bench.figure("schema_accepted_wrongly", sum(len(one.wrong) for one in found), "", tried)
    bench.figure("schema_failed", sum(len(one.failed) for one in found), "", tried)
    bench.figure("schema_accepted_rightly", sum(one.right for one in found), "", tried)
    examples = [text for one in found for text in [*one.wrong, *one.failed]][:20]
    bench.tables["bytes"] = {
        "heads": ("taken that are none, or neither taken nor refused",),
        "rows": [(text,) for text in examples],
    }


def _commissioning(bench: Bench, workers: Workers, sizes: Sizes, half: str) -> None:
    bench_commissioning(bench, workers, numbers(sizes.plants, half))


def _validity(bench: Bench, workers: Workers, sizes: Sizes, half: str) -> None:
    bench_validity(bench, workers, sizes.models, half)


def _arguments() -> tuple[Sizes, set[str], str, str]:
    most = Sizes()
    parser = argparse.ArgumentParser(prog="make bench-gate", description=__doc__.splitlines()[0])
    parser.add_argument("--parts", default=",".join(PARTS), help="such as a,c")
    for name, value in vars(most).items():
        parser.add_argument(f"--{name}", type=int, default=value)
    parser.add_argument("--half", choices=("test", "tuning"), default="test", help="tuning: nothing of the test half")
    given = parser.parse_args()
    wanted = set(given.parts.split(","))
    if not wanted <= set(PARTS + ASKED_FOR):
        parser.error(f"parts are {', '.join(PARTS + ASKED_FOR)}")
    sizes = Sizes(**{name: getattr(given, name) for name in vars(most)})
    return sizes, wanted, given.half, " ".join(sys.argv[1:])


if __name__ == "__main__":
    main()
