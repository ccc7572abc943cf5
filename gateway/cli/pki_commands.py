"""`r2rgate pki`: certificates for the machines of a line."""

import json
import re
import socket
from collections.abc import Iterator, Sequence
from contextlib import suppress
from datetime import UTC, datetime
from ipaddress import ip_address
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, NoReturn
from urllib.parse import urlsplit

import typer

from gateway.cli.data_place import operator_folder
from gateway.cli.process_commands import REFUSED, DataFolder, read_line
from gateway.core.line_problem import printable
from gateway.core.line_rules_opcua import is_host
from gateway.files import MOST_BYTES, read_bytes

if TYPE_CHECKING:
    from gateway.cli.pki_bus import Kept
    from gateway.cli.pki_opcua import KeptOpcUa
    from gateway.core.line import Line

PORT = 7447  #: where nothing else is said
AGENTS = "agents"  #: the one agents' process that most lines have
_NAME = re.compile(r"[a-z0-9]([a-z0-9-]{0,30}[a-z0-9])?")

app = typer.Typer(
    name="pki",
    help="Certificates for the machines of a line: made here, signed by an authority of the line's own.",
    no_args_is_help=True,
)


@app.command()
def init(
    line_file: Annotated[Path, typer.Option("--line", help="The line's file.")],
    out: Annotated[
        Path | None, typer.Option(help="Folder for the files; pki beside the line's file, if not told.")
    ] = None,
    agents: Annotated[
        list[str] | None,
        typer.Option(
            "--agents", help="Common name of an agents' process; repeatable. Those of the line's file, or agents."
        ),
    ] = None,
    host: Annotated[
        list[str] | None,
        typer.Option(
            "--host", help="Name or address by which this machine is reached; repeatable. Those it has itself, too."
        ),
    ] = None,
    clients: Annotated[
        list[str] | None,
        typer.Option("--client", help="Name of an OPC UA client to make a certificate for, and trust; repeatable."),
    ] = None,
    data_dir: DataFolder = None,
) -> None:
    """Certificates for the agents' bus beyond this machine, and for the OPC UA server of `r2rgate operator`.

    For the bus: an authority, the gateway's, one for each agents' process, and the table \\[network] to put into the
    line's file. For OPC UA: the server's, and one for each client that cannot make its own. Private files (PEM).
    Nothing is overwritten: what is there stays, and what is missing is made, so that the same command adds an agent or
    a client, or renews what was moved away.

    Exit code: 0 made, 2 refused.

    Example: r2rgate pki init --line line.toml --host gateway.plant.example --agents agents --client panel-1
    """
    from gateway.cli.pki_bus import PkiRefused, keep_bus_pki
    from gateway.cli.pki_opcua import keep_opcua_pki
    from gateway.operator.opcua.trust import pki_folder

    line = read_line(line_file)
    folder = (out or line_file.absolute().parent / "pki").absolute()
    names = agents or (line.network.names if line.network is not None else [AGENTS])
    own = list(host or [])
    of_opcua = pki_folder(line, operator_folder(line, data_dir)).absolute()
    _check(names, clients or (), own)
    hosts = list(dict.fromkeys([*own, *_listened_on(line), *_this_machine()]))
    now = datetime.now(UTC)
    opcua: list[KeptOpcUa] = []
    try:
        opcua = keep_opcua_pki(of_opcua, line.site, line.line, hosts, clients or (), now)
        kept = keep_bus_pki(folder, f"{line.site}/{line.line}", hosts, names, now)
    except PkiRefused as refused:
        if not any(one.made for one in opcua):
            _refuse(str(refused))
        typer.echo("\n".join([*_told_opcua(of_opcua, opcua), "", str(refused)]))
        return
    except OSError as error:
        _refuse(
            f"{error.filename or folder}: {error.strerror}; name folders that you may write with --out and --data-dir"
        )
    typer.echo("\n".join([*_told(line, folder, kept, hosts, names), "", *_told_opcua(of_opcua, opcua)]))


@app.command()
def trust(
    file: Annotated[Path, typer.Argument(help="A client's certificate: DER or PEM.")],
    line_file: Annotated[Path, typer.Option("--line", help="The line's file.")],
    data_dir: DataFolder = None,
) -> None:
    """Let an OPC UA client in. Compare the fingerprint with the one that the client itself shows.

    An unknown client's certificate lies in operator/pki/rejected of the line's data folder once it has tried. To let
    one out again, remove its file from operator/pki/trusted. Both count from the next connection on.

    Exit code: 0 trusted, 2 refused.

    Example: r2rgate pki trust panel.der --line line.toml
    """
    from cryptography import x509

    from gateway.cli.pki_opcua import trust as trusted
    from gateway.operator.opcua.trust import NotUsable, application_uri, fingerprint, pki_folder

    line = read_line(line_file)
    try:
        path = trusted(pki_folder(line, operator_folder(line, data_dir)), read_bytes(file, MOST_BYTES))
    except NotUsable as error:
        _refuse(f"{file} is not trusted: {error}")
    except OSError as error:
        _refuse(f"{error.filename}: {error.strerror}")
    found = x509.load_der_x509_certificate(path.read_bytes())
    typer.echo(f"trusted: {printable(application_uri(found))}, good until {found.not_valid_after_utc:%Y-%m-%d}")
    typer.echo(f"SHA-256 {fingerprint(path.read_bytes())}\n{path}")


