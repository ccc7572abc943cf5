"""`r2rgate rehearse`: which design is worth what on a simulated plant, before anybody goes to the line."""

import time
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal, NoReturn

import typer

from gateway.cli.process_commands import REFUSED, read_line

if TYPE_CHECKING:
    from gateway.cli.rehearse import Case
    from gateway.cli.rehearse_result import AdaptationResult, ConfigurationResult, RehearseResult
    from gateway.core.line import Line
    from gateway.core.scenario import Scenario
    from sim_plant.plant import Plant

UNSAFE = 1  #: exit code
LIBRARIES = ("r2rgate", "numpy", "scipy", "daqp", "osqp", "numba")


def rehearse(
    line_file: Annotated[Path, typer.Option("--line", help="The line description: what is believed.")],
    plant_file: Annotated[Path, typer.Option("--plant", help="The simulated line: what is true.")],
    scenario: Annotated[
        str | None,
        typer.Option(help="tension, velocity, or a scenario's TOML file. Without it both, on a line of six spans."),
    ] = None,
    tier: Annotated[
        Literal["P", "A", "A-fast", "B"] | None,
        typer.Option(help="Period, latency, limits and moves of the benchmark. Without it those of the two files."),
    ] = None,
    adaptations: Annotated[
        int, typer.Option(min=0, max=5, help="Rounds of experiment, model and redesign, each through the gate.")
    ] = 0,
    seed: Annotated[int, typer.Option(min=0, help="Of the simulated line's noise.")] = 0,
    llm: Annotated[str, typer.Option(help="Language model. So far only off.")] = "off",
    out: Annotated[Path, typer.Option(help="The result, as JSON; its folder is made.")] = Path("out/rehearse.json"),
    as_json: Annotated[bool, typer.Option("--json", help="Print the result to standard output, and no table.")] = False,
    workers: Annotated[int | None, typer.Option(min=1, help="Processes at once; default: one a processor.")] = None,
) -> None:
    """Rehearse a line's commissioning against a simulated plant, in stepped time: no hardware, no waiting.

    Every law is designed on the line's nominal model and run by the whole cycle of the gateway. LQI and MPC designed
    on the plant's own parameters show what better knowledge would bring. With --adaptations the line is commissioned
    as `r2rgate commission` would, every experiment, model and redesign judged by the gate and deployed on probation;
    LQI and MPC are then designed on each model that was accepted. The files must agree in the number of spans; wires
    and addresses do not matter. The same seed gives the same figures, but for compute times.

    Exit code: 0 done, 1 done and unsafe events were seen at the simulated drives, 2 refused, 130 interrupted.

    Example: r2rgate rehearse --line line.toml --plant sim_plant/plants/s_real.toml --tier A
    """
    if llm != "off":
        _refuse(f"--llm {llm} is not possible yet; allowed now: off")
    line, plant = read_line(line_file), _read_plant(plant_file)
    cases = _cases(line, plant, _scenarios(scenario), tier)
    _require_writable(out)
    began_s = time.monotonic()
    found, rounds = _rehearsed(cases, seed, workers, out, adaptations)
    result = _result(
        line, line_file, plant, plant_file, cases, tier, seed, adaptations, found, rounds, time.monotonic() - began_s
    )
    text = result.model_dump_json(indent=2) + "\n"
    try:
        out.write_text(text, encoding="utf-8")
    except OSError as error:
        _refuse(f"--out {out} cannot be written: {error.strerror}")
    if as_json:
        typer.echo(text, nl=False)
    else:
        from rich.console import Console

        from gateway.cli.rehearse_table import print_result

        print_result(result, out, Console(highlight=False))
    raise typer.Exit(UNSAFE if result.unsafe_events else 0)


def _read_plant(file: Path) -> "Plant":
    from sim_plant.plant import PlantRefused, load_plant

    try:
        return load_plant(file)
    except PlantRefused as refused:
        _refuse("\n".join(f"{file}: {reason}" for reason in refused.reasons))
    except OSError as error:
        _refuse(f"{file} cannot be read: {error.strerror}; a plant is sim_plant/plants/s_real.toml")


def _scenarios(given: str | None) -> list["Scenario"]:
    from gateway.cli.scenarios import load_scenario
    from gateway.core.scenario import ScenarioRefused

    try:
        return [] if given is None else [load_scenario(given)]
    except ScenarioRefused as refused:
        _refuse(f"--scenario {refused}")


def _cases(line: "Line", plant: "Plant", scenarios: list["Scenario"], tier: str | None) -> list["Case"]:
    from gateway.cli.rehearse import RehearsalRefused, cases_of
    from gateway.cli.tiers import TIERS

    try:
        return cases_of(line, plant, scenarios, None if tier is None else TIERS[tier])
    except RehearsalRefused as refused:
        _refuse("\n".join(refused.reasons))


def _require_writable(out: Path) -> None:
    """Told before the work, not after it."""
    from os import W_OK, X_OK, access

    why = ""
    try:
        out.parent.mkdir(parents=True, exist_ok=True)
        if out.is_dir():
            why = "it is a folder"
        elif not access(out if out.exists() else out.parent, W_OK) or not access(out.parent, X_OK):
            why = "Permission denied"
    except OSError as error:
        why = str(error.strerror)
    if why:
        _refuse(f"--out {out} cannot be written: {why}; name a file in a folder that you may write")


def _rehearsed(
    cases: list["Case"], seed: int, workers: int | None, out: Path, adaptations: int
) -> tuple[list["ConfigurationResult"], list["AdaptationResult"]]:
    from gateway.cli.rehearse import rehearse
    from gateway.cli.waiting import interruptible, progress
    from gateway.cli.workers import processors

    with interruptible(f"{out} is not written"), progress() as tell:
        return rehearse(cases, seed, workers or processors(), tell, adaptations=adaptations)


def _result(
    line: "Line",
    line_file: Path,
    plant: "Plant",
    plant_file: Path,
    cases: list["Case"],
    tier: str | None,
    seed: int,
    adaptations: int,
    found: list["ConfigurationResult"],
    rounds: list["AdaptationResult"],
    wall_s: float,
) -> "RehearseResult":
    from gateway.cli.origin import command_line, machine, now_iso, versions_of
    from gateway.cli.rehearse_designs import without_term
    from gateway.cli.rehearse_result import Conditions, NamedFile, RehearseResult

    control, limits = cases[0].line.control, cases[0].line.limits
    return RehearseResult(
        command=command_line(),
        date=now_iso(),
        machine=machine(),
        versions=versions_of(LIBRARIES),
        seed=seed,
        adaptations=adaptations,
        llm="off",
        line=NamedFile(file=str(line_file), name=f"{line.site}/{line.line}"),
        plant=NamedFile(file=str(plant_file), name=plant.name),
        tier=tier,
        conditions=Conditions(
            period_s=control.period_s,
            latency_s=control.latency_s,
            torque_nm=limits.torque_nm,
            torque_rate_nm_per_s=limits.torque_rate_nm_per_s,
        ),
        scenarios=[case.scenario for case in cases],
        without_term=without_term(plant),
        rounds=rounds,
        configurations=found,
        unsafe_events=sum(case.unsafe_events for one in found for case in one.cases)
        + sum(one.unsafe_events for one in rounds),
        wall_s=round(wall_s, 1),
    )


def _refuse(text: str) -> NoReturn:
    typer.echo(text, err=True)
    raise typer.Exit(REFUSED)
