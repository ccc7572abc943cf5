"""`r2rgate configurations`: every controller stored for a line, who put it forward and why, and the archived."""

import asyncio
import json
import time
from datetime import UTC, datetime
from pathlib import Path
from typing import Annotated, Any, NoReturn

import typer
from rich.box import SIMPLE_HEAD
from rich.console import Console
from rich.table import Table

from gateway.cli.audit_commands import this_user
from gateway.cli.data_place import gateway_data
from gateway.cli.operate_commands import RunFolder
from gateway.cli.process_commands import REFUSED, DataFolder, read_line
from gateway.cli.status_commands import ask_status
from gateway.core.decisions import Archive
from gateway.core.line_problem import printable
from gateway.core.messages import Reply
from gateway.core.topics import GATEWAY_DECISION
from gateway.mailbox.listener import PathTooLong
from gateway.mailbox.paths import GATEWAY_SOCKET, running_lines
from gateway.mailbox.port import Unreachable
from gateway.mailbox.unix import UnixMailbox
from gateway.supervisor.archiving import archive as archive_configuration
from gateway.supervisor.audit import Audit
from gateway.supervisor.configurations import (
    FILE_NAME,
    STABLE,
    Configuration,
    Configurations,
    ConfigurationsError,
    named,
    open_configurations,
)

app = typer.Typer(
    name="configurations",
    help="Controller configurations of a line: every one that was stored, and those archived under a name.",
    no_args_is_help=True,
)

SHORT = 8  #: letters of a hash
ANSWER_S = 20.0
Key = tuple[str, str] | tuple[None, None]

Json = Annotated[bool, typer.Option("--json", help="Print as JSON.")]
LineOption = Annotated[
    Path | None, typer.Option("--line", help="The line description; not needed where one line has configurations.")
]
Which = Annotated[
    str, typer.Argument(help=f"A version, six letters or more of an id, newest, or a name such as {STABLE}.")
]


@app.command("list")
def list_configurations(
    line: LineOption = None,
    data_dir: DataFolder = None,
    archived: Annotated[bool, typer.Option("--archived", help="Only those that a name stands for.")] = False,
    as_json: Json = False,
) -> None:
    """Every configuration, the oldest first. Exit code: 0 listed, 2 refused.

    Example: r2rgate configurations list --archived
    """
    try:
        storage, key = _storage(line, data_dir)
        with storage:
            found = storage.entries(*key)
    except ConfigurationsError as error:
        _refuse(error)
    names = _names(found)
    shown = [one for one in found if names[one.site, one.line, one.id] or not archived]
    if as_json:
        typer.echo(
            json.dumps({"storage": str(storage.path), "configurations": [_data(one) for one in shown]}, indent=2)
        )
        return
    table = _table("version", "stored", "kind", "model", "parent", "names", "by, why")
    for one in shown:
        newest = one.origins[-1]
        table.add_row(
            f"v{one.version}\n{one.id[:SHORT]}",
            _when(one.origins[0].time_s),
            one.controller.kind if one.controller else "DAMAGED",
            (newest.model or "-")[:SHORT],
            (newest.parent or "-")[:SHORT],
            "\n".join(names[one.site, one.line, one.id]) or "-",
            printable(f"{newest.who}: {newest.why}"),
        )
    console = Console(highlight=False, markup=False)
    console.print(table)
    for one in shown:
        if one.damage:
            console.print(f"version {one.version} is damaged: {printable(one.damage)}", style="bold red")
    console.print(f"storage: {storage.path}", soft_wrap=True)


