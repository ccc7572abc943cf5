"""`r2rgate refine`: the model of a line identified anew in downtime, and a redesign on it, through the gate."""

import typer

from gateway.cli.operate_commands import RunFolder
from gateway.cli.process_commands import REFUSED, LineFile, read_line

NOT_REFINED = 1  #: exit code


def refine(file: LineFile, run_dir: RunFolder = None) -> None:
    """Identify a line's model anew, in downtime, on the experiments since it was accepted, and redesign on it.

    The accepted model is the prior as far as the data agree with it. What is in service is archived as phi_stable
    first: `r2rgate propose phi_stable --reason ...` brings it back. Model and redesign wait for `r2rgate approve`; a
    redesign is kept once the line has run with it.

    Exit code: 0 refined, 1 the gate or a person has let no model through, 2 refused: the line runs, or has no data.

    Example: r2rgate refine line.toml
    """
    from gateway.cli.commission_commands import with_gate
    from gateway.cli.commission_side import CannotGoOn
    from gateway.cli.refine import refine as carried_out
    from gateway.cli.waiting import interruptible

    line = read_line(file)
    try:
        with interruptible("what is approved stays; nothing else is changed"):
            found = with_gate(line, run_dir, typer.echo, lambda side: carried_out(line, side, typer.echo))
    except CannotGoOn as error:
        typer.echo(f"not refined: {error}", err=True)
        raise typer.Exit(REFUSED) from None
    typer.echo(found.text)
    if not found.model:
        raise typer.Exit(NOT_REFINED)
