"""The `r2rgate` command: every subcommand, and nothing but their names and places."""

import sys
from typing import Annotated, NoReturn

import typer
from pydantic import ValidationError

from gateway.cli import (
    agents_commands,
    alarms_commands,
    ask_commands,
    audit_commands,
    audit_replay,
    baselines_commands,
    commission_commands,
    compute_commands,
    configurations_commands,
    demo_commands,
    design_commands,
    doctor_commands,
    eval_commands,
    experiment_commands,
    fault_commands,
    identify_commands,
    judge_commands,
    line_commands,
    models_commands,
    operate_commands,
    operator_commands,
    pki_commands,
    process_commands,
    proposal_commands,
    prove_commands,
    recordings_export,
    refine_commands,
    rehearse_commands,
    report_commands,
    scan_commands,
    status_commands,
    users_commands,
)
from gateway.cli.lifetime import follow_parent
from gateway.cli.process_commands import REFUSED
from gateway.core.line_problem import printable

app = typer.Typer(
    name="r2rgate",
    help="Edge gateway for roll-to-roll lines: tension and speed control over the line's own drives.",
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    context_settings={"help_option_names": ["-h", "--help"]},
)

NUMBERS = {"ignore_unknown_options": True}  # so that -5 is a number that is refused, not an option
ENGINEER, PROCESSES, LINE, OVERSIGHT, EVIDENCE = "Engineer", "Processes", "Running the line", "Oversight", "Evidence"

app.command(rich_help_panel=ENGINEER)(line_commands.init)
app.command(rich_help_panel=ENGINEER)(line_commands.check)
app.add_typer(scan_commands.app, rich_help_panel=ENGINEER)
app.command(rich_help_panel=ENGINEER)(doctor_commands.doctor)
app.add_typer(pki_commands.app, rich_help_panel=ENGINEER)
app.add_typer(users_commands.app, rich_help_panel=ENGINEER)
app.command(rich_help_panel=ENGINEER)(identify_commands.identify)
app.command(rich_help_panel=ENGINEER)(design_commands.design)
app.add_typer(models_commands.app, rich_help_panel=ENGINEER)
app.command(rich_help_panel=ENGINEER)(rehearse_commands.rehearse)
app.command(rich_help_panel=ENGINEER)(commission_commands.commission)
app.command(rich_help_panel=ENGINEER)(refine_commands.refine)
app.add_typer(experiment_commands.app, rich_help_panel=ENGINEER)
app.command(rich_help_panel=ENGINEER)(judge_commands.judge)
app.command(rich_help_panel=PROCESSES)(process_commands.run)
app.command(rich_help_panel=PROCESSES)(process_commands.loop)
app.command(rich_help_panel=PROCESSES)(process_commands.gateway)
app.command(rich_help_panel=PROCESSES)(agents_commands.agents)
app.command(rich_help_panel=PROCESSES)(operator_commands.operator)
app.command(rich_help_panel=PROCESSES)(process_commands.sim)
app.command(rich_help_panel=PROCESSES)(demo_commands.demo)
app.add_typer(fault_commands.app, rich_help_panel=PROCESSES)
app.command(rich_help_panel=LINE)(operate_commands.arm)
app.command(rich_help_panel=LINE)(operate_commands.start)
app.command("prove", rich_help_panel=LINE)(prove_commands.prove_wiring)
app.command(rich_help_panel=LINE)(operate_commands.hold)
app.command(rich_help_panel=LINE)(operate_commands.stop)
app.command("set", rich_help_panel=LINE, context_settings=NUMBERS)(operate_commands.set_tension)
app.command(rich_help_panel=LINE, context_settings=NUMBERS)(operate_commands.speed)
app.command(rich_help_panel=LINE)(operate_commands.recipe)
app.command(rich_help_panel=LINE)(status_commands.status)
app.command(rich_help_panel=ENGINEER)(proposal_commands.propose)
app.command(rich_help_panel=OVERSIGHT)(proposal_commands.proposals)
app.command(rich_help_panel=OVERSIGHT)(proposal_commands.approve)
app.command(rich_help_panel=OVERSIGHT)(proposal_commands.reject)
app.command(rich_help_panel=OVERSIGHT)(proposal_commands.rollback)
app.command(rich_help_panel=OVERSIGHT)(proposal_commands.confirm)
app.add_typer(alarms_commands.app, rich_help_panel=OVERSIGHT)
app.command(rich_help_panel=EVIDENCE)(report_commands.report)
app.command(rich_help_panel=EVIDENCE)(agents_commands.log)
app.command("export", rich_help_panel=EVIDENCE)(recordings_export.export)
audit_commands.app.command()(audit_replay.replay)
app.add_typer(audit_commands.app, rich_help_panel=EVIDENCE)
app.add_typer(configurations_commands.app, rich_help_panel=EVIDENCE)
app.command(rich_help_panel=EVIDENCE)(baselines_commands.baselines)
app.command(rich_help_panel=EVIDENCE)(ask_commands.ask)
app.command(rich_help_panel=ENGINEER)(compute_commands.compute)
app.command("eval", rich_help_panel=EVIDENCE)(eval_commands.evaluate)


@app.callback(invoke_without_command=True)
def top(version: Annotated[bool, typer.Option("--version", help="Print the version.")] = False) -> None:
    if version:
        from importlib.metadata import version as installed

        typer.echo(f"r2rgate {installed('r2rgate')}")
        raise typer.Exit


def main() -> None:
    """The program. Last resort for mistakes that no command has foreseen: one sentence and exit code 2."""
    follow_parent()
    try:
        app()
    except ValidationError as error:
        reasons = (f"{'.'.join(map(str, e['loc']))}: {e['msg']}, is {e['input']!r}" for e in error.errors())
        _end("; ".join(reasons))
    except OSError as error:
        _end(f"{error.filename}: {error.strerror}" if error.filename and error.strerror else str(error))


def _end(text: str) -> NoReturn:
    print(f"r2rgate: {printable(text)}", file=sys.stderr)
    sys.exit(REFUSED)
