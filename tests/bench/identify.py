"""`make bench-identify`: what a line learns of itself, against truths that the estimators never see, in parts:

    a  S_real, 5 s of commissioning: errors of every parameter, and what a fit takes
    b  plants drawn from the prior: how often intervals of 95 % cover the truth
    c  Coulomb friction and torque lag: the structure chosen, and whether it is valid at two speeds
    d  rollers that differ
    e  what the model does not have: true white noise, eccentricity, the realistic line
    f  normal operation, no experiment: with an operator's moves, and with none
    g  the same experiment over the wires in real time and in stepped time (the machine should do nothing else)

Writes out/bench/identify.json; of a part of it, out/bench/identify-part.json. Two processes at a time.
"""

import argparse
import sys
import time
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from gateway.identification.parameters import COMBINATIONS
from tests.bench import identify_runs as runs
from tests.bench.figures import Bench
from tests.bench.identify_passive import DURATION_S, MOVES, Passive, counted, passive
from tests.bench.identify_runs import STRONG, Chosen, Found
from tests.bench.identify_wire import over_the_wire
from tests.bench.workers import Workers

PARTS = "abcdefg"
NORMALISED = (0.8, 1.2)  #: the gate's validity test
STRUCTURE_C = "Coulomb friction, torque lag"
PAPER = "1.4 to 8.6 % (the paper's S_real_ID)"
PHYSICAL = ("stiffness_n", "length_m", "radius_m", "inertia_kg_m2", "friction_nms_per_rad")


@dataclass(frozen=True)
class Sizes:
    """How often each part is run."""

    seeds: int = 20  #: a, d
    covered: int = 500
    friction: int = 100
    shown: int = 10  #: e
    passive: int = 6  #: f
    wire: int = 3  #: g


def main() -> None:
    sizes, wanted, more = _arguments()
    whole = sizes == Sizes() and wanted == set(PARTS)
    bench = Bench(
        "identify" if whole else "identify-part", list(range(sizes.seeds)), goals_of="identify",
        command=f'make bench-identify ARGS="{more}"' if more else "make bench-identify",
    )  # fmt: skip
    parts = {"a": _commissioning, "b": _coverage, "c": _friction, "d": _spread, "e": _shown, "f": _passive, "g": _wire}
    if "a" in wanted:
        _fit_times(bench, sizes)  # with nothing beside it
    with Workers() as workers:
        for letter in sorted(wanted):
            began = time.monotonic()
            parts[letter](bench, workers, sizes)
            print(f"part {letter}: {time.monotonic() - began:.0f} s", flush=True)
    bench.finish()


def _fit_times(bench: Bench, sizes: Sizes) -> None:
    wall, processor = runs.fit_times(range(sizes.seeds))
    bench.figure("fit_p50_s", float(np.median(wall)), "s", len(wall))
    bench.figure("fit_worst_s", float(wall.max()), "s", len(wall))
    bench.figure("fit_processor_p50_s", float(np.median(processor)), "s", len(processor))


def _commissioning(bench: Bench, workers: Workers, sizes: Sizes) -> None:
    found: list[Found] = list(workers.each(runs.commissioned, range(sizes.seeds), "S_real"))
    rows = []
    for name in (*STRONG, *PHYSICAL, "radius2_per_inertia"):
        rms, bias, width = _rms(found, name), _bias(found, name), _mean_width(found, name)
        bench.figure(f"{name}_rms_pct", rms, "%", len(found))
        rows.append((name, f"{rms:.3f}", f"{bias:+.3f}", f"{width:.2f}"))
    noise = [[one.noise.tension_n, one.noise.speed_m_per_s, one.noise.acceleration_m_per_s1_5] for one in found]
    bench.tables["S_real, 5 s"] = {
        "heads": ("parameter", "rms error, %", "mean error, %", "interval, ± %"),
        "rows": rows,
        "note": f"beside {PAPER}; noise found, mean: {np.mean(noise, axis=0).tolist()}",
    }


def _coverage(bench: Bench, workers: Workers, sizes: Sizes) -> None:
    seeds = range(20_000, 20_000 + sizes.covered)
    every: list[Found | None] = list(workers.each(runs.covered, seeds, "plants from the prior"))
    found = [one for one in every if one is not None]
    names = (*PHYSICAL, *COMBINATIONS)
    share = {name: 100.0 * float(np.mean([one.covered[name] for one in found])) for name in names}
    bench.figure("coverage_lowest_pct", min(share.values()), "%", len(found))
    bench.figure("coverage_highest_pct", max(share.values()), "%", len(found))
    bench.figure("coverage_not_converged", sum(not one.converged for one in found), "", len(found))
    bench.figure("coverage_not_held", len(every) - len(found), "", len(every))
    bench.tables["coverage of 95 % intervals, plants drawn from the prior"] = {
        "heads": ("parameter", "covered, %", "rms error, %", "interval, ± %"),
        "rows": [
            (name, f"{share[name]:.1f}", f"{_rms(found, name):.3f}", f"{_mean_width(found, name):.2f}")
            for name in names
        ],
    }


