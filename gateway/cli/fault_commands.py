"""`r2rgate fault`: what can go wrong on a simulated line, and letting it go wrong while the line runs."""

import asyncio
import json
from pathlib import Path
from typing import Annotated, Any, NoReturn

import typer

from gateway.core.line_problem import printable
from gateway.mailbox.listener import living

REFUSED, UNREACHABLE = 2, 3

app = typer.Typer(
    name="fault",
    help="Faults by name on a simulated line: list, inject, clear. They never reach a real line.",
    no_args_is_help=True,
)

_CONTROL = "Control socket of the simulated line, or the folder of its recording"
Control = Annotated[
    Path | None,
    typer.Option("--control", help=f"{_CONTROL}; not needed beside the only `r2rgate run --plant`."),
]
Json = Annotated[bool, typer.Option("--json", help="Print as JSON.")]


@app.command("list")
def list_faults(
    control: Annotated[
        Path | None, typer.Option("--control", help="Show what waits and acts on the line with this control socket.")
    ] = None,
    as_json: Json = False,
) -> None:
    """Every fault that there is; with --control those of a line that runs.

    Example: r2rgate fault list --control out/recording
    """
    if control is not None:
        _print_acting(_ask(control, {"do": "list"}), as_json)
        return
    from sim_plant.faults.page import parameter_words
    from sim_plant.faults.table import FAULTS

    if as_json:
        rows = [
            {
                "fault": fault.name,
                "of": [kind.value for kind in fault.kinds],
                "does": fault.does,
                "parameters": {p.name: parameter_words(p) for p in fault.parameters},
                "lasts": fault.lasting.value,
                "example": fault.example,
            }
            for fault in FAULTS
        ]
        typer.echo(json.dumps(rows, indent=2))
        return
    width = max(len(fault.name) for fault in FAULTS)
    for fault in FAULTS:
        typer.echo(f"{fault.name:<{width}}  {fault.does}")
        for parameter in fault.parameters:
            typer.echo(f"{'':<{width}}    {parameter.name}: {parameter_words(parameter)}")
        typer.echo(f"{'':<{width}}  {fault.example}")


@app.command()
def inject(
    fault: Annotated[
        list[str],
        typer.Argument(help="In quotes: TARGET [NUMBER] FAULT [NAME=VALUE ...] [at SECONDS] [for SECONDS]"),
    ],
    control: Control = None,
    as_json: Json = False,
) -> None:
    """Let something go wrong on a simulated line that runs, at once or at a time of the line.

    Example: r2rgate fault inject --control out/recording "load-cell 3 nan for 0.2"
    """
    from sim_plant.faults.parse import FaultRefused, parse_fault

    try:
        words = str(parse_fault(" ".join(fault)))
    except FaultRefused as refused:
        _refuse(str(refused), REFUSED)
    answer = _ask(control, {"do": "inject", "fault": words})
    if as_json:
        typer.echo(json.dumps(answer, indent=2))
    else:
        typer.echo(f"fault {answer['number']}: {words}, told at {answer['time_s']:.3f} s of the line")


@app.command()
def clear(
    number: Annotated[int | None, typer.Argument(help="Number of the fault; without it all of them.")] = None,
    control: Control = None,
    as_json: Json = False,
) -> None:
    """End a fault that was injected, or all of them; what is still to come does not come.

    Example: r2rgate fault clear 4 --control out/recording
    """
    answer = _ask(control, {"do": "clear"} if number is None else {"do": "clear", "number": number})
    if as_json:
        typer.echo(json.dumps(answer, indent=2))
    else:
        numbers = ", ".join(str(gone) for gone in answer["numbers"]) or "none"
        typer.echo(f"cleared: {numbers}, at {answer['time_s']:.3f} s of the line")


def _print_acting(answer: dict[str, Any], as_json: bool) -> None:
    if as_json:
        typer.echo(json.dumps(answer, indent=2))
        return
    for fault in answer["faults"]:
        end = "until cleared" if fault["end_s"] is None else f"to {fault['end_s']:.3f} s"
        state = "acts" if fault["acts"] else "waits"
        typer.echo(f"{fault['number']}  {state}  from {fault['begin_s']:.3f} s {end}  {printable(fault['fault'])}")
    if not answer["faults"]:
        typer.echo(f"no faults, at {answer['time_s']:.3f} s of the line")


def _ask(control: Path | None, request: dict[str, Any]) -> dict[str, Any]:
    """The answer of the line. Ends the command when it refuses or does not answer."""
    from sim_plant.faults.control import SOCKET_FILE, ControlUnavailable, ask

    control = control or _only_line()
    path = control / SOCKET_FILE if control.is_dir() else control
    try:
        answer = ask(path, request)
    except ControlUnavailable as error:
        _refuse(str(error), UNREACHABLE)
    if not answer["ok"]:
        _refuse(f"refused: {printable(str(answer.get('reason', 'no reason given')))}", REFUSED)
    return answer


def _only_line() -> Path:
    """The control socket of the simulated line beside the gateway that `r2rgate status` would find."""
    from gateway.cli.status_commands import ask_status, choose_run_folder
    from gateway.mailbox.paths import SIM_DATA
    from gateway.mailbox.port import Unreachable
    from sim_plant.faults.control import SOCKET_FILE

    folder = choose_run_folder(None)
    way_out = "name its recording with --control"
    try:
        data = Path(asyncio.run(ask_status(folder)).historian.path).parent.with_name(SIM_DATA)
    except Unreachable as error:
        _refuse(f"{folder}: {error}; {way_out}", UNREACHABLE)
    found = [path for path in sorted(data.glob(f"recording-*/{SOCKET_FILE}")) if living(path)]
    if len(found) != 1:
        count = "no simulated line" if not found else f"{len(found)} simulated lines"
        _refuse(f"{count} with a control socket in {data}; {way_out}", UNREACHABLE)
    return found[0]


def _refuse(text: str, code: int) -> NoReturn:
    typer.echo(text, err=True)
    raise typer.Exit(code)
