"""`r2rgate commission`: a new line brought from its file to an adapted configuration, each step through the gate."""

import asyncio
from typing import Annotated

import typer

from gateway.cli.operate_commands import RunFolder
from gateway.cli.process_commands import REFUSED, LineFile, read_line

NOT_REACHED = 1  #: exit code


def commission(
    file: LineFile,
    speed: Annotated[
        float | None,
        typer.Option("--speed", min=0.001, help="m/s, up to which it is adapted; default: as fast as its drives hold."),
    ] = None,
    adaptations: Annotated[int, typer.Option("--adaptations", min=1, help="Redesigns, at least.")] = 1,
    run_dir: RunFolder = None,
) -> None:
    """Bring a new line that runs to an adapted configuration over its range of speeds, each step through the gate.

    Configuration, experiment, model, redesign, and again at higher speeds: each is proposed, judged, and waits for a
    person's `r2rgate approve`. Ctrl-C ends this command and changes nothing on the line; started again, it goes on.
    Exit code 0: reached; 1: the candidates have come to an end, with the reason.

    Example: r2rgate commission line.toml

    Example, to the speed at which the line produces, and once more on all data: r2rgate commission line.toml
    --speed 0.08 --adaptations 2
    """
    from gateway.cli.commission import commission as carried_out
    from gateway.cli.commission_live import TOPICS, LiveGate
    from gateway.cli.status_commands import choose_run_folder
    from gateway.cli.waiting import interruptible
    from gateway.mailbox.listener import PathTooLong
    from gateway.mailbox.paths import GATEWAY_SOCKET, default_run_folder, running_lines
    from gateway.mailbox.unix import UnixMailbox

    line = read_line(file)
    own = default_run_folder(line)
    folder = choose_run_folder(run_dir or (own if own in running_lines() else None))

    async def run() -> bool:
        mailbox = UnixMailbox()
        mailbox.connect(TOPICS, folder / GATEWAY_SOCKET)
        try:
            found = await carried_out(line, LiveGate(line, mailbox, typer.echo), typer.echo, speed, adaptations)
        finally:
            await mailbox.close()
        typer.echo(f"{'commissioned' if found.reached else 'not commissioned'}: {found.text}")
        return found.reached

    try:
        with interruptible("nothing of what is approved is lost; the same command goes on from here"):
            reached = asyncio.run(run())
    except PathTooLong as error:
        typer.echo(str(error), err=True)
        raise typer.Exit(REFUSED) from None
    if not reached:
        raise typer.Exit(NOT_REACHED)
