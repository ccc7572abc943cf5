"""`r2rgate users`: who may come in through OPC UA and the page, and as what."""

import getpass
import json
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Annotated, NoReturn, cast

import typer

from gateway.cli.data_place import operator_folder
from gateway.cli.process_commands import REFUSED, DataFolder, LineFile, read_line
from gateway.core.line_problem import printable
from gateway.core.nearest import nearest
from gateway.core.people import ROLES, Role
from gateway.operator.users import FILE_NAME, Users, UsersFile, UsersRefused, change, why_weak

app = typer.Typer(
    name="users",
    help="Who may come in through OPC UA and the page: viewer, operator or engineer.",
    no_args_is_help=True,
)

Name = Annotated[str, typer.Argument(help="As they log in: a to z, 0 to 9, dot, underscore, hyphen.")]
RoleOption = Annotated[str, typer.Option("--role", help="viewer looks, operator decides, engineer changes the line.")]


@app.command()
def add(file: LineFile, name: Name, role: RoleOption = "viewer", data_dir: DataFolder = None) -> None:
    """One user more. Asks for the password twice, or takes a line of standard input.

    A name that begins with script- is a program's: the audit takes its decisions for no person's.

    Exit code: 0 added, 2 refused.

    Example: r2rgate users add line.toml anna --role operator
    """
    path, checked = _path(file, data_dir), _role(role)

    def new(users: Users) -> None:
        if users.role_of(name) is not None:
            _refuse(
                f"{name} is there already: `r2rgate users password {file} {name}` changes the password, remove ends it"
            )

    new(_users(path))  # before anything is asked for

    def added(users: Users) -> Users:
        new(users)
        return users.with_user(name, secret, checked)

    secret = _password(name)
    _change(path, added)
    typer.echo(f"{name} may come in as {checked}: {path}")


@app.command()
def password(file: LineFile, name: Name, data_dir: DataFolder = None) -> None:
    """Another password for a user who is there. Exit code: 0 changed, 2 refused.

    Example: r2rgate users password line.toml anna
    """
    path = _path(file, data_dir)
    _there(_users(path), name)  # before anything is asked for
    secret = _password(name)
    _change(path, lambda users: users.with_user(name, secret, _there(users, name)))
    typer.echo(f"{name} has another password: {path}")


@app.command("list")
def list_users(
    file: LineFile,
    data_dir: DataFolder = None,
    as_json: Annotated[bool, typer.Option("--json", help="Print as JSON.")] = False,
) -> None:
    """Names and roles. Exit code: 0 listed, 2 refused.

    Example: r2rgate users list line.toml
    """
    path = _path(file, data_dir)
    entries = _users(path).entries()
    if as_json:
        typer.echo(json.dumps([one._asdict() for one in entries], indent=2))
        return
    for one in entries:
        typer.echo(f"{one.name:<32} {one.role}")
    if not entries:
        typer.echo(f"nobody may come in; r2rgate users add {file} NAME --role operator lets somebody", err=True)


@app.command()
def remove(file: LineFile, name: Name, data_dir: DataFolder = None) -> None:
    """One user less: from now on nobody comes in under this name. Exit code: 0 removed, 2 refused.

    Example: r2rgate users remove line.toml anna
    """
    path = _path(file, data_dir)

    def removed(users: Users) -> Users:
        _there(users, name)
        return users.without(name)

    _change(path, removed)
    typer.echo(f"{name} may not come in any more: {path}")


def _path(file: Path, data_dir: Path | None) -> Path:
    return operator_folder(read_line(file), data_dir) / FILE_NAME


def _users(path: Path) -> Users:
    try:
        return UsersFile(path).current()
    except UsersRefused as refused:
        _refuse(str(refused))


def _there(users: Users, name: str) -> Role:
    """The role of who is there."""
    roles: dict[str, Role] = {one.name: one.role for one in users.entries()}
    if name not in roles:
        like = nearest(name, list(roles))
        hint = f"; did you mean {like}?" if like else ""
        _refuse(f"there is no user {name}; users are: {', '.join(roles) or 'none'}{hint}")
    return roles[name]


def _role(text: str) -> Role:
    if text not in ROLES:
        like = nearest(text, ROLES)
        hint = f"; did you mean {like}?" if like else ""
        _refuse(f"--role {text}: allowed are {', '.join(ROLES)}{hint}")
    return cast(Role, text)


def _password(name: str) -> str:
    """Asked for without echo, twice; for scripts the first line of standard input."""
    if not sys.stdin.isatty():
        return sys.stdin.readline().rstrip("\r\n")
    first = getpass.getpass(f"password of {name}: ")
    if weak := why_weak(name, first):
        _refuse(weak)
    if getpass.getpass("the same again: ") != first:
        _refuse("the two differ: nothing is changed")
    return first


def _change(path: Path, how: Callable[[Users], Users]) -> None:
    try:
        change(path, how)
    except UsersRefused as refused:
        _refuse(str(refused))
    except OSError as error:
        _refuse(f"{path} cannot be written: {error.strerror}; run this as the user whom the line's data belong to")


def _refuse(text: str) -> NoReturn:
    typer.echo(printable(text), err=True)
    raise typer.Exit(REFUSED)
