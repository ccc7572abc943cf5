"""`r2rgate baselines`: what configurations did on the line, and which of it the line is held against."""

import json
from datetime import UTC, datetime
from math import isfinite
from pathlib import Path
from typing import Annotated, Any

import typer
from rich.box import SIMPLE_HEAD
from rich.console import Console
from rich.table import Table

from gateway.cli.data_place import gateway_data
from gateway.cli.process_commands import REFUSED, DataFolder, read_line
from gateway.core.line_problem import printable
from gateway.supervisor.baselines import FILE_NAME, BaselinesError, Measurement, in_force, open_baselines

SHORT = 8  #: letters of a hash


def baselines(
    line: Annotated[
        Path | None, typer.Option("--line", help="The line description; not needed where one line has baselines.")
    ] = None,
    data_dir: DataFolder = None,
    configuration: Annotated[
        str | None, typer.Option("--configuration", help="Only of this one: the beginning of its id.")
    ] = None,
    scenario: Annotated[str | None, typer.Option("--scenario", help="Only of this scenario.")] = None,
    as_json: Annotated[bool, typer.Option("--json", help="Print as JSON.")] = False,
) -> None:
    """Every measurement, the oldest first; * is the baseline of its line and scenario, (*) was it earlier.

    Exit code: 0 listed, 2 refused.

    Example: r2rgate baselines --scenario tension
    """
    described = None if line is None else read_line(line)
    advice = "the gateway stores what a configuration does on the line"
    try:
        folder = gateway_data(described, data_dir, FILE_NAME, "baselines", advice, BaselinesError)
        with open_baselines(folder / FILE_NAME) as database:
            key = (described.site, described.line) if described else (None, None)
            every = database.measurements(*key)
    except BaselinesError as error:
        typer.echo(printable(str(error)), err=True)
        raise typer.Exit(REFUSED) from error
    now = {one.number for one in in_force(every).values()}
    shown = [
        one
        for one in every
        if one.run.configuration.startswith((configuration or "").lower()) and scenario in (None, one.run.scenario)
    ]
    if as_json:
        typer.echo(
            json.dumps({"database": str(database.path), "measurements": [_data(o, now) for o in shown]}, indent=2)
        )
        return
    _print(shown, now)
    typer.echo(f"{len(shown)} of {len(every)} measurements; database: {database.path}")


def _print(shown: list[Measurement], now: set[int]) -> None:
    table = Table(box=SIMPLE_HEAD, show_edge=False, pad_edge=False, padding=(0, 1, 0, 0))
    for name in ("", "measured", "scenario", "phi", "model", "RMSE\nN", "OS\n%", "t_s\ns", "effort\nN²m²s"):
        table.add_column(name, no_wrap=True)
    for one in shown:
        run, metrics = one.run, one.run.measured
        table.add_row(
            "*" if one.number in now else "(*)" if one.baseline else "",
            datetime.fromtimestamp(run.measured_s, UTC).strftime("%Y-%m-%d %H:%M"),
            printable(run.scenario),
            run.configuration[:SHORT],
            (run.model or "-")[:SHORT],
            *(f"{value:.4g}" if isfinite(value) else "never" for value in metrics),
        )
    Console(highlight=False, markup=False).print(table)


def _data(one: Measurement, now: set[int]) -> dict[str, Any]:
    metrics = {name: value if isfinite(value) else None for name, value in one.run.measured._asdict().items()}
    return {
        "number": one.number, **vars(one.run), "measured": metrics, "is_baseline": one.number in now,
        "baseline": [each._asdict() for each in one.baseline],
    }  # fmt: skip
