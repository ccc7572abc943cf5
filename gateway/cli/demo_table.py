"""The quick demonstration on the terminal: a table that fits 80 columns, and the lines that every one ends with."""

import numpy as np
from rich.box import SIMPLE_HEAD
from rich.console import Console
from rich.table import Table

from gateway.cli.demo_result import DemoResult

COLUMNS = ("case", "RMSE N", "stepped N", "ratio", "goal", "worst", "tension N", "unsafe")


def print_cases(result: DemoResult, console: Console) -> None:
    (configuration,) = result.configurations
    table = Table(box=SIMPLE_HEAD, pad_edge=False, padding=(0, 1, 0, 0))
    for name in COLUMNS:
        table.add_column(name, justify="left" if name == "case" else "right", no_wrap=True)
    for case in configuration.cases:
        worst = int(np.argmax(case.rmse_per_span_n))
        met = case.ratio_to_stepped <= case.limit_ratio
        table.add_row(
            case.name,
            f"{case.rmse_n:.3f}",
            f"{case.stepped_rmse_n:.3f}",
            f"{case.ratio_to_stepped:.3f}",
            f"<= {case.limit_ratio:g} {'met' if met else 'MISSED'}",
            f"{worst + 1}: {case.rmse_per_span_n[worst]:.2f}",
            f"{case.tension_min_n:.0f} to {case.tension_max_n:.0f}",
            str(case.unsafe_events),
        )
    console.print(table)
    law = configuration.law.upper()
    text = f"{law}, designed on a model that is wrong on purpose; judged by the recorder at the devices."
    console.print(text, markup=False, soft_wrap=True)
    print_common(result, console)


def print_common(result: DemoResult, console: Console) -> None:
    timing, unsafe = result.timing, sum(result.unsafe_events.values())
    lateness, cycle = timing.lateness_us, timing.cycle_us
    lines = [
        f"{timing.periods} periods of {timing.period_s * 1e3:g} ms, {timing.missed} missed; wake-up late by p50 "
        f"{lateness.p50:.0f}, p99 {lateness.p99:.0f} us; cycle p50 {cycle.p50:.0f}, p99 {cycle.p99:.0f} us",
        *result.machine[1:],
    ]
    lines += [f"begun anew after the line had stopped: {stop}" for stop in result.stops]
    for line in lines:
        console.print(line, markup=False, soft_wrap=True)
    console.print(f"unsafe events at the drives, whole run: {unsafe}", style="bold red" if unsafe else "")
