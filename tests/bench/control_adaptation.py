"""After adaptation: what experiment, model and new design are worth, on S_real, over the ensemble, and beyond.

A design after a round knows what the line's own data have told, and nothing of the plant. It is held against the
oracle, and against the same law designed on the plant itself.
"""

from dataclasses import dataclass, replace

import numpy as np

from gateway.cli.report import Section, Table
from gateway.cli.tiers import TIERS, Tier
from tests.bench.control_adapted import Adaptation, After, adapted
from tests.bench.control_ensemble import JUDGED
from tests.bench.control_plants import TEST
from tests.bench.control_real import oracle_of
from tests.bench.control_runs import CASES, Bound, Job, Outcome, Runs
from tests.bench.control_tables import SLOW_S, Given, Part, mean, numeric, p95, seeds_told, slug, told

LAW = "MPC + observer"  #: that is designed in every round
ROUNDS = 2  #: on S_real
# Unless fewer are asked for. In processor time a seed takes 20 s under tiers A and B, 100 s and more at short periods,
# a plant of the ensemble 30 s, and an oracle 6 s a case.
SHORT_SEEDS = 2  #: under tiers with a short period
BEYOND_SEEDS = 3
PLANTS, WITH_ORACLE = 20, 10  #: of the ensemble
ROUNDS_OVER = {"A": 1, "B": 2}  #: on plants of the ensemble: what the goals of a tier grant
KINDS = {"random": "one factor for a whole plant", "uneven": "and each roller and span off by up to 10 % by itself"}
BEYOND = {
    "stressed": "S_real with white noise of intensity 5e-2 on the rollers",
    "realistic": "realistic.toml: dry friction, eccentricity, relaxation, slip, lag, drifting load cells",
}

Figures = list[tuple[str, float, str, int]]


@dataclass
class Sums:
    """Of a set of runs after the same round, in one case."""

    outcomes: list[Outcome]  #: of those that brought a controller and ran to their end
    missing: int  #: that did not
    unsafe: int  #: of all that ran

    @property
    def rmse(self) -> list[float]:
        return [outcome.rmse_n for outcome in self.outcomes]


def after_adaptation(given: Given, runs: Runs) -> Part:
    part = Part(
        Section(
            "After adaptation",
            (
                "A round: an experiment of 5 s at each of two speeds, designed for the line as it is believed by then "
                "and run under the controller in service; a model from all data so far; MPC with observer on that "
                "model. The first round begins with LQI on S_sim, the second runs its experiment under LQI on the "
                "model of the first. Nothing is tuned on these plants.",
                "Data are what a round takes at each speed, the three tenths held out to judge the fit included. "
                "Deployments count the controllers that were put into service by then. Unsafe events are those of "
                "experiments and cases together.",
            ),
        )
    )
    tables = [_on_real(given, tier, runs, part) for tier in given.tiers]
    for kind in KINDS:
        tables += [_over(given, kind, TIERS[name], runs, part) for name in JUDGED if TIERS[name] in given.tiers]
    missing = [(value, n) for name, value, _, n in part.figures if name.endswith("_without_result")]
    if missing:
        count, of = (int(sum(one)) for one in zip(*missing, strict=True))
        part.figures.append(("adapted_without_result", float(count), "", of))
    if TIERS["A"] in given.tiers:
        tables.append(_beyond(given, TIERS["A"], runs, part))
    part.section = replace(part.section, tables=tuple(tables))
    return part


def rmse_after(part: Part) -> dict[tuple[str, str, int], float]:
    """On S_real: mean RMSE in N by tier, case and round."""
    found = {name: value for name, value, _, _ in part.figures}
    keys = [(tier, case, number) for tier in TIERS for case in CASES for number in range(1, ROUNDS + 1)]
    return {key: found[name] for key in keys if (name := _named(*key)) in found}


def _named(tier: str, case: str, number: int) -> str:
    return slug(tier, f"adapt{number}", "s_real", case, "n")


def _seeds(given: Given, tier: Tier) -> range:
    return range(min(given.seeds, SHORT_SEEDS) if tier.period_s < SLOW_S else given.seeds)


def _after(found: list[list[After]], number: int, case: str) -> Sums:
    """After round `number`, counted from 1; where one has brought nothing, it is missing."""
    there = [rounds[number - 1] for rounds in found if len(rounds) >= number]
    return _sums([one.outcomes[case] for one in there if case in one.outcomes], len(found))


def _unsafe(found: list[list[After]]) -> int:
    return sum(
        one.unsafe + sum(outcome.unsafe for outcome in one.outcomes.values()) for rounds in found for one in rounds
    )


