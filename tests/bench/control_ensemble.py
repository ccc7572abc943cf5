"""The ensemble: plants that are in no file, each law designed on S_sim and on the plant itself."""

import numpy as np

from gateway.cli.report import Section, Table
from gateway.cli.tiers import TIERS, Tier
from tests.bench.control_plants import TEST
from tests.bench.control_runs import CASES, Bound, Job, Outcome, Runs
from tests.bench.control_tables import BY_THE_WAY, Given, Part, numeric, slug, told

JUDGED = ("A", "B")
WITH_ORACLE = 10  #: plants that the oracle is asked about: it takes as long as a dozen runs
NAMES = {"s_sim": "S_sim", "plant": "the plant"}
SUMS = ("mean", "median", "p95")


def on_ensemble(given: Given, runs: Runs) -> Part:
    """A table per tier: RMSE, and its ratio to the same law designed on the plant itself."""
    tables, figures, unsafe, made = [], [], 0, 0
    laws = [law for law in given.laws if law not in BY_THE_WAY]
    plants = [f"random-{seed}" for seed in TEST[: given.plants]]
    for tier in (TIERS[name] for name in JUDGED if TIERS[name] in given.tiers):
        found = _outcomes(tier, laws, plants, runs)
        tables.append(_table(given, tier, plants, found))
        figures += _figures(tier, found)
        unsafe += sum(outcome.unsafe for row in found.values() for outcome in row)
        made += sum(map(len, found.values()))
        if not tier.move_s:
            tables.append(_oracle_table(given, tier, plants[:WITH_ORACLE], found, runs, figures))
    section = Section(
        "Over the ensemble",
        (
            "Random plants around S_sim: EA, J and L within 20 %, R within 15 %, f within 50 %, one factor per "
            "parameter for the whole plant, kept if friction at 0.1 m/s takes 50 Nm or less; disturbed as S_real is. "
            "They are none of those on which weights were chosen. One seed a plant, its own number.",
            "The ratio is that of the design on S_sim to the same law designed on the plant itself.",
        ),
        tuple(tables),
    )
    return Part(section, figures, unsafe, made)


def sums(values: list[float]) -> dict[str, float]:
    """By the names of `SUMS`; nothing of nothing."""
    if not values:
        return {}
    return {"mean": float(np.mean(values)), "median": float(np.median(values)), "p95": float(np.percentile(values, 95))}


def cells(values: list[float], decimals: int = 3) -> tuple[str, ...]:
    found = sums(values)
    return tuple(told(found[name], decimals) if found else "–" for name in SUMS)


Found = dict[tuple[str, str, str], list[Outcome]]  #: by law, "s_sim" or "plant", case


def _outcomes(tier: Tier, laws: list[str], plants: list[str], runs: Runs) -> Found:
    def jobs(law: str, known: str, case: str) -> list[Job]:
        return [
            Job(tier.name, case, law, plant if known == "plant" else known, plant, int(plant.split("-")[1]))
            for plant in plants
        ]

    keys = [(law, known, case) for law in laws for known in ("s_sim", "plant") for case in CASES]
    runs.of([job for key in keys for job in jobs(*key)], f"ensemble, tier {tier.name}")
    return {key: runs.of(jobs(*key), "") for key in keys}


def _ratios(found: Found, law: str, case: str) -> list[float]:
    """Of each plant that both designs were offered for."""
    pairs = zip(found[law, "s_sim", case], found[law, "plant", case], strict=True)
    return [ours.rmse_n / own.rmse_n for ours, own in pairs if ours.metrics and own.metrics]


def _rmse(outcomes: list[Outcome]) -> list[float]:
    return [outcome.rmse_n for outcome in outcomes if outcome.metrics]


def _table(given: Given, tier: Tier, plants: list[str], found: Found) -> Table:
    heads = ["Law", "Designed on", "Case", *(f"RMSE {name}, N" for name in SUMS), *(f"ratio {name}" for name in SUMS)]
    heads += ["Unsafe events", "Refused"]
    rows = []
    for law, known, case in found:
        outcomes = found[law, known, case]
        rmse, ratios = _rmse(outcomes), _ratios(found, law, case)
        numbers = (*cells(rmse, 4), *(cells(ratios) if known == "s_sim" else ("",) * len(SUMS)))
        unsafe = sum(outcome.unsafe for outcome in outcomes)
        refused = sum(outcome.metrics is None for outcome in outcomes)
        rows.append((law, NAMES[known], case, *numbers, str(unsafe), str(refused)))
    return Table(
        f"Ensemble, tier {tier.name}: {tier.title}",
        tuple(heads),
        tuple(rows),
        numeric(heads, 3),
        note=given.made(f"{len(plants)} plants, seeds {TEST[0]} to {TEST[len(plants) - 1]}."),
    )


def _figures(tier: Tier, found: Found) -> list[tuple[str, float, str, int]]:
    figures = []
    for law, known, case in found:
        rmse, ratios = _rmse(found[law, known, case]), _ratios(found, law, case)
        words = ("ensemble", tier.name, law, known, case)
        figures += [(slug(*words, f"{name}_n"), value, "N", len(rmse)) for name, value in sums(rmse).items()]
        if known == "s_sim":
            of = sums(ratios).items()
            figures += [(slug(*words, f"to_plant_{name}"), value, "x", len(ratios)) for name, value in of]
    return figures


def _oracle_table(
    given: Given, tier: Tier, plants: list[str], found: Found, runs: Runs,
    figures: list[tuple[str, float, str, int]],
) -> Table:  # fmt: skip
    """Of the first plants. Adds to `figures`."""
    asked = {case: [Bound(tier.name, case, plant) for plant in plants] for case in CASES}
    runs.best([one for some in asked.values() for one in some], "oracle, ensemble")
    heads = ["Law", "Designed on", "Case", *(f"to oracle, {name}" for name in SUMS)]
    rows = []
    for law, known, case in found:
        best = runs.best(asked[case], "")
        outcomes = found[law, known, case][: len(plants)]
        pairs = zip(outcomes, best, strict=True)
        ratios = [outcome.rmse_n / one.rmse_n for outcome, one in pairs if outcome.metrics]
        rows.append((law, NAMES[known], case, *cells(ratios)))
        words = ("ensemble", tier.name, law, known, case)
        of = sums(ratios).items()
        figures += [(slug(*words, f"to_oracle_{name}"), value, "x", len(ratios)) for name, value in of]
    return Table(
        f"Ensemble, tier {tier.name}, beside each plant's own oracle",
        tuple(heads),
        tuple(rows),
        numeric(heads, 3),
        note=given.made(f"The first {len(plants)} plants of the ensemble."),
    )
