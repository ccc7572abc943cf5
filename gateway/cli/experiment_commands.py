"""`r2rgate experiment`: set-point moves that tell a line's physics: designed, run with progress, aborted."""

import asyncio
import json
from pathlib import Path
from shlex import quote
from typing import TYPE_CHECKING, Annotated, NoReturn

import typer

from gateway.cli.operate_commands import REFUSED, UNREACHABLE, Json, RunFolder
from gateway.cli.process_commands import ControllerFile, DataFolder, LineFile, read_line
from gateway.core.line import Line
from gateway.files import MOST_BYTES, read_bytes

if TYPE_CHECKING:
    from gateway.core.controller import Controller
    from gateway.core.experiment import Experiment
    from gateway.identification.experiment_design import DesignedExperiment

ABORTED = 4
FIELDS = "tension_n,tension_setpoint_n,speed_m_per_s,torque_nm,torque_actual_nm,unwind_speed_m_per_s"

app = typer.Typer(
    name="experiment",
    help="Tension set-points that move a little at random, so that the line's own data tell its physics.",
    no_args_is_help=True,
)

ExperimentFile = Annotated[Path, typer.Argument(help="The experiment (r2rgate experiment design writes one).")]


@app.command()
def design(
    file: LineFile,
    controller: ControllerFile = None,
    data_dir: DataFolder = None,
    out: Annotated[Path, typer.Option(help="The experiment to write.")] = Path("experiment.json"),
    recipe: Annotated[
        str, typer.Option(help="Where the line stands; without: as it stands now, or the first recipe.")
    ] = "",
    speed: Annotated[
        list[float] | None, typer.Option(help="Of a leg in m/s; repeatable. Without: two that suit the tolerances.")
    ] = None,
    strong: Annotated[float, typer.Option(min=1e-4, help="95 % half-width wanted of EA/L, R/J and f/J, in %.")] = 0.5,
    rest: Annotated[float, typer.Option(min=1e-4, help="The same of EA, L, R, J and f, in %.")] = 3.0,
    seed: Annotated[int, typer.Option(min=0, help="Of the levels.")] = 0,
    run_dir: RunFolder = None,
    as_json: Annotated[bool, typer.Option("--json", help="Print experiment, intervals and reasons as JSON.")] = False,
) -> None:
    """Design an experiment: amplitude, dwell and duration from the line's tolerances, with the reasons in words.

    As little movement as tells what is wanted; tensions are foreseen on the corners of the tolerances, under the
    controller in service (--controller; without: as the line's records have it, or the lqi that `run` would design),
    from where set-points stand now, or from a recipe.

    Example: r2rgate experiment design line.toml --out experiment.json
    """
    from gateway.cli.line_in_service import stands as standing
    from gateway.cli.waiting import interruptible, progress
    from gateway.core.experiment import ExperimentRefused, canonical, experiment_hash
    from gateway.identification.experiment_design import Wanted, design_experiment

    line = read_line(file)
    recipes = {one.name: one for one in line.recipes}
    stands = recipes.get(recipe or line.recipes[0].name)
    if stands is None:
        _refuse(f"there is no recipe {recipe!r}; known: {', '.join(recipes)}")
    config, said = _controller(line, file, controller, data_dir)
    now = None if recipe else standing(line, run_dir)
    now = None if now is None or now.speed_m_per_s <= 0.0 else now  # at rest nothing is told
    tension_n, speed_m_per_s = (
        (stands.tension_n, stands.speed_m_per_s) if now is None else (now.tension_n, now.speed_m_per_s)
    )
    try:
        with interruptible(f"{out} is as before"), progress() as show:
            show("simulating amplitudes, dwells and durations on corners of the tolerances: a minute")
            found = design_experiment(
                line,
                config,
                tension_n=tension_n,
                speed_m_per_s=speed_m_per_s,
                speeds_m_per_s=speed or None,
                wanted=Wanted(0.01 * strong, 0.01 * rest),
                seed=seed,
            )
    except ExperimentRefused as refused:
        _refuse(f"no experiment for {file}: {refused}")
    try:
        out.write_bytes(canonical(found.experiment) + b"\n")
    except OSError as error:
        _refuse(f"--out {out} cannot be written: {error.strerror}")
    if as_json:
        typer.echo(json.dumps(_document(found), indent=2))
        return
    where = now.said if now is not None else f"recipe {stands.name}"
    typer.echo("\n".join([f"for {said}; from {where}", *found.reasons]))
    typer.echo(f"{out}: {experiment_hash(found.experiment)[:12]}")
    name = quote(str(out))
    typer.echo(f"next: r2rgate propose {name} --reason TEXT; a simulated line takes r2rgate experiment run {name}, too")


