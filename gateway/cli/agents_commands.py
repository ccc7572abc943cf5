"""`r2rgate agents`: the process of the agents. `r2rgate log`: what they were asked, and all that came of it."""

import json
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, NoReturn

import typer

from gateway.cli.operate_commands import RunFolder
from gateway.cli.process_commands import REFUSED, DataFolder, LineFile, begin_process, read_line
from gateway.core.topics import AGENT_NAMES
from gateway.mailbox.paths import AGENTS_DATA

if TYPE_CHECKING:
    from gateway.mailbox.bus import TlsEndpoint

LINE = Annotated[Path | None, typer.Option("--line", help="The line's file; needed where several lines have a log.")]


def agents(
    file: LineFile,
    run_dir: RunFolder = None,
    data_dir: DataFolder = None,
    gateway: Annotated[
        str | None, typer.Option(help="HOST:PORT of a gateway on another machine, as its line's \\[network] has it.")
    ] = None,
    certificate: Annotated[
        Path | None,
        typer.Option(
            help="With --gateway: NAME.pem of `r2rgate pki init`, with NAME.key.pem and authority.pem beside it."
        ),
    ] = None,
) -> None:
    """The agents: they answer what the phases leave to judgement, with a language model if the line's file names one.

    They reach the line by its bus alone, look things up in its knowledge (`r2rgate ask`), and each answer with all that
    led to it is kept (`r2rgate log`). The heads of the line's audit are kept as well, in agents/audit-heads.txt of the
    data folder (`r2rgate audit verify --against FILE`). Without them, and wherever they fail, the rules decide.

    Example: r2rgate agents line.toml

    Example, on another machine: r2rgate agents line.toml --gateway 192.168.0.5:7447 --certificate pki/agents.pem
    """
    from agents.heads import FILE as HEADS
    from agents.process import run_agents
    from gateway.cli.ask_run import FOLDER

    line = read_line(file)
    where, data = begin_process(line, run_dir, data_dir)
    own = data / AGENTS_DATA
    raise typer.Exit(run_agents(line, _remote(gateway, certificate) or where, own / FOLDER, own / HEADS))


def _remote(address: str | None, certificate: Path | None) -> "TlsEndpoint | None":
    """A gateway on another machine; None: on this one."""
    from gateway.cli.pki_bus import AUTHORITY
    from gateway.mailbox.bus import TlsEndpoint

    if address is None and certificate is None:
        return None
    if address is None or certificate is None:
        _refuse("--gateway and --certificate belong together: where the gateway is, and as whom it is met")
    key, authority = certificate.with_suffix(".key.pem"), certificate.with_name(f"{AUTHORITY}.pem")
    if missing := [str(path) for path in (certificate, key, authority) if not path.is_file()]:
        _refuse(f"there is no {', no '.join(missing)}; `r2rgate pki init` makes them, together")
    return TlsEndpoint(address, certificate, key, authority)


def log(
    which: Annotated[
        str | None, typer.Argument(help="One of them: its number, or its id or the beginning of it.")
    ] = None,
    line_file: LINE = None,
    data_dir: DataFolder = None,
    agent: Annotated[str | None, typer.Option(help="Only this agent's.")] = None,
    most: Annotated[int, typer.Option(min=1, help="The newest so many.")] = 20,
    as_json: Annotated[bool, typer.Option("--json", help="For machines: with everything.")] = False,
) -> None:
    """What agents were asked: the question, what they were shown, what the model said word by word, what was chosen.

    Example: r2rgate log --line line.toml

    Example, one of them whole: r2rgate log 17 --line line.toml
    """
    from gateway.cli.agents_view import as_story, as_table
    from gateway.cli.data_place import gateway_data
    from gateway.core.nearest import nearest
    from gateway.supervisor.interactions import FILE_NAME, Interactions, InteractionsError

    if agent is not None and agent not in AGENT_NAMES:
        like = nearest(agent, AGENT_NAMES)
        _refuse(f"--agent is {agent}; allowed: {', '.join(AGENT_NAMES)}{f'; did you mean {like}?' if like else ''}")
    try:
        folder = gateway_data(
            None if line_file is None else read_line(line_file), data_dir, FILE_NAME, "interactions of agents",
            "they begin with `r2rgate commission` while `r2rgate agents` runs", InteractionsError,
        )  # fmt: skip
        kept = Interactions(folder)
        if which is None:
            rows = kept.newest(most, agent)
            typer.echo(json.dumps([vars(one) for one in rows], indent=2) if as_json else as_table(rows))
        else:
            found = kept.find(which)
            typer.echo(found.model_dump_json(indent=2) if as_json else as_story(found))
    except InteractionsError as error:
        _refuse(str(error))


def _refuse(text: str) -> NoReturn:
    typer.echo(text, err=True)
    raise typer.Exit(REFUSED)