def _check(names: Sequence[str], clients: Sequence[str], hosts: Sequence[str]) -> None:
    from gateway.cli.pki_bus import AUTHORITY, GATEWAY

    for name in clients:
        if not _NAME.fullmatch(name):
            _refuse(f"--client is {name}; allowed: small letters, digits and dashes, at most 32")
    for name in names:
        if not _NAME.fullmatch(name) or name in (AUTHORITY, GATEWAY) or names.count(name) > 1:
            _refuse(
                f"--agents is {name}; allowed: small letters, digits and dashes, at most 32, each name once, and "
                f"neither {AUTHORITY} nor {GATEWAY}"
            )
    for one in hosts:
        if not is_host(one) or not one.isascii():
            _refuse(f"--host is {one}; allowed: a name or an address without a port, as gateway.plant.example")


def _listened_on(line: "Line") -> list[str]:
    """The host of the line's [network], where that is one."""
    if line.network is None:
        return []
    name = urlsplit(f"//{line.network.listen.removeprefix('tls/')}").hostname
    return [name] if name and _is_reached(name) else []


def _this_machine() -> Iterator[str]:
    """Its names, and its addresses as far as they are found without asking anybody."""
    names = dict.fromkeys([socket.getfqdn(), socket.gethostname(), "localhost"])
    yield from (name for name in names if is_host(name) and name.isascii())
    with suppress(OSError):
        found = socket.getaddrinfo(socket.gethostname(), None, proto=socket.IPPROTO_TCP)
        yield from (str(address[0]) for *_, address in found if _is_reached(str(address[0])))
    with suppress(OSError), socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        probe.connect(("192.0.2.1", 9))  # sends nothing: it only chooses the address of the way out
        yield probe.getsockname()[0]
    yield "127.0.0.1"


def _is_reached(host: str) -> bool:
    """Not an address that stands for all of a machine's, nor one that needs its interface beside it."""
    try:
        return not ip_address(host).is_unspecified and "%" not in host
    except ValueError:
        return "%" not in host


def _told(line: "Line", folder: Path, kept: "Sequence[Kept]", hosts: Sequence[str], names: Sequence[str]) -> list[str]:
    from gateway.cli.pki_bus import AUTHORITY, GATEWAY, how_to_renew

    what = {
        AUTHORITY: "signs the others; authority.pem goes to every machine, authority.key.pem to none: hide it",
        GATEWAY: f"the gateway's, for {', '.join(hosts)}",
    }
    of_agents = "of an agents' process: both files and authority.pem go to its machine"
    rows: list[str] = []
    for one in kept:
        how = f"{'made' if one.made else 'was there'}, good until {one.pair.until:%Y-%m-%d}"
        rows.append(f"  {one.name}.pem, {one.name}.key.pem ({how}): {what.get(one.name, of_agents)}")
    listen = line.network.listen if line.network is not None else f"tls/{_endpoint(_outside(hosts))}:{PORT}"
    table = {
        "listen": listen, "certificate": str(folder / f"{GATEWAY}.pem"),
        "private_key": str(folder / f"{GATEWAY}.key.pem"), "authority": str(folder / f"{AUTHORITY}.pem"),
        "names": list(dict.fromkeys([*(line.network.names if line.network is not None else []), *names])),
    }  # fmt: skip
    return [
        f"{folder}:", *rows, "", "Put this into the line's file, and start the gateway again:", "", "[network]",
        *(f"{key} = {json.dumps(value)}" for key, value in table.items()), "",
        "On the agents' machine: r2rgate agents LINE.toml --gateway HOST:PORT --certificate FOLDER/NAME.pem",
        f"`r2rgate doctor` tells when one is about to end; {how_to_renew()}.",
    ]  # fmt: skip


def _told_opcua(folder: Path, kept: "Sequence[KeptOpcUa]") -> list[str]:
    rows = [f"{folder}, for OPC UA:"]
    for one in kept:
        how = f"{'made' if one.made else 'was there'}, good until {one.pair.until:%Y-%m-%d}"
        rows.append(f"  {one.name}.pem, {one.name}.key.pem ({how}): {one.uri}")
    rows.append("Clients need the server's certificate, and are let in one by one: `r2rgate pki trust FILE`.")
    return rows


def _outside(hosts: Sequence[str]) -> str:
    """The first that others reach; without one the first."""
    return next((host for host in hosts if host != "localhost" and not _is_loopback(host)), hosts[0])


def _is_loopback(host: str) -> bool:
    with suppress(ValueError):
        return ip_address(host).is_loopback
    return False


def _endpoint(host: str) -> str:
    return f"[{host}]" if ":" in host else host


def _refuse(text: str) -> NoReturn:
    typer.echo(text, err=True)
    raise typer.Exit(REFUSED)
