"""A rehearsal on the terminal: a table for each scenario that fits 80 columns, and a few plain lines."""

from pathlib import Path

import numpy as np
from rich.box import SIMPLE_HEAD
from rich.console import Console
from rich.table import Table

from gateway.cli.rehearse_result import AdaptationResult, CaseResult, RehearseResult
from gateway.core.line_problem import printable

STRONG = {"stiffness_per_length": "EA/L", "radius_per_inertia": "R/J", "friction_per_inertia": "f/J"}
COLUMNS = ("configuration", "RMSE N", "/truth", "settle s", "over %", "p99 us", "T N", "unsafe")


def print_result(result: RehearseResult, out: Path, console: Console) -> None:
    for scenario in result.scenarios:
        console.print(f"{printable(scenario.heading)}: {conditions(result)}", markup=False)
        console.print(_table(result, scenario.name))
        console.print()
    for line in remarks(result):
        console.print(printable(line), markup=False)
    unsafe = result.unsafe_events
    console.print(f"unsafe events at the simulated drives, all runs: {unsafe}", style="bold red" if unsafe else "")
    console.print(f"result: {out}", markup=False, soft_wrap=True)


def conditions(result: RehearseResult) -> str:
    given = result.conditions
    under = f"tier {result.tier}" if result.tier else "the line's own conditions"
    return (
        f"{under}, {1e3 * given.period_s:g} ms, latency {1e3 * given.latency_s:g} ms, {given.torque_nm:g} Nm, "
        f"seed {result.seed}"
    )


def remarks(result: RehearseResult) -> list[str]:
    """What the figures do not say."""
    told = [line for one in result.rounds for line in _round(one)]
    for one in result.configurations:
        if one.refused is not None:
            told.append(f"{one.name} is not offered: {one.refused}")
        told += [f"{one.name} has no figures in {scenario}: {why}" for scenario, why in one.failures.items()]
        told += [f"{one.name} in {case.scenario}: {case.stopped}" for case in one.cases if case.stopped is not None]
    if result.without_term:
        told.append("the plant has what no model of a design has a term for:")
        told += [f"  {what}" for what in result.without_term]
    return told


def _round(one: AdaptationResult) -> list[str]:
    """A round of adaptation, what it found, and what speaks against it."""
    if one.refused:
        told = [f"adaptation {one.number} was not completed: {why}" for why in one.refused]
        return told + [f"  {text}" for text in one.tried]
    strong = ", ".join(
        f"{symbol} {found.value:.5g} +-{50.0 * (found.high - found.low) / found.value:.2g} %"
        for name, symbol in STRONG.items()
        if (found := one.intervals.get(name)) is not None
    )
    told = [
        f"adaptation {one.number}: {one.data_s:g} s of data, structure {one.structure}; {strong}",
        f"  innovations on held-out data {one.normalised_innovation:.2f} of what noise makes (1 is right)",
    ]
    if one.tried:
        told.append(f"  through the gate: {len(one.tried)} candidates, {one.deployments} deployments")
    told += [f"  {text}" for text in one.tried if not text.endswith((": kept", ": done"))]
    return told + [f"  {finding}" for finding in one.findings]


def _table(result: RehearseResult, scenario: str) -> Table:
    table = Table(box=SIMPLE_HEAD, show_edge=False, pad_edge=False, padding=(0, 1, 0, 0))
    for name in COLUMNS:
        table.add_column(name, justify="left" if name == "configuration" else "right", no_wrap=True)
    for one in result.configurations:
        for case in one.cases:
            if case.scenario == scenario:
                table.add_row(one.name, *_cells(case), style="bold red" if case.unsafe_events or case.stopped else "")
    return table


def _cells(case: CaseResult) -> list[str]:
    """Settling and overshoot of the worst span."""
    settling = [np.inf if time_s is None else time_s for time_s in case.settling_s]
    ratio = case.ratio_to_truth_design
    return [
        f"{case.rmse_n:.3f}",
        "-" if ratio is None else f"{ratio:.3f}",
        "never" if np.isinf(max(settling)) else f"{max(settling):.2f}",
        f"{max(case.overshoot_pct):.1f}",
        f"{case.compute_us.p99:.0f}",
        f"{case.tension_min_n:.0f} to {case.tension_max_n:.0f}",
        "STOP" if case.stopped is not None else str(case.unsafe_events),
    ]
