"""On S_real: every law under every tier, designed on the mismatched model and on the truth, beside the oracle."""

from dataclasses import dataclass

from gateway.cli.report import Section, Table
from gateway.cli.tiers import TIERS, Tier
from tests.bench.control_runs import CASES, Best, Bound, Boundary, Job, Outcome, Runs
from tests.bench.control_tables import FEW_SEEDS, Given, Part, mean, numeric, p95, seeds_told, slug, told

KNOWN = {"s_sim": "S_sim", "s_real": "S_real"}

# An independent study's figures for tier A, on S_real: law, plant known, case.
STUDY_N = {
    ("LQR", "s_sim"): {"tension": 2.43, "velocity": 4.77},
    ("LQI", "s_sim"): {"tension": 2.009, "velocity": 1.156},
    ("MPC", "s_sim"): {"tension": 2.233, "velocity": 4.88},
    ("MPC + observer", "s_sim"): {"tension": 2.054, "velocity": 1.160},
}


@dataclass(frozen=True)
class Row:
    """All seeds of a law, designed on `known`, in both cases."""

    law: str
    known: str
    outcomes: dict[str, list[Outcome]]  #: by case

    @property
    def unsafe(self) -> int:
        return sum(outcome.unsafe for found in self.outcomes.values() for outcome in found)

    @property
    def runs(self) -> int:
        return sum(map(len, self.outcomes.values()))


def jobs_of(tier: Tier, law: str, known: str, case: str, seeds: range, boundary: Boundary) -> list[Job]:
    return [Job(tier.name, case, law, known, "s_real", seed, boundary) for seed in seeds]


def on_real(given: Given, runs: Runs) -> Part:
    """A table per tier, and one for the other boundary under tier A."""
    tables, figures, unsafe, made = [], [], 0, 0
    asked: list[tuple[Tier, Boundary]] = [(tier, "free") for tier in given.tiers]
    if TIERS["A"] in given.tiers:
        asked.append((TIERS["A"], "continued"))
    for tier, boundary in asked:
        best = oracle_of(tier, boundary, runs)
        rows = rows_of(given, tier, boundary, runs)
        tables.append(_table(given, tier, boundary, rows, best))
        name = tier.name if boundary == "free" else f"{tier.name}_{boundary}"
        figures += [figure for row in rows for figure in _figures(name, row, best)]
        figures += [(slug(name, "oracle_s_real", case, "n"), one.rmse_n, "N", 1) for case, one in best.items()]
        unsafe += sum(row.unsafe for row in rows)
        made += sum(row.runs for row in rows)
    section = Section(
        "On S_real",
        (
            "The tensions are the true ones at the recorder of the simulated line, over 15 s; RMSE is the root of the "
            "time mean of the squared 2-norm over the six spans. The oracle knows the plant exactly, without noise, "
            "under the same limits, sampling and latency: no controller can do better, but for noise that happens to "
            'help in a single run. The column "study" is what an independent study of the same equations found.',
            "LQR on S_sim is the paper's Initial, MPC on S_sim its baseline. The design on S_real is where adaptation "
            "leads; how far it gets is told under After adaptation.",
        ),
        tuple(tables),
    )
    return Part(section, figures, unsafe, made)


def oracle_of(tier: Tier, boundary: Boundary, runs: Runs, truth: str = "s_real") -> dict[str, Best]:
    """By case; nothing for a tier whose set-points do not step."""
    if tier.move_s:
        return {}
    asked = [Bound(tier.name, case, truth, boundary) for case in CASES]
    return dict(zip(CASES, runs.best(asked, f"oracle, tier {tier.name}"), strict=True))


def rows_of(given: Given, tier: Tier, boundary: Boundary, runs: Runs) -> list[Row]:
    def jobs(law: str, known: str, case: str) -> list[Job]:
        seeds = given.seeds_of(tier, law)
        return jobs_of(tier, law, known, case, seeds if boundary == "free" else seeds[:FEW_SEEDS], boundary)

    names = [(law, known) for law in given.laws for known in KNOWN]
    runs.of([job for name in names for case in CASES for job in jobs(*name, case)], f"S_real, tier {tier.name}")
    return [Row(*name, {case: runs.of(jobs(*name, case), "") for case in CASES}) for name in names]


def _table(given: Given, tier: Tier, boundary: Boundary, rows: list[Row], best: dict[str, Best]) -> Table:
    study = tier.name == "A" and boundary == "free"
    heads = ["Law", "Designed on"]
    for case in CASES:
        heads += [f"{case.capitalize()} RMSE, N", "p95, N"]
        heads += ["to oracle"] if best else []
        heads += ["study, N"] if study else []
    heads += ["Unsafe events", "Runs"]
    cells = []
    for row in rows:
        line = [row.law, KNOWN[row.known]]
        for case in CASES:
            rmse = [outcome.rmse_n for outcome in row.outcomes[case]]
            line += [told(mean(rmse), 4), told(p95(rmse), 4)]
            line += [told(mean(rmse) / best[case].rmse_n)] if best else []
            line += [told(STUDY_N.get((row.law, row.known), {}).get(case, float("nan")))] if study else []
        cells.append((*line, str(row.unsafe), str(row.runs)))
    foot = ["Oracle", "S_real"]
    for case in CASES:
        foot += [told(best[case].rmse_n, 4), "", "1.000", *([""] if study else [])] if best else []
    boundaries = "T_0 = T_7 = 0" if boundary == "free" else "T_0 = T_1, T_7 = T_6 of the set-points"
    seeds = seeds_told(range(given.seeds if boundary == "free" else min(given.seeds, FEW_SEEDS)))
    few = "; PID and LQG with fewer" if any(len(given.seeds_of(tier, law)) < given.seeds for law in given.laws) else ""
    return Table(
        f"Tier {tier.name}: {tier.title}; {boundaries}",
        tuple(heads),
        tuple(cells),
        numeric(heads, 2),
        (*foot, "", "") if best else None,
        given.made(f"S_real, {seeds}{few}; mean and 95th percentile over the seeds."),
    )


def _figures(name: str, row: Row, best: dict[str, Best]) -> list[tuple[str, float, str, int]]:
    found = []
    for case, outcomes in row.outcomes.items():
        rmse = [outcome.rmse_n for outcome in outcomes]
        words = (name, row.law, row.known, case)
        found.append((slug(*words, "n"), mean(rmse), "N", len(rmse)))
        found.append((slug(*words, "p95_n"), p95(rmse), "N", len(rmse)))
        if best:
            found.append((slug(*words, "to_oracle"), mean(rmse) / best[case].rmse_n, "x", len(rmse)))
    return found
