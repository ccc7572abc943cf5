"""`r2rgate export`: the last while of a line's history as a file: for identification, spreadsheets, Foxglove."""

import asyncio
import re
import sys
import time
from pathlib import Path
from typing import Annotated, Literal, NoReturn

import typer

from gateway.cli.process_commands import REFUSED
from gateway.cli.recordings import recording_of_history
from gateway.cli.recordings_csv import write_csv
from gateway.cli.recordings_mcap import write_mcap
from gateway.cli.recordings_table import RecordingRefused
from gateway.cli.status_commands import EXIT_NO_GATEWAY, RunDir, ask_status, choose_run_folder, export_csv
from gateway.core.recording import Recording
from gateway.mailbox.listener import PathTooLong
from gateway.mailbox.port import Unreachable

_UNITS_S = {"": 1.0, "s": 1.0, "min": 60.0, "h": 3600.0}
Format = Literal["csv", "mcap"]


def export(
    place: Annotated[Path | None, typer.Argument(metavar="[FILE]", help="As --out.")] = None,
    out: Annotated[Path | None, typer.Option("--out", help="File to write, or - for standard output.")] = None,
    kind: Annotated[Format | None, typer.Option("--format", help="Default: by the end of FILE's name, or csv.")] = None,
    last: Annotated[str, typer.Option("--last", help="Time before now: 60, 60s, 10min or 2h.")] = "60s",
    fields: Annotated[
        str | None, typer.Option(help="A plain table of these fields of the history instead, with commas (CSV).")
    ] = None,
    history: Annotated[Path | None, typer.Option(help="History file; default: the running gateway's.")] = None,
    run_dir: RunDir = None,
) -> None:
    """The last while of history as a recording: every channel that identification needs, in SI units.

    Examples: `r2rgate export --last 10min --out run.mcap`, `r2rgate export run.csv`,
    `r2rgate export tensions.csv --last 600 --fields tension_n,speed_m_per_s`
    """
    target = out or place
    if target is None:
        _refuse("no file is named: --out FILE, or --out - for standard output", REFUSED)
    seconds = seconds_of(last)
    if fields is not None:
        if kind == "mcap":
            _refuse("a table of --fields is written as csv only", REFUSED)
        export_csv(target, seconds, fields, history, run_dir)
        return
    kind = kind or ("mcap" if target.suffix.lower() == ".mcap" else "csv")
    try:
        path = history or Path(asyncio.run(ask_status(choose_run_folder(run_dir))).historian.path)
        now_s = time.time()
        recording = recording_of_history(path, now_s - seconds, now_s)
        _write(recording, target, kind)
    except (Unreachable, PathTooLong) as error:
        _refuse(str(error), EXIT_NO_GATEWAY)
    except RecordingRefused as refused:
        _refuse(str(refused), REFUSED)
    print(f"{recording.samples} samples of {recording.n} spans: {target}", file=sys.stderr)


def seconds_of(text: str) -> float:
    """Of a time such as 60, 60s, 10min or 2h. Ends the program for another."""
    found = re.fullmatch(r"(\d+(?:\.\d+)?)\s*(s|min|h|)", text.strip())
    if found is None or float(found[1]) == 0.0:
        _refuse(f"--last is {text!r}, should be a time above 0 such as 60s, 10min or 2h", REFUSED)
    return float(found[1]) * _UNITS_S[found[2]]


def _write(recording: Recording, target: Path, kind: Format) -> None:
    if str(target) == "-":
        if kind == "mcap":
            write_mcap(recording, sys.stdout.buffer)
        else:
            write_csv(recording, sys.stdout)
    elif kind == "mcap":
        with target.open("wb") as binary:
            write_mcap(recording, binary)
    else:
        with target.open("w", newline="", encoding="utf-8") as text:
            write_csv(recording, text)


def _refuse(text: str, code: int) -> NoReturn:
    print(text, file=sys.stderr)
    raise typer.Exit(code)
