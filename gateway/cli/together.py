"""`r2rgate run`: gateway, loop, agents and operator (where asked for, the simulated line) as children of one terminal.

A child that ends is started again, with growing pauses; the loop comes back SILENT, as after a reboot. What a start
cannot mend (a refused file, a line that runs already) ends all of it, with that child's exit code.
"""

import json
import signal
import sys
import time
from collections import deque
from collections.abc import Sequence
from contextlib import nullcontext
from pathlib import Path
from shlex import quote
from types import FrameType

from rich.console import Console, Group, RenderableType
from rich.live import Live
from rich.text import Text

from gateway.cli.status_view import render
from gateway.cli.tended import Child, Exit
from gateway.core.line import Line
from gateway.mailbox.paths import LOGS, SIM_DATA

PATIENCE_S = 3.0  #: beyond the time that a stop may take
REFRESH_S = 0.2
NOTES_S = 20.0  #: how long the screen shows what the loop said of its start
MOST_NOTES = 4  #: of the operator's process
EXIT_S = 60.0  #: how long it shows the last words of a child that has ended; then one line remains
#: How the operator's process says where it is reached, where not, and where it is again.
_REACHED, _SHUT, _TRIED, _OPEN = "operator of ", "no ", ", it is tried again", " now"
#: And how that there are no users, and that there are.
_NOBODY, _SOMEBODY = "nobody can come in yet", "somebody can come in now"
#: How the loop's ordinary words at its start begin; all others are for the person at the terminal.
_ORDINARY = ("loop of ", "pinned to ", "real-time priority ", "memory locked")


def run_together(
    file: Path,
    line: Line,
    controller: Path,
    plant: Path | None,
    run_folder: Path,
    data_folder: Path,
    opening: Sequence[str] = (),
) -> int:
    """Run until Ctrl-C or SIGTERM, which stop the line first. Returns the exit code: 0, or that of a refused child.

    Both folders exist; logs lie in `LOGS` of the data. The screen shows the sentences of `opening` at first.
    """
    logs = data_folder / LOGS
    logs.mkdir(exist_ok=True)
    folders = ["--run-dir", str(run_folder), "--data-dir", str(data_folder)]
    gateway, loop = [str(file), *folders], [str(file), "--controller", str(controller), *folders]
    children = [
        Child("gateway", lambda: gateway, logs / "gateway.log"),
        Child("loop", lambda: loop, logs / "loop.log"),
        Child("agents", lambda: gateway, logs / "agents.log", is_needed=False),
        Child("operator", lambda: gateway, logs / "operator.log", is_needed=False),
    ]
    if plant is not None:
        loop.append("--simulated")  # it is the line that is started here

        def sim() -> list[str]:
            return [str(plant), "--record", str(new_recording(data_folder / SIM_DATA)), "--priority", "40"]

        children.insert(0, Child("sim", sim, logs / "sim.log"))
    ending = _Ending()
    console = Console(highlight=False)
    notices = Notices(console, time.monotonic(), opening)
    final: Exit | None = None
    try:
        with Live(console=console, screen=True, auto_refresh=False) if console.is_terminal else nullcontext() as live:
            while not ending.asked and final is None:
                final = _tend(children, notices)
                if live is not None:
                    live.update(_screen(console, notices, run_folder, logs), refresh=True)
                time.sleep(REFRESH_S)
    finally:
        console.print("stopping the line, then ending")
        for child in sorted(reversed(children), key=lambda one: one.name != "loop"):  # others may hang: the line first
            child.end(line.longest_stop_s + PATIENCE_S)
    if final is None:
        return 0
    print("\n".join(final.lines()), file=sys.stderr)
    return final.code


def new_recording(of_sim: Path) -> Path:
    """A folder that does not exist yet: a recording is never written over."""
    stem = time.strftime("recording-%Y%m%dT%H%M%S")
    names = (stem, *(f"{stem}-{k}" for k in range(2, 1000)))
    return next(of_sim / name for name in names if not (of_sim / name).exists())


def _tend(children: Sequence[Child], notices: "Notices") -> Exit | None:
    """Look after every child. Returns the exit that ends all."""
    final: Exit | None = None
    for child in children:
        now_s = time.monotonic()
        ended = child.tend(now_s)
        if ended is None:
            if child.name == "loop" and not child.ended:
                notices.hear(child.said(), now_s)
            elif child.name == "sim":
                notices.hear_of_sim(child.said())
            elif child.name == "operator":
                notices.hear_of_operator(child.said(), now_s)
        elif ended.is_final:
            final = final or ended
        else:
            notices.tell(ended)
        if child.name == "sim" and not child.ended and not child.said():
            break  # its wires are not open yet: a loop would only report that nobody answers
    return final