@app.command()
def show(which: Which = "newest", line: LineOption = None, data_dir: DataFolder = None, as_json: Json = False) -> None:
    """A configuration with all its origins, and with --json all its numbers. Exit code: 0 shown, 2 refused.

    Example: r2rgate configurations show phi_stable --json
    """
    one = _found(which, line, data_dir)
    if as_json:
        controller = one.controller and one.controller.model_dump(mode="json")
        typer.echo(json.dumps({**_data(one), "controller": controller}, indent=2))
        return
    typer.echo(f"version {one.version} of {one.site}/{one.line}, {one.id}")
    if one.controller is None:
        typer.echo(f"  DAMAGED: {printable(one.damage)}")
    else:
        for name, value in flat(one.controller.model_dump(mode="json")).items():
            typer.echo(f"  {name:<24} {_short(value)}")
    for origin in one.origins:
        typer.echo(f"  put forward {_when(origin.time_s)} UTC by {printable(origin.who)}: {printable(origin.why)}")
        for name, id_ in (("parent", origin.parent), ("model", origin.model), ("verdict", origin.verdict)):
            if id_:
                typer.echo(f"    {name}: {id_}")
    for each in one.archived:
        said = f"{_when(each.time_s)} UTC by {printable(each.who)}: {printable(each.why)}"
        typer.echo(f"  archived as {each.name} {said}")


@app.command()
def compare(a: Which, b: Which, line: LineOption = None, data_dir: DataFolder = None, as_json: Json = False) -> None:
    """Every part in which two configurations differ. Exit code: 0 compared, 2 refused.

    Example: r2rgate configurations compare phi_stable newest
    """
    first, second = _found(a, line, data_dir), _found(b, line, data_dir)
    for one in (first, second):
        if one.controller is None:
            _refuse(f"version {one.version} is damaged: {one.damage}")
    rows = differences(first, second)
    if as_json:
        sides = {"a": _data(first), "b": _data(second)}
        parts = [{"name": name, "a": of_a, "b": of_b} for name, of_a, of_b in rows]
        typer.echo(json.dumps({**sides, "differences": parts}, indent=2))
        return
    for letter, one in (("A", first), ("B", second)):
        typer.echo(f"{letter}  version {one.version}, {one.id[:12]}, {one.site}/{one.line}")
    table = _table("", "A", "B")
    for name, of_a, of_b in rows:
        table.add_row(name, _short(of_a), _short(of_b))
    Console(highlight=False, markup=False).print(table if rows else "They are the same.")


@app.command()
def archive(
    which: Which,
    because: Annotated[str, typer.Option("--because", help="Why.")],
    name: Annotated[str, typer.Option("--name", help="Name that it shall have from now on.")] = STABLE,
    line: LineOption = None,
    data_dir: DataFolder = None,
    run_dir: RunFolder = None,
) -> None:
    """Keep a configuration under a name, to be proposed again by it. Puts nothing into service; it is audited.

    Where a gateway runs it does it; --run-dir names its sockets where they do not lie in the usual place.

    Exit code: 0 archived, 2 refused.

    Example: r2rgate configurations archive newest --because "three shifts within 1 N"
    """
    try:
        storage, key = _storage(line, data_dir)
        with storage:
            one = storage.find(which, *key)
            command = Archive(configuration=one.id, name=name, because=because)
            running = run_dir or _running_on(storage.path.parent)
            if running is not None:
                reply = asyncio.run(_asked(running, command))
            else:
                reply = asyncio.run(_archived(storage, one, command))
    except (ConfigurationsError, Unreachable, PathTooLong) as error:
        _refuse(error)
    if not reply.ok:
        _refuse("\n".join([reply.text, *reply.reasons]))
    typer.echo(reply.text)


def _running_on(folder: Path) -> Path | None:
    """The run folder of the gateway whose stores lie in `folder`; None: it does not run."""
    for run_folder in running_lines():
        try:
            status = asyncio.run(ask_status(run_folder))
        except (Unreachable, PathTooLong):
            continue
        if Path(status.historian.path).parent.resolve() == folder.resolve():
            return run_folder
    return None


async def _asked(run_folder: Path, command: Archive) -> Reply:
    mailbox = UnixMailbox()
    mailbox.connect((GATEWAY_DECISION,), run_folder / GATEWAY_SOCKET)
    try:
        return Reply.model_validate_json(
            await mailbox.request(GATEWAY_DECISION, command.model_dump_json().encode(), ANSWER_S)
        )
    finally:
        await mailbox.close()


