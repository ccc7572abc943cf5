"""What controls a line, as its gateway's records have it, and how the line stands, for commands that run beside."""

import asyncio
from collections.abc import Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path

from gateway.cli.data_place import gateway_folder, own_folder
from gateway.cli.line_records import read_records
from gateway.cli.process_commands import default_data_folder
from gateway.cli.status_commands import ask_status
from gateway.core.controller import Controller, parse_controller
from gateway.core.deployment import Region
from gateway.core.judge_context import JudgeContext, LineState
from gateway.core.line import Line
from gateway.core.line_model import LineModel
from gateway.files import MOST_BYTES, read_bytes
from gateway.mailbox.listener import PathTooLong
from gateway.mailbox.paths import CONTROLLER, LOOP_DATA, default_run_folder
from gateway.mailbox.port import Unreachable
from gateway.supervisor import audit_file
from gateway.supervisor.configurations import FILE_NAME, STABLE, Configurations, open_configurations
from gateway.supervisor.lifecycle import Book


@dataclass(frozen=True)
class ControllerHeld:
    """Of a line: the controller, for what it was judged, and what small steps are held against."""

    controller: Controller
    region: Region
    baseline: Controller | None
    baseline_region: Region
    said: str  #: what to call it


@dataclass(frozen=True)
class Stands:
    """Where set-points (n,) and speed stand."""

    tension_n: Sequence[float]
    speed_m_per_s: float
    said: str


def in_service(line: Line, data_dir: Path | None) -> ControllerHeld | None:
    """As the audit has it; where that has nothing, what the loop keeps. None: neither has anything.

    Raises ConfigurationsError where the store lacks what the audit names, ControllerRefused and OSError for a file.
    """
    folder = gateway_folder(line, data_dir)
    book = read_records(folder).book if (folder / audit_file.FILE_NAME).exists() else Book()
    if book.in_service is not None and (folder / FILE_NAME).exists():
        with open_configurations(folder / FILE_NAME) as store:
            found = store.find(book.in_service, line.site, line.line)
            if found.controller is not None:
                said = f"{found.controller.kind} {book.in_service[:12]}, in service"
                return ControllerHeld(found.controller, book.judged_for, *_baseline(store, line, book), said)
    kept = own_folder(data_dir or default_data_folder(line), LOOP_DATA) / CONTROLLER
    try:
        controller = parse_controller(read_bytes(kept, MOST_BYTES))
    except FileNotFoundError:
        return None
    return ControllerHeld(controller, Region(), None, Region(), f"the {controller.kind} controller in {kept}")


def stands(line: Line, run_dir: Path | None) -> Stands | None:
    """Of the line that runs; None: it does not, or another one does there, or its set-points are not known."""
    try:
        status = asyncio.run(ask_status(run_dir or default_run_folder(line)))
    except (Unreachable, PathTooLong, OSError):
        return None
    tension, speed = [one.setpoint_n for one in status.spans if one.setpoint_n], status.speed_setpoint_m_per_s
    if (status.site, status.line) != (line.site, line.line) or speed is None or len(tension) != line.n:
        return None
    return Stands(tension, speed, "as the line stands now")


def context_of(line: Line, model: LineModel | None, held: ControllerHeld | None, at: Stands | None) -> JudgeContext:
    """In which the gate would judge a design. Raises DesignRefused where nothing is in service, and no lqi can be."""
    from gateway.control.design import design_lqi, task_of

    tension_n = line.recipes[0].tension_n if at is None else at.tension_n
    fastest = line.gate.first_speed_max_m_per_s if model is None else model.region.speed_to_m_per_s
    return JudgeContext(
        format=1,
        now=datetime.now(UTC).isoformat(timespec="milliseconds"),
        # How fast data have gone is not at hand here: the model says it.
        state=LineState(state="RUN", tension_n=list(tension_n), speed_m_per_s=fastest),
        in_service=design_lqi(task_of(line)) if held is None else held.controller,
        region=Region() if held is None else held.region,
        baseline=None if held is None else held.baseline,
        baseline_region=Region() if held is None else held.baseline_region,
        model=model,
    )  # fmt: skip


def _baseline(store: Configurations, line: Line, book: Book) -> tuple[Controller | None, Region]:
    """As the gateway takes it: what was archived on the line as it is, else the first that was kept for as much."""
    archived = [(id_, one) for id_, one in store.archives(line.site, line.line) if one.name == STABLE]
    if archived and (book.line_changed_s is None or archived[-1][1].time_s > book.line_changed_s):
        return store.find(archived[-1][0], line.site, line.line).controller, Region()
    first = book.first_as_far
    if first is None or first[0] == book.in_service:
        return None, Region()
    return store.find(first[0], line.site, line.line).controller, first[1]
