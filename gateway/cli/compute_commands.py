"""`r2rgate compute`: calls of the Code agent's closed list, from a file, in the same confined process."""

import asyncio
from pathlib import Path
from typing import Annotated, Any, NoReturn

import typer

from gateway.cli.process_commands import CRASHED, REFUSED, ControllerFile, DataFolder, LineFile, read_line
from gateway.core.line_problem import printable

LARGEST_BYTES = 65_536
WITHIN_S = 600.0
CallFile = Annotated[
    Path, typer.Argument(help="JSON: a call, or a list of calls of which later ones may name earlier.")
]


def compute(
    file: LineFile,
    call: CallFile,
    controller: ControllerFile = None,
    model: Annotated[
        str | None, typer.Option(help="What is in-service: a model's file, a version, an id, or newest.")
    ] = None,
    recording: Annotated[list[Path] | None, typer.Option(help="CSV or MCAP; repeatable, the newest first.")] = None,
    data_dir: DataFolder = None,
    as_json: Annotated[bool, typer.Option("--json", help="Print the results as JSON.")] = False,
) -> None:
    """Compute as the Code agent does for the others: simulate, identify, design, tune, margins, spectrum, compare.

    Each call runs in a process without network, with little time and memory. Nothing of it reaches a drive. Without
    --controller what the records in the data folder have is in-service; without --model the one that was accepted
    last, as the data folder has it, else the line's file speaks.
    What a call may say: docs/agents.md.

    Exit code: 0 computed, 1 a call came to no end, 2 refused.

    Example: echo '{"call": "design", "architecture": "lqi"}' > call.json; r2rgate compute line.toml call.json

    Example, an earlier call's controller: '\\[{"call": "design", "architecture": "lqg"}, {"call": "simulate",
    "controller": "call 1"}]'
    """
    from agents.code.agent import CodeAgent
    from gateway.cli.compute_materials import MaterialsRefused, given
    from gateway.cli.compute_view import as_text
    from gateway.core.interactions import Interaction

    line = read_line(file)
    calls = _calls(call)
    try:
        materials = given(line, file, controller, model, recording or [], data_dir)
    except MaterialsRefused as error:
        _refuse(str(error))

    async def keep(_: Interaction) -> None:
        """What a person computes here is in nobody's log."""

    task = CodeAgent(line, materials, keep).task("engineer", f"r2rgate compute {call.name}")
    results = asyncio.run(task.compute(calls, WITHIN_S))
    if as_json:
        typer.echo("[" + ",\n".join(one.model_dump_json() for one in results) + "]")
    else:
        typer.echo("\n\n".join(map(as_text, results)))
    if any(one.refused for one in results):
        raise typer.Exit(REFUSED)
    if any(one.failed for one in results):
        raise typer.Exit(CRASHED)


def _calls(path: Path) -> list[Any]:
    from gateway.core.computations import MOST_CALLS
    from gateway.core.json_problems import NotJson, document_of

    try:
        with path.open("rb") as stream:
            payload = stream.read(LARGEST_BYTES + 1)
    except OSError as error:
        _refuse(f"{path} cannot be read: {error.strerror}")
    if len(payload) > LARGEST_BYTES:
        _refuse(f"{path} is larger than {LARGEST_BYTES} bytes: no calls")
    try:
        if not payload.lstrip().startswith(b"["):
            return [document_of(payload)]
        calls: list[Any] = document_of(b'{"calls": ' + payload + b"}")["calls"]
    except NotJson as error:
        _refuse(f"{path}: {error}")
    if not 1 <= len(calls) <= MOST_CALLS:
        _refuse(f"{path} has {len(calls)} calls; allowed: 1 to {MOST_CALLS}")
    return calls


def _refuse(text: str) -> NoReturn:
    typer.echo(printable(text), err=True)
    raise typer.Exit(REFUSED)
