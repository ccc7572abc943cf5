"""`r2rgate report`: a line's whole history of adaptations as one page."""

from pathlib import Path
from typing import Annotated

import typer

from gateway.cli.audit_commands import UNSOUND, instant_of, refuse
from gateway.cli.data_place import gateway_folder
from gateway.cli.process_commands import DataFolder, read_line
from gateway.core.line_problem import printable
from gateway.supervisor.audit_file import FILE_NAME


def report(
    line: Annotated[Path, typer.Option("--line", help="The line description.")],
    out: Annotated[Path, typer.Option("--out", help="The page to write.")] = Path("report.html"),
    since: Annotated[
        str | None, typer.Option("--since", help="Only from then on: 2026-11-22T14:00+01:00, or 30min, 8h, 7d ago.")
    ] = None,
    data_dir: DataFolder = None,
) -> None:
    """A line's adaptations as one self-contained page, from its records; also while the line runs.

    Each change with reason, difference, verdict, decision and result; every configuration that was kept, simulated
    under identical conditions; what the line was measured to do; questions to the agents, alarms, and whether the
    audit is sound. Nothing is changed.

    Exit code: 0 written, 1 written of an audit that is not sound, 2 refused.

    Example: r2rgate report --line line.toml --out report.html --since 30d
    """
    described = read_line(line)
    since_s = 0.0 if since is None else instant_of(since)
    folder = gateway_folder(described, data_dir)
    if not folder.is_dir():
        refuse(
            f"there is no folder {folder}, so nothing to report of {described.site}/{described.line}: a gateway makes "
            "it when it starts; --data-dir FOLDER names another"
        )
    if not (folder / FILE_NAME).exists():
        refuse(
            f"there is no audit in {folder}, so nothing to report: a gateway begins one when it starts; --data-dir "
            "FOLDER names another folder"
        )
    if not out.parent.is_dir():  # before anything that takes its time
        refuse(f"--out {out} cannot be written: there is no folder {out.parent}; name a file in a folder that is there")
    from gateway.cli.line_records import read_records
    from gateway.cli.report.page_render import render_page
    from gateway.cli.report_page import page_of

    def tell(text: str) -> None:
        typer.echo(printable(text), err=True)

    tell(f"reading {folder}; where nothing was simulated before, the first simulation compiles for some seconds")
    records = read_records(folder)
    lines = {(one.proposal.site, one.proposal.line) for one in records.proposals}
    if others := sorted(lines - {(described.site, described.line)}):
        named = ", ".join("/".join(one) for one in others)
        refuse(f"{folder} has the records of {named}, {line} describes {described.site}/{described.line}")
    text = render_page(page_of(described, folder, since_s, records, tell))
    try:
        part = out.with_name(out.name + ".part")
        part.write_text(text, encoding="utf-8")
        part.replace(out)
    except OSError as error:
        refuse(f"--out {out} cannot be written: {error.strerror}; name a file in a folder that you may write")
    sound = records.found.sound
    typer.echo(f"report: {out}, {len(records.proposals)} proposals, audit {'sound' if sound else 'NOT SOUND'}")
    raise typer.Exit(0 if sound else UNSOUND)
