"""`identify`: phase 0 of a line, from its data to a model with intervals, with everything that led to it."""

import time
from dataclasses import replace
from os import W_OK, access
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, NoReturn

import typer
from rich.console import Console

from gateway.cli.data_place import gateway_folder
from gateway.cli.process_commands import REFUSED, DataFolder, LineFile, read_line
from gateway.core.line_problem import printable

if TYPE_CHECKING:
    from gateway.cli.identify_outcome import Data
    from gateway.cli.identify_result import IdentifyResult, Kept
    from gateway.core.line import Line
    from gateway.core.line_model import LineModel
    from gateway.identification.identify import Identified

UNREACHABLE, DOES_NOT_HOLD = 3, 4  #: exit codes


def identify(
    file: LineFile,
    data: Annotated[
        list[Path] | None, typer.Argument(help="Recordings, .csv or .mcap. Without: the running line's history.")
    ] = None,
    last: Annotated[
        str | None,
        typer.Option(
            "--last",
            help="Of the history: 60, 60s, 10min or 2h before now. Without: the newest experiment, or 60s if none.",
        ),
    ] = None,
    measured: Annotated[
        list[str] | None,
        typer.Option(help="Known by tape or scale, such as radius_m=0.035,0.5%; repeatable, SI units."),
    ] = None,
    align: Annotated[
        bool, typer.Option("--align", help="Take time offsets between channels out of the data first.")
    ] = False,
    prior: Annotated[
        str,
        typer.Option(help="What is known before: line (FILE), in-service (the model accepted last), or a model."),
    ] = "line",
    out: Annotated[Path, typer.Option(help="The model file to write.")] = Path("out/model.json"),
    report: Annotated[Path, typer.Option(help="The page to write.")] = Path("out/identify.html"),
    store: Annotated[
        bool | None,
        typer.Option("--store/--no-store", help="In the line's models; without: where its data folder exists."),
    ] = None,
    history: Annotated[Path | None, typer.Option(help="History file; default: the running gateway's.")] = None,
    run_dir: Annotated[
        Path | None, typer.Option("--run-dir", help="Folder of the running line's sockets; default: FILE's.")
    ] = None,
    data_dir: DataFolder = None,
    as_json: Annotated[bool, typer.Option("--json", help="Print the result as JSON.")] = False,
) -> None:
    """Identify a line: assess data, estimate by three methods, choose the structure, validate, write the model.

    Three tenths of the data, the end of every stretch, judge what was estimated from the rest; the model is then made
    from all. Bad data are refused with every reason, what would mend it and which experiment would provide it; then
    nothing is written. A model that does not hold on held-out data is written too, and stored as rejected.

    The prior is FILE: what it says no earlier estimate can have got wrong. With --prior an earlier model, widened by
    5 % for drift, takes its place unless the data disagree with it; it helps where data are few or weak.

    Exit code: 0 identified, 2 refused, 3 no gateway, 4 the model does not hold, 130 interrupted.

    Example: r2rgate identify line.toml run.csv --measured radius_m=0.035,0.5%

    Example, on the last ten minutes of the running line: r2rgate identify line.toml --last 10min
    """
    from gateway.cli.identify_data import Asked, DataRefused, measured_of, recordings_of
    from gateway.cli.identify_outcome import Data
    from gateway.cli.waiting import interruptible, progress
    from gateway.mailbox.listener import PathTooLong
    from gateway.mailbox.port import Unreachable

    line, files = read_line(file), data or []
    if files and (last or history or run_dir):
        _refuse("--last, --history and --run-dir are of the running line's history: name these, or files")
    _may_write(out, "--out", [file, *files])
    _may_write(report, "--report", [file, *files])
    if out.resolve() == report.resolve():
        _refuse(f"--out and --report are both {out}; name two files")
    try:
        known = measured_of(measured or [], line)
        with interruptible("nothing was written"), progress() as show:
            recordings = recordings_of(line, files, Asked(last, history, run_dir), show)
    except DataRefused as refused:
        _refuse(str(refused))
    except (Unreachable, PathTooLong) as error:
        _refuse(str(error), UNREACHABLE)
    folder = gateway_folder(line, data_dir)
    storing = (data_dir is not None or folder.is_dir()) if store is None else store
    parent = _parent(prior, line, file, folder, data_dir)
    _identify(Data(line, recordings, known), parent, align, out, report, folder if storing else None, as_json)


def _parent(prior: str, line: "Line", file: Path, folder: Path, data_dir: Path | None) -> "LineModel | None":
    """The model that shall be the prior; None: the line's file."""
    from gateway.cli.model_place import chosen, chosen_of
    from gateway.identification.inheritance import NotInherited, earlier_of
    from gateway.supervisor.model_store import ModelsError
    from gateway.supervisor.models import FILE_NAME, open_repository

    if prior == "line":
        return None
    try:
        if prior == "in-service":
            with open_repository(folder / FILE_NAME) as models:
                accepted = [one for one in models.entries(line.site, line.line) if one.state == "accepted"]
            if not accepted:
                _refuse(f"--prior in-service: no model of {line.site}/{line.line} was accepted; allowed: line, a model")
            last = max(accepted, key=lambda one: one.marks[-1].time_s)
            model = chosen_of(last, folder / FILE_NAME).model
        else:
            model = chosen(prior, file, data_dir).model
        earlier_of(model, line)
    except (ModelsError, NotInherited) as error:
        _refuse(f"--prior {prior}: {error}")
    return model


