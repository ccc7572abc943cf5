"""What `r2rgate identify` is given: recordings from files or from the history, and what was measured by hand."""

import asyncio
import re
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from pathlib import Path

from gateway.cli.recordings import read_recording, recording_of_history
from gateway.cli.recordings_export import seconds_of
from gateway.cli.recordings_table import RecordingRefused
from gateway.cli.status_commands import ask_status, choose_run_folder
from gateway.core.line import Line, Parameter
from gateway.core.nearest import nearest
from gateway.core.recording import Recording
from gateway.core.status import GatewayStatus
from gateway.identification.parameters import EACH
from gateway.mailbox.paths import default_run_folder, running_lines
from gateway.supervisor.experiments import newest_experiments
from gateway.supervisor.history import HistoryError

MEASURABLE = ("stiffness_n", *EACH)
LAST = "60s"
LOOK_S, STORED_WITHIN_S = 0.25, 5.0
EXPERIMENTS_S = 604_800.0  #: back in the history, for one to identify on
_MEASURED = re.compile(r"\s*(\w+)\s*=\s*([^,\s]+)\s*,\s*([0-9.eE+-]+)\s*%\s*")


class DataRefused(Exception):
    """Every reason, a line each."""


@dataclass(frozen=True)
class Asked:
    """Where to look where no file is named."""

    last: str | None  #: None: the newest experiment, or LAST where there is none
    history: Path | None
    run_dir: Path | None


def recordings_of(
    line: Line, files: Sequence[Path], asked: Asked, tell: Callable[[str], None] = lambda text: None
) -> list[Recording]:
    """Of the files, else of the running line's history. Raises DataRefused, Unreachable, PathTooLong."""
    if not files:
        return [_from_history(line, asked, tell)]
    found: list[Recording] = []
    refused: list[str] = []
    for file in files:
        try:
            found.append(read_recording(file))
        except RecordingRefused as error:
            refused.append(str(error))
    digests = [one.digest() for one in found]
    refused += [
        f"{found[i].source} is the same data as {found[digests.index(digest)].source}: leave one away"
        for i, digest in enumerate(digests)
        if digests.index(digest) < i
    ]
    if refused:
        raise DataRefused("\n".join(refused))
    return found


def _from_history(line: Line, asked: Asked, tell: Callable[[str], None]) -> Recording:
    seconds = seconds_of(asked.last or LAST)
    path = asked.history
    if path is None:
        own = default_run_folder(line)
        folder = choose_run_folder(asked.run_dir or (own if own in running_lines() else None))
        status = asyncio.run(ask_status(folder))
        if (status.site, status.line) != (line.site, line.line):
            raise DataRefused(
                f"in {folder} runs {status.site}/{status.line}, the file describes {line.site}/{line.line}: name its "
                "--run-dir, or its file"
            )
        if asked.last is None:
            asyncio.run(_experiment_over(folder, status, tell))
        path = Path(status.historian.path)
    now_s = time.time()
    if asked.last is None and (newest := _newest_experiment(path, now_s)) is not None:
        return newest
    try:
        return recording_of_history(path, now_s - seconds, now_s)
    except RecordingRefused as error:
        raise DataRefused(
            f"{error}; the last {seconds:g} s were asked for: --last takes more, r2rgate export makes a file of a "
            "while that is worth keeping"
        ) from error


async def _experiment_over(folder: Path, status: GatewayStatus, tell: Callable[[str], None]) -> None:
    """Once one that runs has ended, and its data are stored. Raises Unreachable, PathTooLong."""

    def runs() -> bool:
        return status.change is not None and (status.change.kind, status.change.stage) == ("experiment", "running")

    if not runs():
        return
    while runs():
        tell("an experiment runs: its end is waited for (Ctrl-C, and --last 60s takes what there is)")
        await asyncio.sleep(LOOK_S)
        status = await ask_status(folder)
    ended_s, until_s = status.wall_s, status.wall_s + STORED_WITHIN_S
    while (age_s := status.historian.last_stored_age_s) is None or status.wall_s - age_s < ended_s:
        if status.wall_s > until_s:
            return  # what there is says what is missing
        await asyncio.sleep(LOOK_S)
        status = await ask_status(folder)


def _newest_experiment(path: Path, now_s: float) -> Recording | None:
    """As the gate reads it, so that it finds a model made of it to be made of it."""
    try:
        found = newest_experiments(path, now_s - EXPERIMENTS_S, now_s + 1.0, 1)
    except HistoryError:  # whoever reads the last seconds of it says why
        return None
    if not found:
        return None
    recording, ended_s = found[0]
    ended = datetime.fromtimestamp(ended_s, UTC).isoformat(timespec="seconds")
    return replace(recording, source=f"experiment until {ended}, {recording.samples} samples")


def measured_of(given: Sequence[str], line: Line) -> dict[str, tuple[float, float]]:
    """{name: (value, tolerance)} of such as "radius_m=0.035,0.5%". Raises DataRefused."""
    found: dict[str, tuple[float, float]] = {}
    wrong: list[str] = []
    for text in given:
        try:
            name, value, tolerance = _parsed(text)
            if name in found:
                raise DataRefused(f"{name} is given twice")
            _require_possible(name, value, _of_file(name, line))
            found[name] = (value, tolerance)
        except DataRefused as error:
            wrong.append(f"--measured {text}: {error}")
    if wrong:
        raise DataRefused("\n".join(wrong))
    return found


def _parsed(text: str) -> tuple[str, float, float]:
    parts = _MEASURED.fullmatch(text)
    if parts is None:
        raise DataRefused("should be NAME=VALUE,TOLERANCE% in SI units, such as radius_m=0.035,0.5%")
    name = parts[1]
    if name not in MEASURABLE:
        like = nearest(name, MEASURABLE)
        hint = f"; did you mean {like}?" if like else ""
        raise DataRefused(f"there is no such parameter; allowed: {', '.join(MEASURABLE)}{hint}")
    try:
        value, tolerance = float(parts[2]), 0.01 * float(parts[3])
    except ValueError:
        raise DataRefused("value and tolerance should be numbers") from None
    if not (0.0 < value < float("inf") and 1e-5 <= tolerance < 1.0):
        raise DataRefused("the value should be above 0, the tolerance 0.001 % or more and below 100 %")
    return name, value, tolerance


def _of_file(name: str, line: Line) -> list[Parameter]:
    if name == "stiffness_n":
        return [line.web.stiffness_n]
    return [getattr(part, name) for part in (line.spans if name == "length_m" else line.rollers)]


def _require_possible(name: str, value: float, of_file: list[Parameter]) -> None:
    """A value for all, within what the line's file allows: a wrong unit or parameter shows here."""
    if len({one.value for one in of_file}) > 1:
        raise DataRefused(
            f"the line's file has {min(one.value for one in of_file):g} to {max(one.value for one in of_file):g}, and "
            "one value would be for all: write each with its tolerance into the line's file"
        )
    first = max(of_file, key=lambda one: one.tolerance)
    low, high = first.value * (1.0 - first.tolerance), first.value * (1.0 + first.tolerance)
    if not low <= value <= high:
        raise DataRefused(
            f"the line's file has {first.value:g} ±{first.tolerance:.0%}, which is {low:.4g} to {high:.4g}: correct "
            "the unit, or the line's file"
        )
