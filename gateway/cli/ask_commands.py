"""`r2rgate ask`: what is known about a question, quoted from the notes and documents that say it."""

from pathlib import Path
from typing import Annotated

import typer

from gateway.cli.process_commands import REFUSED, DataFolder, read_line
from gateway.core.line_problem import printable

EMBEDDERS = "lexical, minilm, ollama:MODEL"


def ask(
    question: Annotated[str | None, typer.Argument(help="In words; not needed with --add.")] = None,
    line: Annotated[
        Path | None, typer.Option("--line", help="The line description: what is known of this line counts too.")
    ] = None,
    decision: Annotated[
        str | None, typer.Option("--decision", help="Of the phase that asks, such as adapt.diagnosis.")
    ] = None,
    add: Annotated[
        list[Path] | None, typer.Option("--add", help="Take a file or folder in first (Markdown, text, CSV, PDF).")
    ] = None,
    most: Annotated[int, typer.Option("--most", min=1, max=20, help="How many notes or documents to quote.")] = 3,
    embedder: Annotated[
        str | None,
        typer.Option("--embedder", help=f"What finds by meaning: {EMBEDDERS}; else that of the line."),
    ] = None,
    reindex: Annotated[bool, typer.Option("--reindex", help="Make the index anew, with another embedder too.")] = False,
    explain: Annotated[bool, typer.Option("--explain", help="Show every stage of the search with its scores.")] = False,
    data_dir: DataFolder = None,
    as_json: Annotated[bool, typer.Option("--json", help="Print as JSON.")] = False,
) -> None:
    """The notes and documents that answer a question: title, tier, source and the passage, as they stand there.

    Nothing is made up: no language model is asked. Exit code: 0 something was found, 1 nothing, 2 refused.

    Example: r2rgate ask "Why does the torque of one roller rise from week to week?" --explain

    Example: r2rgate ask --line line.toml --add manuals/
    """
    from gateway.cli.ask_run import AskRefused, Search, asked_of, run

    try:
        described = None if line is None else read_line(line)
        chosen = embedder or ("lexical" if described is None else described.agents.embedder)
        search = Search(described, data_dir, chosen, add or [], reindex)
        asked = asked_of(question, decision, most, nothing=bool(add))
        done = run(search, asked)
    except AskRefused as error:
        typer.echo(printable(str(error)), err=True)
        raise typer.Exit(REFUSED) from error
    for text in done.told:
        typer.echo(printable(text), err=True)
    if done.found is None:
        raise typer.Exit(REFUSED if done.refused else 0)
    if as_json:
        from json import dumps

        from agents.rag.retrieval_data import as_data

        typer.echo(dumps(as_data(done.found), indent=2))
    else:
        from gateway.cli.ask_view import print_found

        print_found(done.found, explain)
    raise typer.Exit(0 if done.found.hits else 1)
