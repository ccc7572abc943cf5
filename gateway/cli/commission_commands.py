"""`r2rgate commission`: a new line brought from its file to an adapted configuration, each step through the gate."""

import asyncio
from collections.abc import Awaitable, Callable
from typing import TYPE_CHECKING, Annotated, TypeVar

import typer

from gateway.cli.operate_commands import RunFolder
from gateway.cli.process_commands import REFUSED, LineFile, read_line

if TYPE_CHECKING:
    from pathlib import Path

    from gateway.cli.commission_history import Tried
    from gateway.cli.commission_live import LiveGate
    from gateway.commissioning.decisions import Decider
    from gateway.core.line import Line

NOT_REACHED = 1  #: exit code
MOST_WHY = 1000
T = TypeVar("T")


def commission(
    file: LineFile,
    speed: Annotated[
        float | None,
        typer.Option("--speed", min=0.001, help="m/s, up to which it is adapted; default: as fast as its drives hold."),
    ] = None,
    adaptations: Annotated[int, typer.Option("--adaptations", min=1, help="Redesigns, at least.")] = 1,
    run_dir: RunFolder = None,
    history: Annotated[
        bool, typer.Option("--history", help="Show what has been tried on the line until now; propose nothing.")
    ] = False,
    again: Annotated[
        str | None,
        typer.Option(
            "--again",
            metavar="WHY",
            help="The line is no longer as it was (another grade, a new part): anew from its file and low speed on.",
        ),
    ] = None,
    as_json: Annotated[bool, typer.Option("--json", help="With --history: print as JSON.")] = False,
) -> None:
    """Bring a new line that runs to an adapted configuration over its range of speeds, each step through the gate.

    Configuration, experiment, model, redesign, and again at higher speeds; then what the configuration does is
    measured, and a newer model and redesign follow, until it converges (tracking error, overshoot, settling time) and
    nothing significant is left to gain. Each is proposed, judged, and waits for a person's `r2rgate approve`. Ctrl-C
    ends this command and changes nothing on the line; started again, it goes on.

    Exit code: 0 adapted and converged, 1 not, with the reason, 2 refused.

    Example: r2rgate commission line.toml

    Example, to the speed at which the line produces, and once more on all data: r2rgate commission line.toml
    --speed 0.08 --adaptations 2

    Example, after another web was threaded, and its stiffness written into the file: r2rgate commission line.toml
    --again "PET 50 um instead of 36"
    """
    from gateway.cli.commission import commission as carried_out
    from gateway.cli.commission_history import history as tried_on
    from gateway.cli.commission_result import Commissioned
    from gateway.cli.commission_side import CannotGoOn
    from gateway.cli.waiting import interruptible
    from gateway.commissioning.chain import refused_at_once

    line = read_line(file)
    if history:
        try:
            found = with_gate(line, run_dir, lambda text: None, lambda side: tried_on(line, side))
        except CannotGoOn as error:
            typer.echo(str(error), err=True)
            raise typer.Exit(REFUSED) from None
        _show(found, as_json)
        return

    if again is not None:
        _require_reason(again, refused_at_once(line))

    async def whole(side: "LiveGate") -> Commissioned:
        try:
            if again is not None:
                await side.line_changed(again)
        except CannotGoOn as error:
            return Commissioned(False, str(error), [], None)
        return await with_agents(
            line,
            run_dir,
            lambda decider: carried_out(
                line, side, typer.echo, wanted_m_per_s=speed, adaptations=adaptations, decider=decider
            ),
        )

    without = "" if again is None else ", without --again,"
    with interruptible(f"nothing of what is approved is lost; the same command{without} goes on from here"):
        ended = with_gate(line, run_dir, typer.echo, whole)
    typer.echo(f"{'commissioned' if ended.reached else 'not commissioned'}: {ended.text}")
    if not ended.converged:
        raise typer.Exit(NOT_REACHED)


def _require_reason(again: str, closed: str) -> None:
    """Nothing that was learned of a line is given up for a slip of the hand."""
    why = closed or ("" if 0 < len(again.strip()) <= MOST_WHY else f"--again takes the reason, 1 to {MOST_WHY} letters")
    if why:
        typer.echo(why, err=True)
        raise typer.Exit(REFUSED)


async def with_agents(line: "Line", run_dir: "Path | None", work: Callable[["Decider"], Awaitable[T]]) -> T:
    """What `work` finds with the agents on the bus of `line`; with the rules alone where there is no bus."""
    from gateway.cli.asked_agents import AskedAgents
    from gateway.commissioning.decisions import AGENTS, Rules
    from gateway.mailbox.bus import BusUnavailable, connect

    if AGENTS not in line.gate.authors:
        return await work(Rules())
    try:
        bus = await connect(_run_folder(line, run_dir), line.site, line.line)
    except BusUnavailable as error:
        typer.echo(f"the agents cannot be asked, the rules decide: {error}")
        return await work(Rules())
    try:
        return await work(AskedAgents(line, bus, asyncio.get_running_loop(), tell=typer.echo))
    finally:
        await bus.close()


def _run_folder(line: "Line", run_dir: "Path | None") -> "Path":
    from gateway.cli.status_commands import choose_run_folder
    from gateway.mailbox.paths import default_run_folder, running_lines

    own = default_run_folder(line)
    return choose_run_folder(run_dir or (own if own in running_lines() else None))


def with_gate(
    line: "Line", run_dir: "Path | None", tell: Callable[[str], None], work: Callable[["LiveGate"], Awaitable[T]]
) -> T:
    """What `work` finds with the gateway of `line`."""
    from gateway.cli.commission_live import TOPICS, LiveGate
    from gateway.mailbox.listener import PathTooLong
    from gateway.mailbox.paths import GATEWAY_SOCKET
    from gateway.mailbox.unix import UnixMailbox

    folder = _run_folder(line, run_dir)

    async def run() -> T:
        mailbox = UnixMailbox()
        mailbox.connect(TOPICS, folder / GATEWAY_SOCKET)
        try:
            return await work(LiveGate(line, mailbox, tell))
        finally:
            await mailbox.close()

    try:
        return asyncio.run(run())
    except PathTooLong as error:
        typer.echo(str(error), err=True)
        raise typer.Exit(REFUSED) from None


def _show(tried: "list[Tried]", as_json: bool) -> None:
    import json

    from rich.box import SIMPLE_HEAD
    from rich.console import Console
    from rich.table import Table

    from gateway.cli.commission_history import approvals
    from gateway.core.line_problem import printable

    if as_json:
        typer.echo(json.dumps({"tried": [one.data() for one in tried], "approvals": approvals(tried)}, indent=2))
        return
    table = Table(box=SIMPLE_HEAD, show_edge=False, pad_edge=False, padding=(0, 1, 0, 0))
    for name in ("round", "proposed", "what", "why", "became of it", "measured"):
        table.add_column(name)
    for one in tried:
        table.add_row(*map(printable, one.row()))
    Console(highlight=False, markup=False).print(table)
    typer.echo(f"{len(tried)} proposals, {approvals(tried)} of them approved")
