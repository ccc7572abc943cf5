"""`r2rgate models`: what is known of a line's physics, since when, from which data, and how it has changed."""

import json
import sys
import time
from dataclasses import replace
from pathlib import Path
from typing import Annotated, Any, NoReturn

import typer
from rich.console import Console

from gateway.cli.data_place import own_folder
from gateway.cli.model_place import (
    Chosen,
    Place,
    chosen,
    chosen_of,
    place_of,
    read_model,
    reasons_against_line,
)
from gateway.cli.process_commands import REFUSED, DataFolder, data_folder_of
from gateway.core.line_model import LineModel, canonical
from gateway.core.line_problem import printable
from gateway.mailbox.paths import GATEWAY_DATA
from gateway.supervisor.model_store import ModelsError
from gateway.supervisor.models import FILE_NAME, Entry, begin_repository, open_repository

app = typer.Typer(
    name="models",
    help="What was identified of a line: every version, with its data, intervals, prior and state.",
    no_args_is_help=True,
)

Json = Annotated[bool, typer.Option("--json", help="Print as JSON.")]
LineOption = Annotated[
    Path | None, typer.Option("--line", help="The line description; not needed where one line has models.")
]
Which = Annotated[str, typer.Argument(help="A file, a version, six letters or more of an id, or newest.")]
LIBRARIES = ("r2rgate", "numpy")


@app.command("list")
def list_models(line: LineOption = None, data_dir: DataFolder = None, as_json: Json = False) -> None:
    """Every version, the oldest first: what it found for EA/L, R/J and f/J, from which data, and what became of it.

    ± is half the interval of 95 %. Exit code: 0 listed, 2 refused.

    Example: r2rgate models list --line line.toml
    """
    try:
        place = place_of(line, data_dir)
        entries = _stored(place)
    except ModelsError as error:
        _refuse(error)
    if as_json:
        _print_json({"repository": str(place.path), "models": [_entry_data(one) for one in entries]})
        return
    from gateway.cli.models_view import print_list

    print_list(entries, place.path, _console())


@app.command()
def show(which: Which = "newest", line: LineOption = None, data_dir: DataFolder = None, as_json: Json = False) -> None:
    """Everything that a model says. Exit code: 0 shown, 2 refused.

    Example: r2rgate models show 3

    Example: r2rgate models show model.json --json
    """
    try:
        shown = chosen(which, line, data_dir)
        ancestors = _ancestors(shown, line, data_dir)
    except ModelsError as error:
        _refuse(error)
    if as_json:
        whole = {"model": shown.model.model_dump(mode="json"), "ancestors": [one.id for one in ancestors]}
        _print_json((_entry_data(shown.entry) if shown.entry else {"id": shown.id}) | whole)
        return
    from gateway.cli.models_view import print_model

    print_model(shown, ancestors, _console())


@app.command()
def compare(a: Which, b: Which, line: LineOption = None, data_dir: DataFolder = None, as_json: Json = False) -> None:
    """Two models side by side: every quantity, how far apart, and whether the intervals exclude each other.

    Exit code: 0 compared, 2 refused.

    Example: r2rgate models compare 1 newest
    """
    from gateway.cli.models_compare import as_data, compared, verdict

    try:
        first, second = (chosen(one, line, data_dir) for one in (a, b))
    except ModelsError as error:
        _refuse(error)
    if as_json:
        rows = compared(first.model, second.model)
        sides = {"a": _side(first), "b": _side(second)}
        _print_json({**sides, "quantities": as_data(rows), "verdict": verdict(rows)})
        return
    from gateway.cli.models_view import print_comparison

    print_comparison(first, second, _console())


@app.command("import")
def import_model(
    file: Annotated[Path, typer.Argument(help="A model file (r2rgate models export writes one).")],
    line: LineOption = None,
    data_dir: DataFolder = None,
    as_json: Json = False,
) -> None:
    """Store a model from a file as the next version of its line. One that is stored already stays as it is.

    Exit code: 0 stored, 2 refused.

    Example: r2rgate models import model.json --line line.toml
    """
    try:
        model = read_model(file)
        place = _place_for(model, line, data_dir)
        if place.line and (reasons := reasons_against_line(model, place.line)):
            raise ModelsError("\n".join(f"{file} is not imported: {reason}" for reason in reasons))
        with begin_repository(place.path) as models:
            before = len(models.entries())
            entry = models.store(model, time.time())
            new = len(models.entries()) > before
    except ModelsError as error:
        _refuse(error)
    if as_json:
        _print_json({"repository": str(place.path), "new": new, **_entry_data(entry)})
        return
    said = "stored as" if new else "was there already, as"
    typer.echo(f"{file}: {said} version {entry.version} of {entry.site}/{entry.line}, id {entry.id[:12]}")
    typer.echo(f"repository: {place.path}")


