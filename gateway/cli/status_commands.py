"""`r2rgate status` and `r2rgate export`: what a line does now, and what it did."""

import asyncio
import csv
import json
import signal
import sys
import time
from collections.abc import Callable
from contextlib import nullcontext, suppress
from io import TextIOWrapper
from pathlib import Path
from typing import Annotated, Any, NoReturn

import typer
from numpy.typing import NDArray
from pydantic import ValidationError
from rich.console import Console
from rich.live import Live
from rich.text import Text

from gateway.cli.status_view import render
from gateway.core.clean_text import clean_texts
from gateway.core.status import GatewayStatus
from gateway.core.topics import GATEWAY_STATUS
from gateway.mailbox.listener import PathTooLong
from gateway.mailbox.paths import GATEWAY_SOCKET, running_lines
from gateway.mailbox.port import Unreachable
from gateway.mailbox.unix import UnixMailbox
from gateway.supervisor.history import History, HistoryError

EXIT_RUNNING, EXIT_USAGE, EXIT_NO_GATEWAY, EXIT_NO_LOOP = 0, 2, 3, 4
REFRESH_S = 0.2
TIMEOUT_S = 2.0

RunDir = Annotated[
    Path | None, typer.Option("--run-dir", help="Folder of the line's sockets; not needed where one line runs.")
]


def status(
    watch: Annotated[bool, typer.Option("--watch", "-w", help="Refresh five times a second until Ctrl-C.")] = False,
    as_json: Annotated[bool, typer.Option("--json", help="The status as JSON, for machines.")] = False,
    run_dir: RunDir = None,
) -> None:
    """What the line does now: state, tensions, drives, timing, history, last events.

    Exit code: 0 the loop runs, 2 more than one line and none chosen, 3 no gateway, 4 a gateway but no loop.

    Examples: `r2rgate status`, `r2rgate status --watch`, `r2rgate status --json | jq .loop.state`
    """
    if isinstance(sys.stdout, TextIOWrapper):
        sys.stdout.reconfigure(errors="replace")  # a terminal that has no line-drawing characters shows ? for them
    folder = choose_run_folder(run_dir)
    if watch:
        raise typer.Exit(_watch_json(folder) if as_json else _watch_screen(folder))
    try:
        text = asyncio.run(_ask(folder))
        found = parse_status(text)
    except (Unreachable, PathTooLong) as error:
        _fail(f"{folder}: {error}", EXIT_NO_GATEWAY)
    if as_json:
        print(text.decode())
    else:
        console = Console(highlight=False)
        console.print(render(found, console.width))
    raise typer.Exit(_exit_code(found))


def export_csv(
    out: Annotated[Path, typer.Argument(help="File to write, or - for standard output.")],
    last_s: Annotated[float, typer.Option("--last", min=0.0, help="Seconds before now.")] = 60.0,
    fields: Annotated[str, typer.Option(help="Fields, with commas.")] = "tension_n,tension_setpoint_n,torque_nm",
    history: Annotated[Path | None, typer.Option(help="History file; default: the running gateway's.")] = None,
    run_dir: RunDir = None,
) -> None:
    """The last seconds of history as CSV: Unix time, then a column per field, with its span or roller where it has one.

    Example: `r2rgate export tensions.csv --last 600 --fields tension_n,speed_m_per_s`
    """
    try:
        path = history or Path(asyncio.run(ask_status(choose_run_folder(run_dir))).historian.path)
        names = ["wall_s", *(name.strip() for name in fields.split(","))]
        with History(path) as file:
            now_s = time.time()
            columns = file.read_wall(now_s - last_s, now_s, names)
            damaged = file.damaged
    except (Unreachable, PathTooLong) as error:
        _fail(str(error), EXIT_NO_GATEWAY)
    except HistoryError as error:
        _fail(str(error), EXIT_USAGE)
    for text in damaged:
        print(f"left out: {text}", file=sys.stderr)
    with nullcontext(sys.stdout) if str(out) == "-" else out.open("w", newline="") as target:
        writer = csv.writer(target)
        writer.writerow(head for name in names for head in _heads(name, columns[name]))
        tables = (columns[name].reshape(len(columns[name]), -1 if columns[name].size else 0).tolist() for name in names)
        writer.writerows([value for part in row for value in part] for row in zip(*tables, strict=True))


