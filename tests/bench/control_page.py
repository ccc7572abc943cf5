"""The report of the control benchmark: the answer, the parts, the goals, and every configuration as it ran."""

from pathlib import Path

import numpy as np

from gateway.cli.report import Chart, Page, Section, Series, Table, render_page
from gateway.cli.tiers import TIERS, Tier
from tests.bench.control_real import KNOWN, oracle_of
from tests.bench.control_runs import CASES, TRACE_S, Job, Runs, Trace
from tests.bench.control_tables import Given, Part, markdown, numeric
from tests.bench.figures import GOALS, Bench

DRAWN = ("A", "P")
HEADLINES = {
    "a_adapt1_s_real_tension_to_oracle": "after one adaptation on S_real, tension case",
    "a_adapt1_s_real_velocity_to_oracle": "after one adaptation on S_real, velocity case",
    "a_mpc_observer_s_real_tension_to_oracle": "MPC with observer on S_real, tension case",
    "a_mpc_observer_s_real_velocity_to_oracle": "MPC with observer on S_real, velocity case",
    "a_lqi_s_real_tension_to_oracle": "LQI on S_real, tension case",
    "a_lqi_s_real_velocity_to_oracle": "LQI on S_real, velocity case",
    "a_lqi_s_sim_tension_to_oracle": "LQI on S_sim, tension case",
    "a_lqi_s_sim_velocity_to_oracle": "LQI on S_sim, velocity case",
}


def write(given: Given, bench: Bench, parts: list[Part], drawn: list[Section]) -> None:
    """The Markdown file and the report beside the benchmark's JSON."""
    answer, goals = _answer(bench, parts), goals_section(given, bench)
    sections = [goals, *(part.section for part in parts)]
    result = bench.result()
    page = Page(
        title="Control benchmark",
        origin="Simulated lines of six spans, the paper's two cases",
        when=given.when,
        command=given.command,
        versions=result.versions,
        machine=result.machine,
        answer=answer,
        sections=(*sections, *drawn),
        notes=(
            "Every run goes through the whole cycle in stepped time and is judged by the recorder at the simulated "
            "devices. Designs know the model that they were made on and nothing else.",
            "RK4 at 1 ms; runs of 15 s from the plant's own equilibrium; noise of 0.1 N and 0.1 mm/s on the sensors; "
            "weights are the same for all plants of a tier.",
        ),
    )
    folder = Path("out/bench")
    folder.mkdir(parents=True, exist_ok=True)
    (folder / f"{bench.name}.html").write_text(render_page(page), encoding="utf-8")
    lines = ["# Control benchmark", "", *answer, ""]
    for section in sections:
        lines += [f"## {section.title}", "", *(line for text in section.paragraphs for line in (text, ""))]
        lines += [line for table in section.tables for line in (markdown(table), "")]
    (folder / f"{bench.name}.md").write_text("\n".join(lines), encoding="utf-8")


def _answer(bench: Bench, parts: list[Part]) -> tuple[str, ...]:
    unsafe = sum(part.unsafe for part in parts)
    judged = [figure for figure in bench.figures if figure.goal is not None]
    missed = [figure.name for figure in judged if not figure.met]
    found = {figure.name: figure.value for figure in bench.figures}
    ratios = [f"{words} {found[name]:.3f}" for name, words in HEADLINES.items() if name in found]
    sentences = [
        f"{unsafe} unsafe events at the drives." if unsafe else "No unsafe event at the drives.",
        f"Goals met: {len(judged) - len(missed)} of {len(judged)} that were measured."
        + (f" Missed: {', '.join(missed)}." if missed else ""),
    ]
    if ratios:
        sentences.append(f"RMSE to oracle under tier A: {'; '.join(ratios)}.")
    return tuple(sentences)


def goals_section(given: Given, bench: Bench) -> Section:
    goals = GOALS["control"]
    heads = ("Figure", "Value", "Goal", "", "Where the goal comes from")
    rows = [
        (f.name, f"{f.value:.4g} {f.unit}", f"{f.op} {f.goal:g}", "met" if f.met else "MISSED", goals[f.name]["source"])
        for f in bench.figures
        if f.goal is not None
    ]
    table = Table(
        "Every goal", heads, tuple(rows), numeric(heads[:3], 1), note=given.made("Missed is said, not hidden.")
    )
    return Section("Goals", tables=(table,))


def drawings(given: Given, runs: Runs) -> list[Section]:
    """A section per tier and case: tensions and torques of every configuration that has run, and the oracle's."""
    return [_drawing(tier, case, runs) for name in DRAWN if (tier := TIERS[name]) in given.tiers for case in CASES]


def _drawing(tier: Tier, case: str, runs: Runs) -> Section:
    scenario = CASES[case]
    setpoint = scenario.setpoints_n(TRACE_S)
    best = oracle_of(tier, "free", runs)[case]
    traces = {
        (job.law, job.known): outcome.trace
        for job, outcome in runs.made.items()
        if (job.tier, job.case, job.truth) == (tier.name, case, "s_real") and _first(job) and outcome.trace
    }
    charts: list[Chart] = []
    for known, name in KNOWN.items():
        series = [
            Series(law, np.linalg.norm(trace.tension_n - setpoint, axis=1))
            for (law, other), trace in traces.items()
            if other == known
        ]
        if series:
            bound = Series("Oracle", np.linalg.norm(best.trace.tension_n - setpoint, axis=1), dashed=True)
            charts.append(Chart(f"Tension error, 2-norm, designs on {name}", "N", TRACE_S, (*series, bound)))
    for (law, known), trace in traces.items():
        charts += _pair(f"{law} on {KNOWN[known]}", trace, setpoint)
    charts += _pair("oracle", best.trace, setpoint)
    return Section(
        f"Tier {tier.name}, {scenario.heading.lower()}",
        (f"{scenario.description} {tier.title}. On S_real, all with seed 0: the same noise.",),
        charts=tuple(charts),
    )


def _first(job: Job) -> bool:
    return job.seed == 0 and job.boundary == "free"


def _pair(name: str, trace: Trace, setpoint: np.ndarray) -> list[Chart]:
    spans = [Series(f"Span {i}", column) for i, column in enumerate(trace.tension_n.T, 1)]
    spans += [Series(f"Set-point {i}", column, dashed=True) for i, column in enumerate(setpoint.T, 1)]
    rollers = [Series(f"Roller {i}", column) for i, column in enumerate(trace.torque_nm.T, 1)]
    return [
        Chart(f"Tension, {name}", "N", TRACE_S, tuple(spans)),
        Chart(f"Torque, {name}", "Nm", TRACE_S, tuple(rollers)),
    ]
