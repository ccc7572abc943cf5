"""`r2rgate run`: gateway and loop (and, where asked for, the simulated line) as children of one terminal.

A child that ends is started again, with growing pauses; the loop comes back SILENT, as after a reboot.
"""

import signal
import subprocess
import sys
import time
from dataclasses import dataclass
from pathlib import Path
from types import FrameType

from rich.console import Console
from rich.live import Live
from rich.text import Text

from gateway.cli.lifetime import end, start
from gateway.cli.status_view import render
from gateway.core.controller import canonical
from gateway.core.line import Line

PATIENCE_S = 3.0  #: beyond the time that a stop may take
FIRST_PAUSE_S, LONGEST_PAUSE_S = 0.5, 10.0
REFRESH_S = 0.2


@dataclass
class Child:
    """One process and when it may be started (again)."""

    name: str
    arguments: list[str]
    process: subprocess.Popen[str] | None = None
    pause_s: float = FIRST_PAUSE_S
    due_s: float = 0.0


def run_together(
    file: Path, line: Line, controller: Path | None, plant: Path | None, run_folder: Path, data_folder: Path
) -> int:
    """Run until Ctrl-C or SIGTERM, which stop the line first. Returns the exit code."""
    data_folder.mkdir(parents=True, exist_ok=True)
    run_folder.mkdir(parents=True, exist_ok=True, mode=0o700)
    folders = ["--run-dir", str(run_folder), "--data-dir", str(data_folder)]
    controller = controller or _controller(line, data_folder)
    children = [
        Child("gateway", [str(file), *folders]),
        Child("loop", [str(file), "--controller", str(controller), *folders]),
    ]
    if plant is not None:
        recording = data_folder / time.strftime("recording-%Y%m%dT%H%M%S")
        children.insert(0, Child("sim", [str(plant), "--record", str(recording), "--priority", "40"]))
    ending = _Ending()
    console = Console(highlight=False)
    try:
        with Live(console=console, screen=console.is_terminal, auto_refresh=False) as live:
            while not ending.asked:
                for child in children:
                    _look_after(child, data_folder)
                live.update(_screen(console, run_folder, data_folder), refresh=console.is_terminal)
                time.sleep(REFRESH_S)
    finally:
        console.print("stopping the line, then ending")
        for child in reversed(children):
            if child.process is not None:
                end(child.process, line.longest_stop_s + PATIENCE_S)
    return 0


def _controller(line: Line, data_folder: Path) -> Path:
    """The configuration that is kept for this line; the first time, one is designed on its nominal model."""
    from gateway.control.design import design_lqi, task_of

    path = data_folder / "controller.json"
    if not path.exists():
        path.write_bytes(canonical(design_lqi(task_of(line))) + b"\n")
        print(f"{path}: designed an LQI on the line's nominal model", file=sys.stderr)
    return path


def _look_after(child: Child, data_folder: Path) -> None:
    now_s = time.monotonic()
    if child.process is not None and child.process.poll() is None:
        if now_s - child.due_s > LONGEST_PAUSE_S:
            child.pause_s = FIRST_PAUSE_S
        return
    if child.process is not None:  # it has ended
        child.process = None
        child.due_s = now_s + child.pause_s
        child.pause_s = min(2.0 * child.pause_s, LONGEST_PAUSE_S)
    if now_s >= child.due_s:
        child.due_s = now_s
        child.process = start([child.name, *child.arguments], data_folder / f"{child.name}.log")


def _screen(console: Console, run_folder: Path, data_folder: Path):  # noqa: ANN202
    import asyncio

    from gateway.cli.status_commands import ask_status
    from gateway.mailbox.port import Unreachable

    try:
        return render(asyncio.run(ask_status(run_folder)), console.width, console.height)
    except Unreachable as error:
        return Text(f"{error}\nlogs: {data_folder}")


class _Ending:
    """Ctrl-C and SIGTERM ask for the end; nothing is interrupted half-way."""

    def __init__(self) -> None:
        self.asked = False
        for number in (signal.SIGINT, signal.SIGTERM):
            signal.signal(number, self._ask)

    def _ask(self, number: int, frame: FrameType | None) -> None:
        self.asked = True