@app.command()
def run(file: ExperimentFile, run_dir: RunFolder = None, as_json: Json = False) -> None:
    """Run an experiment on the line that runs, and wait for its end. Ctrl-C aborts it.

    The line must be in RUN with set-points that stand. Only a simulated line takes one in this way; on a real one it is
    judged and approved first (r2rgate propose).

    Exit code: 0 complete, 2 refused, 3 not reachable, 4 aborted.

    Example: r2rgate experiment run experiment.json
    """
    from gateway.cli.experiment_run import follow
    from gateway.cli.operate_commands import request
    from gateway.cli.status_commands import choose_run_folder
    from gateway.cli.waiting import progress
    from gateway.core.messages import AbortExperiment
    from gateway.mailbox.listener import PathTooLong
    from gateway.mailbox.port import Unreachable

    experiment, folder = _read(file), choose_run_folder(run_dir)
    try:
        with progress() as show:
            ended = asyncio.run(follow(folder, experiment, show))
    except KeyboardInterrupt:
        reply = asyncio.run(request(folder, AbortExperiment()))
        typer.echo(f"interrupted: {reply.text}", err=True)
        raise typer.Exit(ABORTED) from None
    except (Unreachable, PathTooLong) as error:
        typer.echo(str(error), err=True)
        raise typer.Exit(UNREACHABLE) from None
    if as_json:
        typer.echo(json.dumps(vars(ended), indent=2))
    else:
        typer.echo(ended.text, err=not ended.complete)
        for reason in ended.reasons:
            typer.echo(f"  - {reason}", err=True)
        if ended.history:
            typer.echo(
                f"data: {ended.history}, Unix time {ended.begin_s:.1f} to {ended.end_s:.1f}; as a table, now: "
                f"r2rgate export FILE --last {ended.end_s - ended.begin_s + 1.0:.0f} --fields {FIELDS}"
            )
    if not ended.complete:
        raise typer.Exit(ABORTED if ended.begun else REFUSED)


@app.command()
def abort(run_dir: RunFolder = None, as_json: Json = False) -> None:
    """End the experiment that runs; set-points go back to where they stood before it.

    Example: r2rgate experiment abort
    """
    from gateway.cli.operate_commands import send
    from gateway.core.messages import AbortExperiment

    send(AbortExperiment(), run_dir, as_json)


def _controller(line: Line, file: Path, given: Path | None, data_dir: Path | None) -> tuple["Controller", str]:
    """The configuration in service, and what to call it."""
    from gateway.cli.line_in_service import in_service
    from gateway.control.design import DesignRefused, design_lqi, task_of
    from gateway.core.controller import ControllerRefused, config_hash, parse_controller
    from gateway.supervisor.configurations import ConfigurationsError

    if given is not None:
        try:
            config = parse_controller(read_bytes(given, MOST_BYTES))
        except FileNotFoundError:
            _refuse(f"there is no controller configuration at {given}")
        except OSError as error:
            _refuse(f"{given} cannot be read: {error.strerror}")
        except ControllerRefused as refused:
            _refuse(f"{given} is not used: {refused}")
        return config, f"the {config.kind} controller in {given}, {config_hash(config)[:12]}"
    try:
        held = in_service(line, data_dir)
        if held is not None:
            return held.controller, held.said
        return design_lqi(task_of(line)), "the lqi controller that `r2rgate run` would design: the line has never run"
    except (ConfigurationsError, ControllerRefused, OSError) as error:
        _refuse(f"what is in service is not known: {error}; name one with --controller")
    except DesignRefused as refused:
        _refuse(f"no lqi controller for {file}: {refused}; name one with --controller")


def _document(found: "DesignedExperiment") -> dict[str, object]:
    return {
        "experiment": found.experiment.model_dump(mode="json"),
        "expected_half_widths": found.expected,
        "worst_half_widths": found.worst,
        "foreseen": vars(found.foreseen),
        "reasons": found.reasons,
    }


def _read(file: Path) -> "Experiment":
    from gateway.core.experiment import ExperimentRefused, parse_experiment

    try:
        return parse_experiment(read_bytes(file, MOST_BYTES))
    except OSError as error:
        _refuse(f"{file} cannot be read: {error.strerror}; r2rgate experiment design writes an experiment")
    except ExperimentRefused as refused:
        _refuse(f"{file} is no experiment: {refused}")


def _refuse(text: str) -> NoReturn:
    typer.echo(text, err=True)
    raise typer.Exit(REFUSED)