@app.command()
def export(
    which: Which,
    out: Annotated[Path, typer.Option(help="The file to write; - for standard output.")],
    line: LineOption = None,
    data_dir: DataFolder = None,
    force: Annotated[bool, typer.Option("--force", help="Overwrite the file if it exists.")] = False,
) -> None:
    """Write a stored model to a file. Its content is canonical: the same model is the same bytes everywhere.

    Exit code: 0 written, 2 refused.

    Example: r2rgate models export newest --out model.json
    """
    try:
        place = place_of(line, data_dir)
        with open_repository(place.path) as models:
            found = chosen_of(models.find(which, *place.key), place.path)
    except ModelsError as error:
        _refuse(error)
    content = canonical(found.model) + b"\n"
    if str(out) == "-":
        sys.stdout.write(content.decode())
        return
    if out.exists() and not force:
        _refuse(f"{out} exists and was left as it was; use another --out, or --force to overwrite it")
    _write(out, content)
    typer.echo(f"{out}: {found.name} of {found.model.site}/{found.model.line}, id {found.id[:12]}")


@app.command()
def report(
    out: Annotated[Path, typer.Option(help="The page to write.")] = Path("models.html"),
    line: LineOption = None,
    data_dir: DataFolder = None,
) -> None:
    """All versions of a line's model as one self-contained page, with the drift of every parameter as plots.

    Exit code: 0 written, 2 refused.

    Example: r2rgate models report --out models.html
    """

    from gateway.cli.audit_against import head_in
    from gateway.cli.models_report import page_of
    from gateway.cli.origin import command_line, machine, now_iso, versions_of
    from gateway.cli.report.page_render import render_page

    try:
        place = place_of(line, data_dir)
        entries = _stored(place)
        lines = sorted({(one.site, one.line) for one in entries})
        if len(lines) > 1:
            named = ", ".join("/".join(one) for one in lines)
            raise ModelsError(f"{place.path} has models of {named}: name the line with --line")
    except ModelsError as error:
        _refuse(error)
    page = page_of(*lines[0], entries, now_iso(), command_line(), versions_of(LIBRARIES), machine())
    page = replace(page, audit_head=head_in(place.path.parent))
    _write(out, render_page(page).encode())
    typer.echo(f"report: {out}, {len(entries)} version{'' if len(entries) == 1 else 's'}")


def _stored(place: Place) -> list[Entry]:
    """Those of the place's line, at least one. Raises ModelsError."""
    with open_repository(place.path) as models:
        if found := models.entries(*place.key):
            return found
    of_line = f" of {place.line.site}/{place.line.line}" if place.line else ""
    raise ModelsError(f"{place.path} has no model{of_line} yet: r2rgate models import FILE takes one")


def _place_for(model: LineModel, line: Path | None, data_dir: Path | None) -> Place:
    """Where a model goes: it names its line itself."""
    if line is None and data_dir is None:
        return Place(own_folder(data_folder_of(model.site, model.line), GATEWAY_DATA) / FILE_NAME)
    return place_of(line, data_dir)


def _ancestors(shown: Chosen, line: Path | None, data_dir: Path | None) -> list[Entry]:
    if shown.entry is None:
        return []
    with open_repository(place_of(line, data_dir).path) as models:
        return models.ancestors(shown.entry)


def _entry_data(entry: Entry) -> dict[str, Any]:
    """A stored model for machines, without what only `show` tells."""
    from gateway.cli.models_view import STRONG
    from gateway.core.line_model_quantities import typical

    model = entry.model
    known = {} if model is None else {
        "created": model.created,
        "method": model.method,
        **{name: vars(typical(model, name)).copy() for name in STRONG},
        "data": model.data.model_dump(mode="json"),
        "parent": model.parent,
    }  # fmt: skip
    return {
        "version": entry.version,
        "id": entry.id,
        "site": entry.site,
        "line": entry.line,
        "stored_s": entry.stored_s,
        "state": entry.state,
        "marks": [mark._asdict() for mark in entry.marks],
        "damage": entry.damage,
        **known,
    }


def _side(one: Chosen) -> dict[str, Any]:
    """A compared model for machines."""
    document = one.model.model_dump(mode="json")
    kept = ("created", "method", "structure", "noise", "data", "region", "validation", "parent")
    return {
        "name": one.name,
        "id": one.id,
        "version": one.entry.version if one.entry else None,
        **{key: document[key] for key in kept},
    }


def _write(path: Path, content: bytes) -> None:
    """All of it or nothing."""
    part = path.with_name(path.name + ".part")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        part.write_bytes(content)
        part.replace(path)
    except OSError as error:
        _refuse(f"--out {path} cannot be written: {error.strerror}; name a file in a folder that you may write")


def _console() -> Console:
    return Console(highlight=False)


def _print_json(data: object) -> None:
    typer.echo(json.dumps(data, indent=2))


def _refuse(why: object) -> NoReturn:
    for text in str(why).splitlines():
        typer.echo(printable(text), err=True)
    raise typer.Exit(REFUSED)
