"""`r2rgate prove`: show that the line is wired as its file says, before a controller ever acts on it."""

import asyncio
import getpass
import sys
from pathlib import Path
from typing import Annotated

import typer
from pydantic import ValidationError

from gateway.cli.operate_commands import ARM_TIME_S, REFUSED, REPLY_TIME_S, UNREACHABLE, Json, RunFolder, request
from gateway.cli.prove import Proved, prove
from gateway.cli.status_commands import ask_status, choose_run_folder
from gateway.core.finding import Finding
from gateway.core.messages import Arm, Command, Drill, Prove, Reply
from gateway.core.status import GatewayStatus
from gateway.mailbox.listener import PathTooLong
from gateway.mailbox.port import Unreachable
from gateway.wording.catalogue import sentence

DRILL_TIME_S = 90.0  #: with the longest warning


def prove_wiring(
    only: Annotated[
        list[str] | None,
        typer.Option("--only", help="Prove this device anew, and nothing else. May be given several times."),
    ] = None,
    run_dir: RunFolder = None,
    as_json: Json = False,
) -> None:
    """Prove the wiring: every watchdog reacts, every drive turns its own roller, every load cell sees its own span.

    The web is threaded, the unwinder stands, and nobody is at the line: one drive after the other pulls, with at most a
    fifth of the tension allowed. What no pull can show is asked. The proof is kept for this wiring, these device maps
    and these serial numbers; without it `start` is refused. Ctrl-C stops.

    Whoever has exchanged one drive, load cell or amplifier proves that alone, in some three minutes at most; the stored
    proof stands for all others. It is refused where anything else has changed. Load cells on one amplifier are
    exchanged together: name each.

    Example: r2rgate prove --only drive-3
    """
    try:
        Prove(only=only or [])
    except ValidationError:
        typer.echo(f"not proved: no device has such a name: {', '.join(only or [])}", err=True)
        raise typer.Exit(REFUSED) from None
    folder = choose_run_folder(run_dir)
    try:
        proved = asyncio.run(_prove(folder, only or [], as_json))
    except (Unreachable, PathTooLong) as error:
        typer.echo(str(error), err=True)
        raise typer.Exit(UNREACHABLE) from None
    _show(proved, as_json)
    if not proved.ok:
        raise typer.Exit(REFUSED)


async def _prove(folder: Path, only: list[str], as_json: bool) -> Proved:
    async def tell(command: Command) -> Reply:
        waits_s = {Drill: DRILL_TIME_S, Arm: ARM_TIME_S}.get(type(command), REPLY_TIME_S)
        return await request(folder, command, waits_s)

    async def look() -> GatewayStatus | None:
        try:
            return await ask_status(folder)
        except Unreachable:
            return None

    def say(text: str) -> None:
        if not as_json:
            typer.echo(text)

    try:
        return await prove(tell, look, _asked, getpass.getuser(), say, only)
    except asyncio.CancelledError:  # Ctrl-C
        from gateway.cli.stop_line import stop_line

        await stop_line(folder, REPLY_TIME_S)
        raise


def _asked(question: Finding) -> bool:
    """Whether a person has looked and says that it is as the line's file says. Without a terminal nobody has."""
    if not sys.stdin.isatty():
        return False
    return typer.confirm(f"{sentence(question)}. Have you looked, and is it as the line's file says?", default=False)


def _show(proved: Proved, as_json: bool) -> None:
    reply = proved.reply
    if as_json:
        typer.echo(reply.model_dump_json(indent=2))
    elif proved.ok:
        typer.echo(reply.text)
    else:
        typer.echo(f"not proved ({proved.step}): {reply.text}", err=True)
        for reason in reply.reasons:
            typer.echo(f"  - {reason}", err=True)