def _friction(bench: Bench, workers: Workers, sizes: Sizes) -> None:
    found: list[Chosen] = list(workers.each(runs.with_friction, range(sizes.friction), "friction and lag"))
    valid = [all(NORMALISED[0] <= value <= NORMALISED[1] for value in one.normalised.values()) for one in found]
    bench.figure("friction_valid_pct", 100.0 * float(np.mean(valid)), "%", len(found))
    right = [one.structure == STRUCTURE_C for one in found]
    bench.figure("friction_structure_right_pct", 100.0 * float(np.mean(right)), "%", len(found))
    bench.figure("friction_verdict_valid_pct", 100.0 * float(np.mean([one.valid for one in found])), "%", len(found))
    errors = [one.found for one in found if one.found is not None and one.structure == STRUCTURE_C]
    rows = []
    for name in (*STRONG, *PHYSICAL, "coulomb_nm", "torque_lag_s"):
        rms = _rms(errors, name)
        bench.figure(f"friction_{name}_rms_pct", rms, "%", len(errors))
        share = 100.0 * float(np.mean([one.covered[name] for one in errors]))
        rows.append((name, f"{rms:.3f}", f"{_bias(errors, name):+.3f}", f"{share:.0f}"))
    bench.tables["Coulomb friction 2 Nm and lag 5 ms, 5 s at each of two speeds"] = {
        "heads": ("parameter", "rms error, %", "mean error, %", "covered, %"),
        "rows": rows,
        "note": f"structures chosen: {_counted(found)}; normalised innovation {_normalised(found)}",
    }


def _spread(bench: Bench, workers: Workers, sizes: Sizes) -> None:
    found: list[Found] = list(workers.each(runs.spread, range(sizes.seeds), "rollers that differ"))
    rows = []
    for family in (*STRONG, *PHYSICAL):
        errors = _of_family(found, "error", family)
        rms = 100.0 * float(np.sqrt(np.mean(np.square(errors))))
        share = 100.0 * float(np.mean(_of_family(found, "covered", family)))
        bench.figure(f"spread_{family}_rms_pct", rms, "%", len(errors))
        rows.append((family, f"{rms:.3f}", f"{share:.1f}"))
    bench.tables["rollers that differ by 10 % either way, 5 s"] = {
        "heads": ("parameter of a roller or span", "rms error, %", "covered, %"),
        "rows": rows,
    }


def _shown(bench: Bench, workers: Workers, sizes: Sizes) -> None:
    """No goals: what is reached where the model's structure is not the truth's."""
    cases = {
        "stress": runs.stressed, "eccentricity_0.2_pct": runs.with_eccentricity,
        "eccentricity_0.5_pct": runs.with_much_eccentricity, "realistic": runs.realistic,
    }  # fmt: skip
    rows = []
    for name, function in cases.items():
        found: list[Chosen] = list(workers.each(function, range(sizes.shown), name))
        inside = [all(NORMALISED[0] <= v <= NORMALISED[1] for v in one.normalised.values()) for one in found]
        bench.figure(f"{name}_normalised_inside_pct", 100.0 * float(np.mean(inside)), "%", len(found))
        bench.figure(f"{name}_verdict_valid_pct", 100.0 * float(np.mean([one.valid for one in found])), "%", len(found))
        known = [one.found for one in found if one.found is not None]
        for family in STRONG if known else ():
            errors = _of_family(known, "error", family)
            bench.figure(
                f"{name}_{family}_rms_pct", 100.0 * float(np.sqrt(np.mean(np.square(errors)))), "%", len(known)
            )
        r2 = {key: float(np.mean([one.r2[key] for one in found])) for key in found[0].r2}
        rows.append(
            (
                name, _counted(found), _normalised(found), f"{np.mean([one.portmanteau for one in found]):.2f}",
                ", ".join(f"{key} {value:.4f}" for key, value in r2.items()),
                f"{np.mean([one.seconds for one in found]):.1f}", found[0].findings,
                {key: float(np.mean([o.values[key] for o in found if key in o.values])) for key in found[0].values},
            )
        )  # fmt: skip
    bench.tables["where the truth has more than the model"] = {
        "heads": (
            "case", "structures chosen", "normalised innovation", "portmanteau over its quantile", "R2 on unseen data",
            "seconds of data", "findings, seed 0", "values, mean",
        ),
        "rows": rows,
    }  # fmt: skip


