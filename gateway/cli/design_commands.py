"""`design`: phase 1 of a line, from its file to a configuration, with everything that led to it."""

import json
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager, nullcontext
from dataclasses import replace
from enum import StrEnum
from os import W_OK, access
from pathlib import Path
from shlex import quote
from typing import TYPE_CHECKING, Annotated, NoReturn

import typer

from gateway.cli.operate_commands import RunFolder
from gateway.cli.process_commands import REFUSED, DataFolder, LineFile, read_line
from gateway.core.line import Line
from gateway.core.line_model import LineModel

if TYPE_CHECKING:
    from gateway.cli.asked_agents import AskedAgents
    from gateway.commissioning.beforehand import Beforehand


class LawName(StrEnum):
    """Architectures that a controller can have."""

    PID = "pid"
    LQR = "lqr"
    LQI = "lqi"
    LQG = "lqg"
    MPC = "mpc"


def design(
    file: LineFile,
    law: Annotated[
        list[LawName] | None, typer.Option(help="Only this architecture; repeatable. Without: all five.")
    ] = None,
    out: Annotated[Path, typer.Option(help="The configuration to write.")] = Path("controller.json"),
    scenario: Annotated[
        list[str] | None,
        typer.Option(help="tension, velocity, or a TOML file; repeatable. Without: the largest steps."),
    ] = None,
    iterations: Annotated[int, typer.Option(min=0, max=50, help="Attempts after the first guess.")] = 50,
    untuned: Annotated[
        bool, typer.Option("--untuned", help="The first guess of one --law as it is, without any simulation.")
    ] = False,
    schedule: Annotated[
        str, typer.Option(help="Speeds in m/s, such as 0.1,2,5: gains that follow the unwinder. Not for mpc.")
    ] = "",
    seed: Annotated[int, typer.Option(min=0, help="Of the noise, and of the lines within the tolerances.")] = 0,
    model: Annotated[
        str | None,
        typer.Option(help="An identified model in place of FILE's values: a file, a version, an id, or newest."),
    ] = None,
    data_dir: DataFolder = None,
    agents: Annotated[
        bool, typer.Option("--agents", help="Ask the agents of the line that runs; the rules where none answers.")
    ] = False,
    run_dir: RunFolder = None,
    as_json: Annotated[bool, typer.Option("--json", help="Print the result as JSON.")] = False,
) -> None:
    """Design a controller: tune each architecture on the line's model, compare, choose, and say why.

    Candidates run on the nominal model and on lines within its tolerances. One that would stand less than 4 ms more
    delay, or leave the tension limits, is not offered. Weights of the score: \\[priorities] of the line's file. Beside
    OUT lie OUT's .design.json (every attempt with its reason) and .design.html (the report). About three minutes.
    The best of each is judged as the gate would, against what is in service where the line has run; what it refuses is
    made calmer, and what it still refuses is not chosen.
    With --model (r2rgate models) the identified model and its intervals stand in place of FILE's values and tolerances.
    With --agents they are asked what there is to choose (docs/agents.md); what they say stands in the report.

    Exit code: 0 written, 2 refused, 130 interrupted.

    Example: r2rgate design line.toml --out controller.json

    Example, in a second: r2rgate design line.toml --law lqi --untuned

    Example, on what was identified last: r2rgate design line.toml --model newest
    """
    from gateway.cli.data_place import gateway_folder
    from gateway.control.design import DesignRefused

    line = read_line(file)
    speeds = _speeds(schedule)
    if speeds and law and LawName.MPC in law:
        _refuse("--schedule: mpc has no schedule, its programme belongs to one model; allowed: pid, lqr, lqi, lqg")
    if untuned and scenario:
        _refuse("--untuned simulates nothing: leave --scenario away")
    if untuned and agents:
        _refuse("--untuned leaves nothing to choose: leave --agents away")
    names = list(dict.fromkeys(one.value for one in law or LawName if law or not speeds or one is not LawName.MPC))
    _may_write(out, [file, *map(Path, scenario or []), *([Path(model)] if model else [])], only=untuned)
    identified = _identified(line, file, model, data_dir) if model else None
    try:
        if untuned:
            _first_guess(line, identified, names, speeds, out, as_json)
        else:
            with _asked(line, run_dir) if agents else nullcontext() as asked:
                gate, judged = _gate(line, identified, data_dir, run_dir, seed)
                _phase(
                    line, identified, names, scenario or [], speeds, iterations, seed, out, as_json, asked, gate,
                    judged, gateway_folder(line, data_dir),
                )  # fmt: skip
    except DesignRefused as refused:
        _refuse(f"no controller for {file}: {refused}")