def _adapted(asked: list[Adaptation], runs: Runs, part: Part, title: str) -> list[list[After]]:
    """Adds to unsafe events and runs of `part`, and prints why a round has brought nothing."""
    found: list[list[After]] = runs.every(adapted, asked, title)
    part.unsafe += _unsafe(found)
    part.runs += sum(1 + len(one.outcomes) for rounds in found for one in rounds)
    for one, rounds in zip(asked, found, strict=True):
        for number, after in enumerate(rounds, 1):
            if after.refused:
                print(f"{one.tier}, {one.truth}, seed {one.seed}, round {number}: {after.refused}", flush=True)
    return found


def _on_real(given: Given, tier: Tier, runs: Runs, part: Part) -> Table:
    seeds = _seeds(given, tier)
    asked = [Adaptation(tier.name, "s_real", seed, ROUNDS) for seed in seeds]
    found = _adapted(asked, runs, part, f"adapted to S_real, tier {tier.name}")
    best = oracle_of(tier, "free", runs)
    heads = ["After", "Data at each speed, s", "Deployments"]
    for case in CASES:
        heads += [f"{case.capitalize()} RMSE, N", "p95, N", *(["to oracle"] if best else []), "to design on S_real"]
    heads += ["Unsafe events", "Without result"]
    truth = {
        case: _rmse_of([Job(tier.name, case, LAW, "s_real", "s_real", seed) for seed in seeds], runs) for case in CASES
    }
    rows = []
    for number in range(1, ROUNDS + 1):
        there = [rounds[number - 1] for rounds in found if len(rounds) >= number]
        data_s = max((one.data_s for one in there), default=float("nan"))
        words = (tier.name, f"adapt{number}")
        part.figures.append((slug(*words, "data_s"), data_s, "s", len(there)))
        cells, missing = [f"{number} adaptation{'s' if number > 1 else ''}", told(data_s, 2), str(number)], 0
        for case in CASES:
            sums = _after(found, number, case)
            missing += sums.missing
            rmse = mean(sums.rmse) if sums.rmse else float("nan")
            most = p95(sums.rmse) if sums.rmse else float("nan")
            to_truth = rmse / mean(truth[case])
            cells += [told(rmse, 4), told(most, 4)]
            count = len(sums.rmse)
            part.figures += [
                (_named(tier.name, case, number), rmse, "N", count),
                (slug(*words, "s_real", case, "p95_n"), most, "N", count),
                (slug(*words, "s_real", case, "to_truth"), to_truth, "x", count),
            ]
            if best:
                ratio = rmse / best[case].rmse_n
                cells.append(told(ratio))
                part.figures.append((slug(*words, "s_real", case, "to_oracle"), ratio, "x", count))
            cells.append(told(to_truth))
        part.figures.append((slug(*words, "s_real_without_result"), float(missing), "", len(found) * len(CASES)))
        unsafe = _unsafe([rounds[number - 1 : number] for rounds in found])
        rows.append((*cells, str(unsafe), str(missing)))
    return Table(
        f"Adapted to S_real, tier {tier.name}: {tier.title}",
        tuple(heads),
        tuple(rows),
        numeric(heads, 1),
        note=given.made(
            f"S_real, {seeds_told(seeds)}; means and 95th percentiles over the seeds. {_told_findings(found)}"
        ),
    )


def _over(given: Given, kind: str, tier: Tier, runs: Runs, part: Part) -> Table:
    """After each adaptation that the tier is granted, over plants that are in no file."""
    seeds = TEST[: min(given.plants, PLANTS)]
    plants = [f"{kind}-{seed}" for seed in seeds]
    asked = [Adaptation(tier.name, one, seed, ROUNDS_OVER[tier.name]) for one, seed in zip(plants, seeds, strict=True)]
    found = _adapted(asked, runs, part, f"adapted to {kind} plants, tier {tier.name}")
    heads = ("After", "Case", "RMSE median, N", "p95, N", "to oracle, median", "p95")
    heads += ("to design on the plant, median", "p95", "worst plant", "Unsafe events", "Without result")
    rows = []
    for case in CASES:
        own = runs.of(
            [Job(tier.name, case, LAW, plant, plant, seed) for plant, seed in zip(plants, seeds, strict=True)],
            f"designed on {kind} plants, tier {tier.name}",
        )
        asked_best = [Bound(tier.name, case, plant) for plant in plants[:WITH_ORACLE]]
        best = [] if tier.move_s else runs.best(asked_best, f"oracle, {kind} plants")
        for number in range(1, ROUNDS_OVER[tier.name] + 1):
            outcomes = [
                rounds[number - 1].outcomes.get(case, Outcome(None)) if len(rounds) >= number else Outcome(None)
                for rounds in found
            ]
            sums = _sums(outcomes, len(found))
            to_truth = {
                plant: ours.rmse_n / true.rmse_n
                for plant, ours, true in zip(plants, outcomes, own, strict=True)
                if _counts(ours) and true.metrics
            }
            to_oracle = [ours.rmse_n / one.rmse_n for ours, one in zip(outcomes, best, strict=False) if _counts(ours)]
            words, cells = ("adapted", kind, tier.name, f"adapt{number}", case), [str(number), case]
            for name, unit, values, decimals in (
                ("n", "N", sums.rmse, 4), ("to_oracle", "x", to_oracle, 3),
                ("to_truth", "x", list(to_truth.values()), 3),
            ):  # fmt: skip
                for quantity, value in _quantiles(values).items():
                    cells.append(told(value, decimals))
                    if values:
                        part.figures.append((slug(*words, f"{name}_{quantity}"), value, unit, len(values)))
            part.figures.append((slug(*words, "without_result"), float(sums.missing), "", len(found)))
            worst = max(to_truth, key=lambda plant: to_truth[plant], default="–")
            rows.append((*cells, worst, str(sums.unsafe), str(sums.missing)))
    oracle = "" if tier.move_s else f" Oracle: of the first {len(plants[:WITH_ORACLE])}."
    return Table(
        f"Adapted to the ensemble ({KINDS[kind]}), tier {tier.name}",
        heads,
        tuple(rows),
        numeric(heads, 2),
        note=given.made(
            f"{len(plants)} plants, seeds {seeds[0]} to {seeds[-1]}.{oracle} Unsafe events in experiments: "
            f"{sum(one.unsafe for rounds in found for one in rounds)}. {_told_findings(found)}"
        ),
    )


