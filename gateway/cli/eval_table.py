"""An evaluation for a person to read."""

from pathlib import Path

from rich.box import SIMPLE_HEAD
from rich.console import Console
from rich.table import Table

from gateway.cli.eval_result import EvalResult, PolicyFigures, Rejections
from gateway.core.line_problem import printable

HEADS = (
    "decides", "done", "conv.", "tried", "kept", "/truth", "max", "/begin", "unsafe", "own", "CPU"
)  # fmt: skip
RATIOS = (
    "done: an adapted configuration is in service, and conv.: it has converged; /truth: RMSE over that of the rules' "
    "design on the truth, median and max of all cases; /begin: over that of what was in service at the begin, max; "
    "own: questions that were not left to the rules; CPU: seconds of a chain"
)


def print_result(result: EvalResult, out: Path, console: Console) -> None:
    table = Table(box=SIMPLE_HEAD, show_edge=False, pad_edge=False, padding=(0, 1, 0, 0))
    for name in HEADS:
        table.add_column(name, justify="left" if name == HEADS[0] else "right")
    for one in result.figures:
        table.add_row(*map(printable, _cells(one)), style="bold red" if one.unsafe_accepted or one.stopped else "")
    if result.figures:
        console.print(table)
    for line in remarks(result):
        console.print(printable(line), markup=False, soft_wrap=True)
    console.print(f"result: {out}", markup=False, soft_wrap=True)


def remarks(result: EvalResult) -> list[str]:
    """What the table does not say, in sentences."""
    count = f"{len(result.tasks)} of {result.tasks_asked}" if not result.complete else f"{len(result.tasks)}"
    told = [f"tasks: {count}, {result.spans} spans, seed {result.seed}; each was tried once; {RATIOS}"]
    told += [f"{one.policy}: {rejected(one.rejections)}" for one in result.figures if one.rejections]
    told += [
        f"{one.policy}: {one.overruled} times the rules had the last word (decision 40)"
        for one in result.figures if one.overruled
    ]  # fmt: skip
    for one in result.figures:
        if spent := one.asked.tokens_in + one.asked.tokens_out:
            told.append(f"{one.policy}: {spent} tokens, {one.asked.seconds:.0f} s for answers")
    for task in result.tasks:
        for trial in task.trials:
            told += [f"task {task.number + 1}, {trial.policy}: {stopped}" for stopped in trial.stopped]
            if not trial.reached:
                told.append(f"task {task.number + 1}, {trial.policy}: {trial.end}")
    unsafe = sum(one.unsafe_accepted for one in result.figures)
    told.append(f"unsafe events at the simulated drives, all trials: {unsafe}")
    return told


def rejected(rows: list[Rejections]) -> str:
    return ", ".join(f"{one.times} {one.stage}{f' ({one.by})' if one.by else ''}" for one in rows)


def _cells(one: PolicyFigures) -> list[str]:
    asked = one.asked
    return [
        one.policy,
        f"{one.reached}/{one.trials}",
        f"{one.converged}/{one.trials}",
        f"{one.iterations:.1f}",
        f"{one.deployments:.1f}",
        *(_ratio(value) for value in (one.to_truth_p50, one.to_truth_worst, one.to_begin_worst)),
        str(one.unsafe_accepted),
        f"{asked.answered}/{asked.questions}",
        f"{one.processor_s:.0f}",
    ]


def _ratio(value: float | None) -> str:
    return "-" if value is None else f"{value:.3f}"