@contextmanager
def _asked(line: Line, run_dir: Path | None) -> Iterator["AskedAgents | None"]:
    """The agents of the line where it runs; None, said once, where they cannot be asked."""
    from gateway.cli.agents_beside import CannotBeAsked, agents_beside

    with ExitStack() as held:
        try:
            asked = held.enter_context(agents_beside(line, run_dir))
        except CannotBeAsked as error:
            typer.echo(f"the agents cannot be asked, the rules decide: {error}", err=True)
            asked = None
        yield asked


def _identified(line: Line, file: Path, wanted: str, data_dir: Path | None) -> LineModel:
    """The model that is wanted; the command ends where it is none of this line."""
    from gateway.cli.model_place import chosen, reasons_against_line
    from gateway.supervisor.model_store import ModelsError

    try:
        choice = chosen(wanted, file, data_dir)
    except ModelsError as error:
        _refuse(f"--model: {error}")
    found = choice.model
    reasons = reasons_against_line(found, line)
    if choice.entry is not None and choice.entry.state == "rejected":
        reasons.append(
            f"{choice.name} was rejected: {choice.entry.marks[-1].reason}; allowed: another version (r2rgate models), "
            "or the file of this one, on your own word"
        )
    if abs(found.data.period_s - line.control.period_s) > 1e-9:
        reasons.append(
            f"its data have a period of {found.data.period_s:g} s, the line {line.control.period_s:g} s: its latency "
            "is that of another loop; identify at this period"
        )
    if reasons:
        _refuse("\n".join(f"--model {wanted} is not used: {reason}" for reason in reasons))
    return found


def _first_guess(
    line: Line, model: LineModel | None, names: list[str], speeds: list[float], out: Path, as_json: bool
) -> None:
    from gateway.commissioning.architectures import ARCHITECTURES
    from gateway.control.design import DesignRefused, margins, require_margin, task_of, task_on, weak_spots
    from gateway.core.controller import canonical, config_hash
    from gateway.core.line_model import noise_of, theta_of

    if len(names) != 1:
        _refuse("--untuned compares nothing: name one architecture with --law")
    architecture = ARCHITECTURES[names[0]]
    task = task_of(line) if model is None else task_on(line, theta_of(model), noise_of(model))
    config = architecture.design(task, architecture.first(task), speeds)
    found = margins(config, task)
    require_margin(found)
    if weak := weak_spots(config, task):
        raise DesignRefused("; ".join(weak))
    _write(out, canonical(config) + b"\n")
    if as_json:
        typer.echo(json.dumps({"controller": config_hash(config), "out": str(out), **vars(found)}))
        return
    spans = f"{line.n} span{'' if line.n == 1 else 's'}"
    typer.echo(
        f"{out}: {names[0]} for {spans} at {line.control.period_s * 1e3:g} ms, hash {config_hash(config)[:12]}\n"
        f"stands {1e3 * found.delay_margin_s:.1f} ms more delay; slowest mode {1.0 / found.decay_per_s:.2f} s; "
        f"noise moves the torque by {found.chatter_nm:.2f} Nm from period to period"
    )