def _beyond(given: Given, tier: Tier, runs: Runs, part: Part) -> Table:
    """What is there before, and what is reached after, on lines that are more than the paper's equations, or shaken."""
    seeds = range(min(given.seeds, BEYOND_SEEDS))
    heads = ("Plant", "Design", "Tension RMSE, N", "Velocity RMSE, N", "Unsafe events", "Stopped or without result")
    rows = []
    for plant, title in BEYOND.items():
        found = _adapted([Adaptation(tier.name, plant, s, ROUNDS) for s in seeds], runs, part, f"adapted to {plant}")
        shown = {
            (f"{law} on {title_of}", slug(law, name)): {
                case: _sums(runs.of([Job(tier.name, case, law, known, plant, s) for s in seeds], plant), len(seeds))
                for case in CASES
            }
            for law, known, title_of, name in (
                ("LQI", "s_sim", "S_sim", "s_sim"), (LAW, "s_sim", "S_sim", "s_sim"),
                (LAW, plant, "the plant itself", "truth"),
            )
        }  # fmt: skip
        for number in range(1, ROUNDS + 1):
            key = (f"{LAW} after {number} adaptation{'s' if number > 1 else ''}", f"adapt{number}")
            shown[key] = {case: _after(found, number, case) for case in CASES}
        for (design, name), sums in shown.items():
            rmse = {case: mean(one.rmse) if one.rmse else float("nan") for case, one in sums.items()}
            unsafe, missing = (sum(getattr(one, what) for one in sums.values()) for what in ("unsafe", "missing"))
            rows.append((title, design, *(told(rmse[case], 4) for case in CASES), str(unsafe), str(missing)))
            part.figures += [
                (slug(plant, tier.name, name, case, "n"), rmse[case], "N", len(sums[case].rmse)) for case in CASES
            ]
    return Table(
        f"Adapted to lines that are more than the equations, tier {tier.name}",
        heads,
        tuple(rows),
        numeric(heads, 2),
        note=given.made(
            f"{seeds_told(seeds)}; means over the runs that went to their end, out of {len(CASES) * len(seeds)}. A run "
            "that the gateway stops, or a round that brings no model, has no RMSE. Designs on the plant itself know of "
            "it what the paper's equations have a term for."
        ),
    )


def _sums(outcomes: list[Outcome], wanted: int) -> Sums:
    fine = [outcome for outcome in outcomes if _counts(outcome)]
    return Sums(fine, wanted - len(fine), sum(outcome.unsafe for outcome in outcomes))


def _counts(outcome: Outcome) -> bool:
    return outcome.metrics is not None and outcome.stopped is None


def _rmse_of(jobs: list[Job], runs: Runs) -> list[float]:
    return [outcome.rmse_n for outcome in runs.of(jobs, f"designed on S_real, tier {jobs[0].tier}") if outcome.metrics]


def _quantiles(values: list[float]) -> dict[str, float]:
    if not values:
        return {"p50": float("nan"), "p95": float("nan")}
    return {"p50": float(np.percentile(values, 50)), "p95": p95(values)}


def _told_findings(found: list[list[After]]) -> str:
    """How many models do not hold on held-out data, and which structures were chosen."""
    every = [one for rounds in found for one in rounds if one.structure]
    doubted = sum(bool(one.findings) for one in every)
    structures = sorted({one.structure for one in every})
    counted = ", ".join(f"{sum(one.structure == s for one in every)} {s}" for s in structures)
    return f"Models: {counted or 'none'}; with findings of the validation or cautions: {doubted}."
