"""Commands of the operator. All go through the gateway, which keeps them; `stop` goes straight to the loop."""

import asyncio
from math import isfinite
from pathlib import Path
from typing import Annotated, NoReturn

import typer
from pydantic import ValidationError

from gateway.cli.stop_line import stop_line
from gateway.core.finding import finding
from gateway.core.messages import Arm, Command, Hold, Reply, SelectRecipe, SetSpeed, SetTension, Start, Stop
from gateway.core.topics import GATEWAY_COMMAND, SAFE_S
from gateway.mailbox.listener import PathTooLong
from gateway.mailbox.paths import GATEWAY_SOCKET
from gateway.mailbox.port import Unreachable
from gateway.mailbox.unix import UnixMailbox
from gateway.wording.catalogue import sentence

REFUSED, UNREACHABLE = 2, 3
ARM_TIME_S = 15.0
REPLY_TIME_S = 3.0

RunFolder = Annotated[Path | None, typer.Option("--run-dir", help="Where the line's sockets lie.")]
Json = Annotated[bool, typer.Option("--json", help="Print the reply as JSON.")]


def arm(run_dir: RunFolder = None, as_json: Json = False) -> None:
    """Prove limits, line PLC, load cells and the drives' watchdogs; then READY, with zero torque.

    Example: r2rgate arm
    """
    send(Arm(), run_dir, as_json, ARM_TIME_S)


def start(run_dir: RunFolder = None, as_json: Json = False) -> None:
    """Tension the web at standstill, then run at the set speed. After `hold`: back to speed.

    Example: r2rgate start
    """
    send(Start(), run_dir, as_json)


def hold(run_dir: RunFolder = None, as_json: Json = False) -> None:
    """Ramp the line to standstill and keep the web under tension.

    Example: r2rgate hold
    """
    send(Hold(), run_dir, as_json, SAFE_S)


def stop(run_dir: RunFolder = None, as_json: Json = False) -> None:
    """Controlled stop: ramp to standstill, then torque off. Straight to the loop, also when the gateway is gone.

    It is done once the loop shows it; what only says so is not believed.

    It is no emergency stop: that is hard-wired, beside the line.

    Example: r2rgate stop
    """
    send(Stop(), run_dir, as_json, SAFE_S)


def set_tension(
    span: Annotated[int, typer.Argument(help="Number of the span, from 1.")],
    tension_n: Annotated[float, typer.Argument(help="Tension in N.")],
    step: Annotated[
        bool, typer.Option("--step", help="At once rather than ramped; the line's limits bound it.")
    ] = False,
    run_dir: RunFolder = None,
    as_json: Json = False,
) -> None:
    """Set the tension of a span.

    Example: r2rgate set 3 44
    """
    if span < 1:
        _refuse(f"there is no span {span}; allowed: 1 or more, as they stand in the line's file")
    _require_number(tension_n, "N", "a tension inside the line's limits")
    send(SetTension(span=span, tension_n=tension_n, step=step), run_dir, as_json)


def speed(
    speed_m_per_s: Annotated[float, typer.Argument(help="Web speed at the unwinder in m/s.")],
    step: Annotated[
        bool, typer.Option("--step", help="At once rather than ramped; the line's limits bound it.")
    ] = False,
    run_dir: RunFolder = None,
    as_json: Json = False,
) -> None:
    """Set the line's speed.

    Example: r2rgate speed 0.05
    """
    _require_number(speed_m_per_s, "m/s", "a speed from 0 to the line's limit")
    send(SetSpeed(speed_m_per_s=speed_m_per_s, step=step), run_dir, as_json)


def recipe(
    name: Annotated[str, typer.Argument(help="A recipe of the line's file.")],
    run_dir: RunFolder = None,
    as_json: Json = False,
) -> None:
    """Move all set-points to those of a recipe: a grade change.

    Example: r2rgate recipe velocity
    """
    send(SelectRecipe(name=name), run_dir, as_json)


async def request(run_folder: Path, command: Command, timeout_s: float = REPLY_TIME_S) -> Reply:
    """Send one command and wait for its reply. Raises Unreachable and PathTooLong."""
    if isinstance(command, Stop):
        return await stop_line(run_folder, timeout_s)
    topic, socket = GATEWAY_COMMAND, GATEWAY_SOCKET
    mailbox = UnixMailbox()
    mailbox.connect({topic}, run_folder / socket)
    try:
        answer = await mailbox.request(topic, command.model_dump_json().encode(), timeout_s)
    finally:
        await mailbox.close()
    try:
        return Reply.model_validate_json(answer)
    except ValidationError as error:
        raise Unreachable("what answers there is of another version than this command") from error


def _require_number(value: float, unit: str, allowed: str) -> None:
    if not isfinite(value):
        _refuse(f"{value} {unit} is no set-point; allowed: {allowed}, a finite number in {unit}")


def _refuse(text: str) -> NoReturn:
    typer.echo(text, err=True)
    raise typer.Exit(REFUSED)


def send(command: Command, run_dir: Path | None, as_json: bool, timeout_s: float = REPLY_TIME_S) -> None:
    """Send it and print the reply. Ends the program with code 2 where it is refused, 3 where nobody answers."""
    from gateway.cli.status_commands import choose_run_folder

    try:
        reply = asyncio.run(request(choose_run_folder(run_dir), command, timeout_s))
    except PathTooLong as error:
        typer.echo(str(error), err=True)
        raise typer.Exit(UNREACHABLE) from None
    except Unreachable as error:
        safe = {"stop": "loop-unanswered", "hold": "gateway-unanswered"}.get(command.command)
        text = sentence(finding(safe, command=command.command, because=str(error))) if safe else str(error)
        typer.echo(text, err=True)
        raise typer.Exit(UNREACHABLE) from None
    if as_json:
        typer.echo(reply.model_dump_json(indent=2))
    elif reply.ok:
        typer.echo(f"{reply.state}: {reply.text}")
    else:
        typer.echo(f"{'refused' if reply.known else 'not known'} ({reply.state}): {reply.text}", err=True)
        for reason in reply.reasons:
            typer.echo(f"  - {reason}", err=True)
    if not reply.ok:
        raise typer.Exit(REFUSED)