def _heads(name: str, column: NDArray[Any]) -> list[str]:
    return [name] if column.ndim == 1 else [f"{name}_{k + 1}" for k in range(column.shape[1])]


def choose_run_folder(run_dir: Path | None) -> Path:
    """The folder that was named, or the only one in which something runs. Ends the program otherwise."""
    if run_dir is not None:
        return run_dir
    folders = running_lines()
    if len(folders) == 1:
        return folders[0]
    if folders:
        listed = "\n".join(f"  --run-dir {folder}" for folder in folders)
        _fail(f"{len(folders)} lines run here; say which:\n{listed}", EXIT_USAGE)
    _fail("no line runs here: start one with `r2rgate run LINE.toml`, or name its --run-dir", EXIT_NO_GATEWAY)


def parse_status(text: bytes) -> GatewayStatus:
    """Raises Unreachable for a gateway of another version."""
    try:
        return GatewayStatus.model_validate_json(json.dumps(clean_texts(json.loads(text))))
    except (UnicodeDecodeError, json.JSONDecodeError, RecursionError) as error:
        raise Unreachable("what answers for the gateway tells no status") from error
    except ValidationError as error:
        raise Unreachable(
            f"the gateway is of another version than this command: {error.error_count()} fields differ"
        ) from error


async def ask_status(folder: Path) -> GatewayStatus:
    """The status of the line whose sockets lie in `folder`. Raises Unreachable."""
    return parse_status(await _ask(folder))


async def _ask(folder: Path, mailbox: UnixMailbox | None = None) -> bytes:
    asking = mailbox or UnixMailbox()
    asking.connect((GATEWAY_STATUS,), folder / GATEWAY_SOCKET)
    try:
        return await asking.request(GATEWAY_STATUS, b"", TIMEOUT_S)
    finally:
        if mailbox is None:
            await asking.close()


async def _watch(folder: Path, show: Callable[[bytes, GatewayStatus], None], lost: Callable[[str], None]) -> int:
    """Ask and show until interrupted. Returns the exit code of the last answer."""
    stop = asyncio.Event()
    for number in (signal.SIGINT, signal.SIGTERM):
        asyncio.get_running_loop().add_signal_handler(number, stop.set)
    mailbox = UnixMailbox()
    code = EXIT_NO_GATEWAY
    try:
        while not stop.is_set():
            try:
                text = await _ask(folder, mailbox)
                found = parse_status(text)
                code = _exit_code(found)
                show(text, found)
            except Unreachable as error:
                code = EXIT_NO_GATEWAY
                lost(str(error))
            with suppress(TimeoutError):
                async with asyncio.timeout(REFRESH_S):
                    await stop.wait()
    finally:
        await mailbox.close()
    return code


def _watch_json(folder: Path) -> int:
    """One JSON document a line."""
    return asyncio.run(
        _watch(
            folder,
            lambda text, _: print(text.decode(), flush=True),
            lambda text: print(f"{folder}: {text}", file=sys.stderr),
        )
    )


def _watch_screen(folder: Path) -> int:
    """The alternate screen, overwritten in place, which does not flicker."""
    console = Console(highlight=False)
    with Live(console=console, screen=console.is_terminal, auto_refresh=False) as live:

        def show(_: bytes, found: GatewayStatus) -> None:
            live.update(render(found, console.width, console.height), refresh=True)

        def lost(text: str) -> None:
            live.update(Text(f"{folder}\n{text}\n\nThis screen waits for it. Ctrl-C ends.", "bold red"), refresh=True)

        return asyncio.run(_watch(folder, show, lost))


def _exit_code(found: GatewayStatus) -> int:
    return EXIT_RUNNING if found.loop.running else EXIT_NO_LOOP


def _fail(text: str, code: int) -> NoReturn:
    print(text, file=sys.stderr)
    raise typer.Exit(code)