class Notices:
    """What a person must see beside the status: why a child has ended, and what help the loop was not granted.

    Without a terminal each is printed once, as it comes.
    """

    def __init__(self, console: Console, start_s: float, opening: Sequence[str] = ()) -> None:
        self._console = console
        self._opening = list(opening)  #: has been printed already
        self._start_s = start_s
        self._notes: list[str] = []
        self._exits: dict[str, Exit] = {}
        self._faults = ""
        self._ways: dict[str, str] = {}  #: page and OPC UA with their addresses; with "no " what is not served
        self._of_operator: list[str] = []  #: all that it has said
        self._nobody: list[str] = []  #: that nobody can come in, as long as it is so
        self._operator_notes: deque[tuple[float, str]] = deque(maxlen=MOST_NOTES)  #: with when each was heard

    def hear_of_sim(self, said: list[str]) -> None:
        """What the simulated line has said since its start: where faults can be asked of it."""
        control = _control(said)
        if control is None:
            return
        text = f'let something go wrong: r2rgate fault inject --control {quote(control)} "load-cell 3 nan for 0.2"'
        if text != self._faults:
            self._faults = text
            self._print([text])

    def hear(self, said: list[str], now_s: float) -> None:
        """What the loop has said since its start, all of it every time."""
        if now_s - self._start_s > NOTES_S:
            return
        notes = [text for text in said if not text.startswith(_ORDINARY)]
        self._print([f"loop: {text}" for text in notes[len(self._notes) :]])
        self._notes = notes

    def hear_of_operator(self, said: list[str], now_s: float) -> None:
        """What the operator's process has said since its start: where people reach the line, and what is missing."""
        before, self._of_operator = self._of_operator, said
        for text in said[len(before) :] if said[: len(before)] == before else said:
            if text.startswith(_REACHED):
                self._ways |= dict.fromkeys(text.partition(": ")[2].split(", "), "")
            elif text.startswith((_NOBODY, _SOMEBODY)):
                self._nobody = [f"operator: {text}"] if text.startswith(_NOBODY) else []
            elif text.endswith(_OPEN):
                self._ways[text.removesuffix(_OPEN)] = ""
            else:
                if text.startswith(_SHUT) and _TRIED in text:
                    self._ways[text.removeprefix(_SHUT).partition(_TRIED)[0]] = _SHUT
                self._operator_notes.append((now_s, f"operator: {text}"))
            self._print([f"operator: {text}"])

    def tell(self, ended: Exit) -> None:
        if ended.name == "operator":
            self._ways, self._of_operator, self._nobody = {}, [], []
        self._exits[ended.name] = ended
        self._print(ended.lines())

    def lines(self, now_s: float) -> list[str]:
        """What stands above the status now."""
        notes = [*self._opening, *(f"loop: {text}" for text in self._notes), *([self._faults] if self._faults else [])]
        shown = [", ".join(f"{shut}{way}" for way, shut in self._ways.items())] if self._ways else []
        shown += self._nobody
        shown += notes if now_s - self._start_s <= NOTES_S else []
        shown += [text for at_s, text in self._operator_notes if now_s - at_s <= NOTES_S]
        for ended in self._exits.values():
            ago_s = now_s - ended.at_s
            shown += (
                ended.lines() if ago_s <= EXIT_S else [f"{ended.headline()} ({ago_s / 60:.0f} min ago; {ended.log})"]
            )
        return shown

    def _print(self, lines: list[str]) -> None:
        if not self._console.is_terminal:
            for text in lines:
                print(text, file=sys.stderr, flush=True)


def _control(said: list[str]) -> str | None:
    """The folder or socket that the ready line of the simulated line names; None without one."""
    for text in said:
        if text.startswith('{"ready"'):
            socket = json.loads(text).get("control")
            return socket and str(Path(socket).parent)
    return None


def _screen(console: Console, notices: Notices, run_folder: Path, logs: Path) -> RenderableType:
    import asyncio

    from gateway.cli.status_commands import ask_status
    from gateway.mailbox.port import Unreachable

    told = [Text(text, "yellow", no_wrap=True, overflow="ellipsis") for text in notices.lines(time.monotonic())]
    height = console.height - len(told) - bool(told)
    try:
        status = render(asyncio.run(ask_status(run_folder)), console.width, height)
    except Unreachable as error:
        status = Text(f"{error}\nlogs: {logs}")
    return Group(*told, Text(), status) if told else status


class _Ending:
    """Ctrl-C, SIGTERM and a terminal that is closed ask for the end; nothing is interrupted half-way."""

    def __init__(self) -> None:
        self.asked = False
        for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
            signal.signal(number, self._ask)

    def _ask(self, number: int, frame: FrameType | None) -> None:
        self.asked = True