def _passive(bench: Bench, workers: Workers, sizes: Sizes) -> None:
    rows = []
    for moves in MOVES:
        given = [(moves, seed) for seed in range(sizes.passive)]
        every: list[Passive] = list(workers.each(passive, given, f"production, moves: {moves}"))
        found, label = [one.found for one in every], moves.replace(" ", "_")
        offered = 100.0 * float(np.mean([one.offered for one in every]))
        covered = 100.0 * float(np.mean([list(one.covered.values()) for one in found]))
        bench.figure(f"passive_{label}_offered_pct", offered, "%", len(every))
        bench.figure(f"passive_{label}_covered_pct", covered, "%", len(every))
        strong = [f"{_rms(found, name):.2f} (±{_mean_width(found, name):.2f})" for name in STRONG]
        apart = [f"{_rms(found, name):.2f} (±{_mean_width(found, name):.2f})" for name in PHYSICAL]
        refused, warned = counted([one.refused for one in every]), counted([one.warned for one in every])
        rows.append((moves, f"{offered:.0f}", refused, warned, *strong, *apart, f"{covered:.0f}"))
    bench.tables[f"normal operation, {DURATION_S:g} s without an experiment"] = {
        "heads": ("moves", "models offered, %", "refused for", "warned of", *STRONG, *PHYSICAL, "covered, %"),
        "rows": rows,
        "note": "rms error in % (half width of 95 %); of data that were refused too, to see whether rightly",
    }


def _wire(bench: Bench, _: Workers, sizes: Sizes) -> None:
    every = [over_the_wire(seed) for seed in range(1, sizes.wire + 1)]
    names = (*STRONG, *PHYSICAL)
    of_each = {name: [one.ratios[name] for one in every] for name in names}
    bench.figure("wire_half_width_ratio_worst", max(map(max, of_each.values())), "x stepped", len(every))
    middle = float(np.median(list(of_each.values())))
    bench.figure("wire_half_width_ratio_p50", middle, "x stepped", len(every) * len(names))
    covered = 100.0 * float(np.mean([list(one.wire.covered.values()) for one in every]))
    bench.figure("wire_covered_pct", covered, "%", len(every))
    bench.tables["the same experiment over the wires and in stepped time"] = {
        "heads": ("parameter", "half width over stepped: median", "worst", "rms error wire, %", "stepped, %"),
        "rows": [
            (
                name, f"{np.median(of_each[name]):.3f}", f"{max(of_each[name]):.3f}",
                f"{_rms([one.wire for one in every], name):.3f}", f"{_rms([one.stepped for one in every], name):.3f}",
            )
            for name in names
        ],
        "note": f"samples (wire, stepped): {[one.samples for one in every]}; speed noise found over the wires: "
        f"{[one.wire.noise.speed_m_per_s for one in every]} m/s",
    }  # fmt: skip


def _rms(found: Sequence[Found], name: str) -> float:
    return 100.0 * float(np.sqrt(np.mean([one.error[name] ** 2 for one in found])))


def _bias(found: Sequence[Found], name: str) -> float:
    return 100.0 * float(np.mean([one.error[name] for one in found]))


def _mean_width(found: Sequence[Found], name: str) -> float:
    return 100.0 * float(np.mean([one.half_width[name] for one in found]))


def _of_family(found: Sequence[Found], what: str, family: str) -> list[float]:
    """Of a name and of all its rollers."""
    return [value for one in found for name, value in getattr(one, what).items() if name.split("[")[0] == family]


def _counted(found: Sequence[Chosen]) -> str:
    return ", ".join(f"{name} ({count})" for name, count in Counter(one.structure for one in found).most_common())


def _normalised(found: Sequence[Chosen]) -> str:
    speeds = found[0].normalised
    return "; ".join(
        f"{speed:g} m/s: {min(values):.3f} to {max(values):.3f}"
        for speed in speeds
        for values in [[one.normalised[speed] for one in found]]
    )


def _arguments() -> tuple[Sizes, set[str], str]:
    parser = argparse.ArgumentParser(
        prog="make bench-identify", description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    usual = Sizes()
    parser.add_argument("--parts", default=PARTS, help=f"some of {PARTS}, as in a,c")
    parser.add_argument("--seeds", type=int, default=usual.seeds, help="of parts a and d")
    parser.add_argument("--covered", type=int, default=usual.covered, help="plants of part b")
    parser.add_argument("--friction", type=int, default=usual.friction, help="seeds of part c")
    parser.add_argument("--shown", type=int, default=usual.shown, help="seeds of each case of part e")
    parser.add_argument("--passive", type=int, default=usual.passive, help="seeds of each case of part f")
    parser.add_argument("--wire", type=int, default=usual.wire, help="runs of part g")
    args = parser.parse_args()
    wanted = set(args.parts) - {","}
    numbers = (args.seeds, args.covered, args.friction, args.shown, args.passive, args.wire)
    if not wanted <= set(PARTS) or min(numbers) < 1:
        parser.error(f"parts are some of {PARTS}, numbers 1 or more")
    return Sizes(*numbers), wanted, " ".join(sys.argv[1:])


if __name__ == "__main__":
    main()
