"""Phase 1 on the terminal: the comparison as a table that fits 80 columns, then the reasons."""

from collections.abc import Sequence

from rich.box import SIMPLE_HEAD
from rich.console import Console
from rich.table import Table

from gateway.cli.design_result import DesignResult
from gateway.commissioning.selection import Candidate

COLUMNS = ("law", "RMSE N", "t_s s", "OS %", "effort", "R N", "us", "delay", "S", "gate")
LEFT_OUT = COLUMNS.index("effort")  #: of a terminal: the page has it


def print_design(result: DesignResult, took_s: float) -> None:
    console = Console(highlight=False)
    for sentence in result.assessment.sentences:
        console.print(sentence, markup=False, soft_wrap=True)
    table = Table(box=SIMPLE_HEAD, pad_edge=False, padding=(0, 1, 0, 0))
    for name in _shown(COLUMNS):
        table.add_column(name, justify="left" if name in ("law", "gate") else "right", no_wrap=True)
    for candidate in result.candidates:
        table.add_row(*_shown(cells(candidate)), style="bold" if candidate.architecture == result.chosen else "")
    console.print(table)
    for sentence in result.explanation:
        console.print(sentence, markup=False, soft_wrap=True)
    if result.judged:
        console.print(f"gate: judged beforehand, {result.judged}.", markup=False, soft_wrap=True)
    attempts = sum(len(one.history) for one in result.tuning)
    model, within = ("identified model", "its intervals") if result.model else ("nominal model", "the tolerances")
    console.print(
        f"{attempts} attempts on the {model} and up to {result.plants} lines within {within}, {took_s:.0f} s. "
        f"RMSE, t_s, OS: {model}; R: worst of {within}; us: a step; delay: ms that it stands.",
        soft_wrap=True,
    )


def _shown(row: Sequence[str]) -> list[str]:
    return [*row[:LEFT_OUT], *row[LEFT_OUT + 1 :]]


def cells(candidate: Candidate) -> list[str]:
    """A row of the comparison; a dash for what there is not."""
    trial = candidate.trial
    if trial is None:  # explained below the table
        return [candidate.architecture, *["-"] * (len(COLUMNS) - 1)]
    rmse = sum(trial.rmse_n.values()) / len(trial.rmse_n)
    return [
        candidate.architecture,
        f"{rmse:.3f}",
        "never" if trial.settling_s is None else f"{trial.settling_s:.2f}",
        f"{trial.overshoot_pct:.1f}",
        f"{trial.effort_n2m2s:.0f}",
        "-" if trial.robustness_n is None else f"{trial.robustness_n:.1f}",
        "-" if candidate.compute_s is None else f"{1e6 * candidate.compute_s:.0f}",
        f"{1e3 * trial.delay_margin_s:.1f}",
        "-" if candidate.score is None else f"{candidate.score:.3f}",
        "-" if candidate.gate is None else candidate.gate.short,
    ]
