"""`r2rgate alarms`: what is wrong now, what follows and what to do; seen, and out of the way for a while."""

import asyncio
import json
import re
from pathlib import Path
from typing import Annotated, NoReturn

import typer
from pydantic import ValidationError
from rich.console import Console
from rich.text import Text

from gateway.cli.operate_commands import REFUSED, UNREACHABLE, Json, RunFolder
from gateway.cli.status_commands import ask_status, choose_run_folder
from gateway.cli.status_view import clock_time
from gateway.core.alarms import LONGEST_SHELVED_S, AcknowledgeAlarm, AlarmSaid, AlarmStatus, ShelveAlarm
from gateway.core.line_problem import printable
from gateway.core.messages import Reply
from gateway.core.topics import GATEWAY_ALARM
from gateway.mailbox.listener import PathTooLong
from gateway.mailbox.paths import GATEWAY_SOCKET
from gateway.mailbox.port import Unreachable
from gateway.mailbox.unix import UnixMailbox

ANSWER_S = 15.0
_UNITS_S = {"s": 1.0, "min": 60.0, "h": 3600.0}
_STYLE = {"high": "bold red", "medium": "bold yellow", "low": "bold"}

app = typer.Typer(name="alarms", help="Alarms of the line: what each means, what follows, what to do.")

Name = Annotated[str, typer.Argument(help="As `r2rgate alarms` has it, such as load-cell.")]


@app.callback(invoke_without_command=True)
def alarms(context: typer.Context, run_dir: RunFolder = None, as_json: Json = False) -> None:
    """What is active, has not been acknowledged, or is shelved. Exit code: 0 listed, 3 no gateway.

    Example: r2rgate alarms
    """
    if context.invoked_subcommand is not None:
        return
    try:
        found = asyncio.run(ask_status(choose_run_folder(run_dir))).alarms
    except (Unreachable, PathTooLong) as error:
        _refuse(str(error), UNREACHABLE)
    if as_json:
        typer.echo(json.dumps([one.model_dump() for one in found], indent=2))
        return
    console = Console(highlight=False)
    for one in found:
        console.print(_shown(one))
    if not found:
        typer.echo("no alarm")


@app.command()
def acknowledge(
    alarm: Name,
    comment: Annotated[str, typer.Option("--comment", help="For the record.")] = "",
    run_dir: RunFolder = None,
    as_json: Json = False,
) -> None:
    """You have seen it. It stays in the list as long as it is active. Exit code: 0 done, 2 refused, 3 no gateway.

    Example: r2rgate alarms acknowledge load-cell
    """
    try:
        said = AcknowledgeAlarm(alarm=alarm, comment=comment)
    except ValidationError as error:
        _refuse_as(error)
    _say(said, run_dir, as_json)


@app.command()
def shelve(
    alarm: Name,
    for_: Annotated[str, typer.Option("--for", help="30min, 2h; 8h at most; 0 brings it back at once.")],
    because: Annotated[str, typer.Option("--because", help="Why; it goes on record.")],
    run_dir: RunFolder = None,
    as_json: Json = False,
) -> None:
    """Out of the way for a while; it comes back by itself. Exit code: 0 done, 2 refused, 3 no gateway.

    Example: r2rgate alarms shelve load-cell --for 2h --because "being exchanged, order 4711"
    """
    try:
        said = ShelveAlarm(alarm=alarm, for_s=_seconds(for_), because=because)
    except ValidationError as error:
        _refuse_as(error)
    _say(said, run_dir, as_json)


def _shown(one: AlarmStatus) -> Text:
    marks = [
        "" if one.active else f"ended {_clock(one.ended_wall_s)}" if one.ended_wall_s else "not active",
        f"seen by {one.acknowledged_by}" if one.acknowledged_by else "" if one.acknowledged else "NOT ACKNOWLEDGED",
        "first of several" if one.first_out else "",
        f"shelved until {_clock(one.shelved_until_wall_s)}" if one.shelved_until_wall_s else "",
    ]
    told = ", ".join(mark for mark in marks if mark)
    dim = "dim" if one.shelved_until_wall_s else ""
    text = Text(f"{one.name}", _STYLE[one.priority] if one.active and not dim else dim)
    text.append(f"  {one.priority}, since {_clock(one.since_wall_s)}{f', {told}' if told else ''}\n", dim)
    text.append(f"  {one.means}{f': {printable(one.text)}' if one.text else ''}\n", dim)
    return text.append(f"  Cause: {one.cause}\n  Else: {one.consequence}\n  Do: {one.action}", "dim")


def _clock(wall_s: float | None) -> str:
    return "-" if wall_s is None else clock_time(wall_s)


def _seconds(text: str) -> float:
    if text == "0":
        return 0.0
    found = re.fullmatch(r"(\d+(?:\.\d+)?)(s|min|h)", text)
    seconds = float(found[1]) * _UNITS_S[found[2]] if found is not None else -1.0
    if not 0.0 < seconds <= LONGEST_SHELVED_S:
        _refuse(f"--for {text}: allowed is a time such as 30min or 2h, at most {LONGEST_SHELVED_S / 3600.0:g}h, or 0")
    return seconds


def _say(said: AlarmSaid, run_dir: Path | None, as_json: bool) -> None:
    async def asked() -> Reply:
        mailbox = UnixMailbox()
        mailbox.connect((GATEWAY_ALARM,), choose_run_folder(run_dir) / GATEWAY_SOCKET)
        try:
            answer = await mailbox.request(GATEWAY_ALARM, said.model_dump_json().encode(), ANSWER_S)
            return Reply.model_validate_json(answer)
        finally:
            await mailbox.close()

    try:
        reply = asyncio.run(asked())
    except (Unreachable, PathTooLong) as error:
        _refuse(str(error), UNREACHABLE)
    if as_json:
        typer.echo(reply.model_dump_json(indent=2))
    elif reply.ok:
        typer.echo(printable(reply.text))
    else:
        _refuse("\n".join([f"refused: {reply.text}", *(f"  - {reason}" for reason in reply.reasons)]))
    if not reply.ok:
        raise typer.Exit(REFUSED)


def _refuse_as(error: ValidationError) -> NoReturn:
    _refuse("; ".join(f"{'.'.join(map(str, one['loc']))}: {one['msg']}" for one in error.errors()))


def _refuse(text: str, code: int = REFUSED) -> NoReturn:
    for line in text.splitlines():
        typer.echo(printable(line), err=True)
    raise typer.Exit(code)