async def _archived(storage: Configurations, one: Configuration, command: Archive) -> Reply:
    """Here: there is no gateway that writes the audit."""
    audit = Audit(storage.path.parent)
    audit.start()
    try:
        return await archive_configuration(audit, storage, one.site, one.line, command, this_user(), time.time())
    finally:
        await asyncio.to_thread(audit.close)


def differences(a: Configuration, b: Configuration) -> list[tuple[str, Any, Any]]:
    """(name, of a, of b) of every part that differs; None: it has no such part."""
    parts = [{} if one.controller is None else flat(one.controller.model_dump(mode="json")) for one in (a, b)]
    names = dict.fromkeys((*parts[0], *parts[1]))
    rows = [(name, parts[0].get(name), parts[1].get(name)) for name in names]
    return [row for row in rows if row[1] != row[2]]


def flat(value: dict[str, Any], prefix: str = "") -> dict[str, Any]:
    """Parts of parts by their full name, such as "reference.tension_n"."""
    found: dict[str, Any] = {}
    for name, part in value.items():
        found |= flat(part, f"{prefix}{name}.") if isinstance(part, dict) else {prefix + name: part}
    return found


def _short(value: Any) -> str:
    """A matrix by its shape, its least and its greatest number; anything else as it is."""
    numbers = list(_numbers(value))
    if not isinstance(value, list) or len(numbers) <= 6:
        return "-" if value is None else json.dumps(value)
    shape = f"{len(value)} x {len(value[0])}" if isinstance(value[0], list) else f"{len(value)}"
    return f"[{shape}: {min(numbers):.5g} to {max(numbers):.5g}]"


def _numbers(value: Any) -> list[float]:
    if isinstance(value, list):
        return [number for part in value for number in _numbers(part)]
    return [float(value)] if isinstance(value, int | float) else []


def _found(which: str, line: Path | None, data_dir: Path | None) -> Configuration:
    try:
        storage, key = _storage(line, data_dir)
        with storage:
            return storage.find(which, *key)
    except ConfigurationsError as error:
        _refuse(error)


def _storage(line: Path | None, data_dir: Path | None) -> tuple[Configurations, Key]:
    described = None if line is None else read_line(line)
    advice = "the gateway stores each that is put into service"
    folder = gateway_data(described, data_dir, FILE_NAME, "configurations", advice, ConfigurationsError)
    key: Key = (described.site, described.line) if described else (None, None)
    return open_configurations(folder / FILE_NAME), key


def _names(found: list[Configuration]) -> dict[tuple[str, str, str], list[str]]:
    """By (site, line, id) the names that stand for it now."""
    names: dict[tuple[str, str, str], list[str]] = {(one.site, one.line, one.id): [] for one in found}
    for (site, line, name), one in named(found).items():
        names[site, line, one.id].append(name)
    return names


def _data(one: Configuration) -> dict[str, Any]:
    return {
        "version": one.version,
        "id": one.id,
        "site": one.site,
        "line": one.line,
        "kind": one.controller and one.controller.kind,
        "damage": one.damage,
        "origins": [origin._asdict() for origin in one.origins],
        "archived": [each._asdict() for each in one.archived],
    }


def _table(*heads: str) -> Table:
    table = Table(box=SIMPLE_HEAD, show_edge=False, pad_edge=False, padding=(0, 1, 0, 0))
    for name in heads:
        table.add_column(name, no_wrap=not name.startswith("by"))
    return table


def _when(time_s: float) -> str:
    return datetime.fromtimestamp(time_s, UTC).strftime("%Y-%m-%d %H:%M")


def _refuse(why: object) -> NoReturn:
    for text in str(why).splitlines():
        typer.echo(printable(text), err=True)
    raise typer.Exit(REFUSED)