def _identify(
    data: "Data",
    parent: "LineModel | None",
    align: bool,
    out: Path,
    report: Path,
    folder: Path | None,
    as_json: bool,
) -> None:
    """The work, and what is kept of it; `folder`: the line's, None where nothing is to be stored."""
    from gateway.cli.audit_against import head_in
    from gateway.cli.identify_align import all_delays, without_offsets
    from gateway.cli.identify_model import model_of_found
    from gateway.cli.identify_outcome import result_of
    from gateway.cli.identify_report import page_of
    from gateway.cli.identify_table import print_result
    from gateway.cli.report.page_render import render_page
    from gateway.cli.waiting import interruptible, progress
    from gateway.core.line_model import ModelRefused, canonical
    from gateway.core.theta import Noise
    from gateway.identification.identify import NotIdentified
    from gateway.identification.identify import identify as identified
    from gateway.identification.inheritance import identify_after

    began_s = time.monotonic()
    with interruptible("nothing was written"), progress() as show:
        if align:
            show("taking time offsets out")
            moved = [without_offsets(one, data.line) for one in data.recordings]
            recordings, delays = [one.recording for one in moved], [one.delays for one in moved]
            data = replace(data, recordings=recordings, delays=delays)
        try:
            given = (data.recordings, data.line, Noise(), time.perf_counter)
            inherited = None
            if parent is not None:
                inherited = identify_after(parent, *given, measured=data.measured, tell=show)
                found = inherited.found
            else:
                found = identified(*given, measured=data.measured, tell=show)
        except NotIdentified as refused:
            _end_refused(result_of(data, refused.assessments, refused.reasons, None), as_json)
        except ValueError as error:  # a held-out part without a free run's length, or data that no method can use
            more = f"{error}; more data under control may help: 5 s or more in a row at each of two speeds"
            _end_refused(result_of(data, [], [more], None), as_json)
        result = result_of(data, found.assessments, [], found, inherited)
        prior = None if inherited is None else inherited.parent
        try:
            model = model_of_found(data.line, data.recordings, found, result.date, all_delays(data.delays), prior)
        except ModelRefused as refused:
            _end_refused(result_of(data, found.assessments, refused.reasons, None), as_json)
        show("the report")
        head = "" if folder is None else head_in(folder)
        page = render_page(replace(page_of(result, data, found), audit_head=head))
    _write(out, canonical(model) + b"\n")
    _write(report, page.encode())
    kept, problem = _kept(model, found, out, report, folder)
    result = result.model_copy(update={"kept": kept})
    if as_json:
        typer.echo(result.model_dump_json(indent=2))
    elif result.found is not None:
        console = Console(highlight=False)
        print_result(result, result.found, console)
        _tell_kept(kept, problem, found.validation.valid, time.monotonic() - began_s)
    if problem:
        _refuse(f"the model is written, but not stored: {problem}")
    if not found.validation.valid:
        raise typer.Exit(DOES_NOT_HOLD)


def _kept(model: "LineModel", found: "Identified", out: Path, report: Path, folder: Path | None) -> tuple["Kept", str]:
    """Where the model is, and why it is not in the repository where it should be."""
    from gateway.cli.identify_model import store
    from gateway.cli.identify_result import Kept
    from gateway.core.line_model import model_hash
    from gateway.supervisor.model_store import ModelsError
    from gateway.supervisor.models import FILE_NAME

    version, repository, problem = None, None, ""
    if folder is not None:
        try:
            version = store(model, found.validation, folder / FILE_NAME).version
            repository = str(folder / FILE_NAME)
        except ModelsError as error:
            problem = str(error)
    kept = Kept(id=model_hash(model), out=str(out), report=str(report), version=version, repository=repository)
    return kept, problem


def _tell_kept(kept: "Kept", problem: str, valid: bool, took_s: float) -> None:
    typer.echo(f"\nmodel: {kept.out}, id {kept.id[:12]}, {took_s:.0f} s\nreport: {kept.report}")
    if kept.version is not None:
        state = "" if valid else ", marked as rejected"
        typer.echo(f"stored as version {kept.version}{state}: {kept.repository}")
    elif not problem:
        typer.echo(f"not stored in the line's models: --store does, and r2rgate models import {kept.out}")
    if valid:
        typer.echo(f"r2rgate propose {kept.out} --reason TEXT: the gate judges by it once it is accepted and approved")
        typer.echo(f"r2rgate design FILE --model {kept.out} designs on it")


def _end_refused(result: "IdentifyResult", as_json: bool) -> NoReturn:
    """Nothing has been written."""
    from gateway.cli.identify_table import print_refusal

    if as_json:
        typer.echo(result.model_dump_json(indent=2))
    print_refusal(result, Console(stderr=True, highlight=False))
    typer.echo("nothing was written", err=True)
    raise typer.Exit(REFUSED)


def _may_write(path: Path, option: str, inputs: list[Path]) -> None:
    """Known before the work, not after it, and without making any folder yet."""
    if path.resolve() in [given.resolve() for given in inputs]:
        _refuse(f"{option} {path} would overwrite a file that is read; name another")
    there = next((one for one in (path, *path.absolute().parents) if one.exists()), path)
    if path.is_dir():
        why = "it is a folder"
    elif there != path and not there.is_dir():
        why = f"{there} is no folder"
    else:
        why = "" if access(there, W_OK) else "Permission denied"
    if why:
        _refuse(f"{option} {path} cannot be written: {why}; name a file in a folder that you may write")


def _write(path: Path, content: bytes) -> None:
    """All of it or nothing."""
    part = path.with_name(path.name + ".part")
    path.parent.mkdir(parents=True, exist_ok=True)
    part.write_bytes(content)
    part.replace(path)


def _refuse(message: str, code: int = REFUSED) -> NoReturn:
    for text in message.splitlines():
        typer.echo(printable(text), err=True)
    raise typer.Exit(code)