def _phase(
    line: Line,
    model: LineModel | None,
    names: list[str],
    given: list[str],
    speeds: list[float],
    iterations: int,
    seed: int,
    out: Path,
    as_json: bool,
    asked: "AskedAgents | None",
    gate: "Beforehand",
    judged: str,
    folder: Path,
) -> None:
    from gateway.cli.audit_against import head_in
    from gateway.cli.design_phase import ANSWER_S, RULES_DECIDE, run_design
    from gateway.cli.design_progress import Progress
    from gateway.cli.design_report import page_of
    from gateway.cli.design_result import result_of
    from gateway.cli.design_table import print_design
    from gateway.cli.line_records import read_records, unconfirmed_in
    from gateway.cli.report.page_render import render_page
    from gateway.cli.scenarios import load_scenario
    from gateway.cli.waiting import interruptible
    from gateway.commissioning.suite import suite_of
    from gateway.core.controller import canonical
    from gateway.core.scenario import ScenarioRefused

    try:
        scenarios = [load_scenario(one) for one in given] or suite_of(line)
    except ScenarioRefused as refused:
        _refuse(f"--scenario: {refused}")
    began_s = time.monotonic()
    with interruptible(f"{out} and its record are as before"), Progress(names, iterations, as_json) as progress:
        found = run_design(
            line, scenarios, names, iterations, seed, progress.attempted, speeds, model,
            decider=RULES_DECIDE if asked is None else asked,
            answer_s=ANSWER_S if asked is None else 2.0 * asked.within_s,  # they see to their own time
            on_decision=progress.decided, gate=gate,
        )  # fmt: skip
    result = result_of(line, found, seed, model, judged)
    if found.chosen is not None and found.chosen.config is not None:
        _write(out, canonical(found.chosen.config) + b"\n")
    record, report = _beside(out)
    _write(record, (result.model_dump_json(indent=2) + "\n").encode())
    page = page_of(result, found)
    in_service = unconfirmed_in(read_records(folder).book) if head_in(folder) else []
    page = replace(page, audit_head=head_in(folder), notes=(*in_service, *page.notes))
    _write(report, render_page(page).encode())
    if as_json:
        typer.echo(result.model_dump_json(indent=2))
    else:
        print_design(result, time.monotonic() - began_s)
        typer.echo(f"record: {record}\nreport: {report}")
    if found.chosen is None:
        _refuse(
            f"no configuration was written{'; the one in ' + str(out) + ' is left as it was' if out.exists() else ''}"
        )
    elif not as_json:
        typer.echo(
            f"configuration: {out}, hash {result.controller[:12]}\n"
            f"on a line that runs: r2rgate propose {quote(str(out))} --reason TEXT; on one that does not: "
            f"r2rgate run FILE --controller {quote(str(out))}"
        )


def _gate(
    line: Line, model: LineModel | None, data_dir: Path | None, run_dir: Path | None, seed: int
) -> "tuple[Beforehand, str]":
    """By which candidates are judged, and against what they are. Raises DesignRefused."""
    from gateway.cli.line_in_service import context_of, in_service, stands
    from gateway.commissioning.beforehand import Beforehand
    from gateway.core.controller import ControllerRefused
    from gateway.supervisor.configurations import ConfigurationsError

    try:
        held, at = in_service(line, data_dir), stands(line, run_dir)
    except (ConfigurationsError, ControllerRefused) as error:
        _refuse(f"what is in service is not known: {error}")
    except OSError as error:
        _refuse(f"what is in service cannot be read: {error}")
    said = "; ".join(one.said for one in (held, at) if one is not None) or "as of a line that is new"
    return Beforehand(line, context_of(line, model, held, at), seed), said


def _beside(out: Path) -> tuple[Path, Path]:
    """Where record and report go."""
    return out.with_suffix(".design.json"), out.with_suffix(".design.html")


def _write(path: Path, content: bytes) -> None:
    """All of it or nothing."""
    part = path.with_name(path.name + ".part")
    part.write_bytes(content)
    part.replace(path)


def _speeds(given: str) -> list[float]:
    from gateway.core.controller_schedule import wrong_speeds

    speeds: list[float] = []
    try:
        speeds = [float(one) for one in given.split(",")] if given else []
        wrong = wrong_speeds(speeds) if speeds else ""
    except ValueError:
        wrong = "these are no numbers"
    if wrong:
        _refuse(f"--schedule {given}: {wrong}")
    return speeds


def _may_write(out: Path, inputs: list[Path], only: bool) -> None:
    """Known before minutes of work, not after them: what is written can be, and is none of the files that are read."""
    for path in (out,) if only else (out, *_beside(out)):
        if path.resolve() in [given.resolve() for given in inputs]:
            _refuse(f"--out {out} would overwrite {path}, which is read; name another file")
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            why = "" if access(path if path.exists() else path.parent, W_OK) else "Permission denied"
            why = "it is a folder" if path.is_dir() else why
        except OSError as error:
            why = str(error.strerror)
        if why:
            _refuse(f"--out {path} cannot be written: {why}; name a file in a folder that you may write")


def _refuse(message: str) -> NoReturn:
    typer.echo(message, err=True)
    raise typer.Exit(REFUSED)
